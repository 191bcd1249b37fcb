//! Measures the length of a bit from the edges of a receive pin.
//!
//! Every possible bit time is tried, in steps of one per cent: the right one is the one at which frames can be read, including their CRC. It
//! is then known which bit each edge of a frame begins, and a line through the edges gives the bit time. Edges to dominant and edges to
//! recessive get a line each, with a common slope, so a delay that affects one kind more than the other cancels out. Destroyed frames and
//! glitches have no effect because they are not read.

use super::reading::{PinEdge, ReadFrame, read_frames};

/// Step from one trial bit time to the next. A bit is placed relative to the previous edge to dominant, at most ten bits away, so half a
/// step is a twentieth of a bit.
const STEP: f64 = 1.01;
/// An edge farther from its place than this fraction of a bit, on top of the scatter of the others, is left
/// out.
const OUTLIER_BITS: f64 = 0.1;
/// The edges of a real frame scatter by less than this fraction of a bit around their places; those of something that
/// only looks like a frame, by more.
const MOST_SCATTER_BITS: f64 = 0.12;
/// A frame can still be read with a wrong bit time, but not with one that is off by more than this fraction.
const FARTHEST_GUESS: f64 = 0.1;
/// Error from rounding to ticks, in ticks.
pub(super) const ROUNDING_TICKS: f64 = 0.29;

/// The result of a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Measured {
    /// Length of a bit, in ticks.
    pub bit_ticks: f64,
    /// Standard error, as a fraction of the bit.
    pub error: f64,
    /// Frames read completely.
    pub frames: u32,
    /// How many of those were acknowledged.
    pub acknowledged: u32,
}

/// Measures a bit that is between `least` and `most` ticks long; `None` if no frame can be read.
pub(super) fn measure(edges: &[PinEdge], least: f64, most: f64) -> Option<Measured> {
    // The largest number of edges placed, and the first and last bit time in a row that reached it.
    let mut best = (0, least, least);
    let mut tried = least / STEP;
    while tried <= most * STEP {
        let placed: usize = read_frames(edges, tried).iter().map(|frame| frame.edges.len()).sum();
        if placed > best.0 {
            best = (placed, tried, tried);
        } else if placed == best.0 && tried < best.2 * STEP.powf(1.5) {
            best.2 = tried;
        }
        tried *= STEP;
    }
    let (1.., first, last) = best else { return None };
    // A short frame can be read far off its bit time, in both directions.
    let guess = (first * last).sqrt();
    let rough = fit(&read_frames(edges, guess), guess)?;
    // With the true bit time, frames become readable for which the guess was too far off.
    let frames = read_frames(edges, rough.bit_ticks);
    let fine = fit(&frames, rough.bit_ticks)?;
    let acknowledged = frames.iter().filter(|frame| frame.acknowledged).count() as u32;
    Some(Measured { frames: frames.len() as u32, acknowledged, ..fine })
}

/// Sums over the edges of one kind in one frame.
#[derive(Clone, Copy, Debug, Default)]
struct Line {
    count: f64,
    bits: f64,
    ticks: f64,
}

/// The common slope of parallel lines: one line for each kind of edge in each frame.
fn fit(frames: &[ReadFrame], guess: f64) -> Option<Measured> {
    let kinds = || frames.iter().flat_map(|frame| [true, false].map(|dominant| (frame, dominant)));
    let mut points: Vec<Vec<(f64, f64)>> = kinds()
        .map(|(frame, dominant)| {
            let begin = frame.edges.first().map_or(0.0, |placed| placed.edge.at);
            let edges = frame.edges.iter().filter(|placed| placed.edge.dominant == dominant);
            edges.map(|placed| (f64::from(placed.bit), placed.edge.at - begin)).collect()
        })
        .collect();
    let mut slope = guess;
    let mut scatter = f64::INFINITY;
    let mut spread = 0.0;
    for _ in 0..3 {
        let lines: Vec<Line> = points.iter().map(|points| line(points)).collect();
        let (mut up, mut across) = (0.0, 0.0);
        for (points, line) in points.iter().zip(&lines) {
            for (bit, at) in points {
                let x = bit - line.bits;
                up += x * (at - line.ticks);
                across += x * x;
            }
        }
        if across <= 0.0 {
            return None;
        }
        slope = up / across;
        spread = across;
        let off = |(bit, at): &(f64, f64), line: &Line| at - line.ticks - slope * (bit - line.bits);
        let squares: f64 =
            points.iter().zip(&lines).flat_map(|(all, line)| all.iter().map(|p| off(p, line).powi(2))).sum();
        let count: f64 = lines.iter().map(|line| line.count).sum();
        let used = 1.0 + lines.iter().filter(|line| line.count > 0.0).count() as f64;
        scatter = (squares / (count - used).max(1.0)).sqrt();
        let most = (2.5 * scatter).max(OUTLIER_BITS * slope.abs());
        for (points, line) in points.iter_mut().zip(&lines) {
            points.retain(|point| off(point, line).abs() <= most);
        }
    }
    let fits = (slope / guess - 1.0).abs() < FARTHEST_GUESS && scatter < MOST_SCATTER_BITS * slope;
    let error = scatter.max(ROUNDING_TICKS) / spread.sqrt() / slope;
    fits.then_some(Measured { bit_ticks: slope, error, frames: frames.len() as u32, acknowledged: 0 })
}

/// The centre of some points.
fn line(points: &[(f64, f64)]) -> Line {
    let count = points.len() as f64;
    let mean = |sum: f64| if points.is_empty() { 0.0 } else { sum / count };
    Line {
        count,
        bits: mean(points.iter().map(|(bit, _)| bit).sum()),
        ticks: mean(points.iter().map(|(_, at)| at).sum()),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use cantap_trace::levels::{ACK_SLOT_FROM_END, levels};

    pub const TICK_HZ: f64 = 12e6;
    pub const LEAST: f64 = 12.0;
    pub const MOST: f64 = 2400.0;

    /// A simulated pin that carries one frame after the other.
    pub struct Pin {
        pub bit: f64,
        /// How late edges to recessive are, in ticks.
        pub slow: f64,
        now: f64,
        pub edges: Vec<PinEdge>,
    }

    impl Pin {
        pub fn at(bps: f64) -> Self {
            Self { bit: TICK_HZ / bps, slow: 0.8, now: 1234.56, edges: Vec::new() }
        }

        fn edge(&mut self, at: f64, dominant: bool) {
            if dominant != self.edges.last().is_some_and(|edge| edge.dominant) {
                let at = (at + if dominant { 0.0 } else { self.slow }).floor();
                self.edges.push(PinEdge { at, dominant, unsure: false });
            }
        }

        fn levels(&mut self, levels: &[bool]) {
            for recessive in levels {
                self.edge(self.now, !recessive);
                self.now += self.bit;
            }
            self.edge(self.now, false);
        }

        pub fn frame(&mut self, text: &str) {
            let mut bits = levels(&text.parse().unwrap());
            let ack = bits.len() - ACK_SLOT_FROM_END;
            bits[ack] = false;
            bits.extend([true; 3]);
            self.levels(&bits);
        }

        /// A frame cut off by an error flag.
        pub fn destroyed(&mut self, text: &str, after: usize) {
            let mut bits = levels(&text.parse().unwrap());
            bits.truncate(after);
            bits.extend([false; 8]);
            bits.extend([true; 11]);
            self.levels(&bits);
        }

        fn measure(&self) -> Option<f64> {
            measure(&self.edges, LEAST, MOST).map(|measured| TICK_HZ / measured.bit_ticks)
        }
    }

    fn off(measured: Option<f64>, bps: f64) -> f64 {
        (measured.unwrap_or_else(|| panic!("{bps}: nothing")) / bps - 1.0).abs()
    }

    pub const FRAMES: [&str; 5] =
        ["123#", "7FF#FFFFFFFFFFFFFFFF", "1ABCDEF0#1122334455667788", "000#0000000000000000", "2AA#R5"];
    pub const RATES: [f64; 12] =
        [5e3, 10e3, 33_333.3, 47_619.0, 83_333.3, 125e3, 250e3, 253_968.0, 500e3, 615_384.6, 800e3, 1e6];

    #[test]
    fn one_frame_tells_any_rate_to_a_thousandth() {
        for bps in RATES {
            for text in FRAMES {
                let mut pin = Pin::at(bps);
                pin.frame(text);
                let off = off(pin.measure(), bps);
                assert!(off < 0.001, "{bps}, {text}: {off}");
            }
        }
    }

    #[test]
    fn every_length_of_the_pause_before_and_behind_does() {
        let mut pin = Pin::at(125e3);
        for pause in [0.0, 1.0, 30.0, 1e5, 1e9] {
            pin.now += pause;
            pin.frame("123#DEADBEEF");
        }
        assert_eq!(measure(&pin.edges, LEAST, MOST).unwrap().frames, 5);
        assert!(off(pin.measure(), 125e3) < 0.000_2);
    }

    #[test]
    fn destroyed_frames_are_passed_over() {
        for bps in RATES {
            let mut pin = Pin::at(bps);
            for (n, text) in FRAMES.iter().enumerate() {
                pin.destroyed(text, 8 + 5 * n);
                pin.destroyed(text, 20);
                pin.frame(text);
            }
            assert_eq!(measure(&pin.edges, LEAST, MOST).unwrap().frames, 5, "{bps}");
            assert!(off(pin.measure(), bps) < 0.001);
        }
    }

    #[test]
    fn destroyed_frames_alone_tell_nothing() {
        let mut pin = Pin::at(500e3);
        (10..30).for_each(|after| pin.destroyed("123#1122", after));
        assert_eq!(pin.measure(), None);
    }

    /// A third of a bit: what a long line causes at 1 Mbit/s.
    #[test]
    fn bits_of_unequal_length_are_measured_right() {
        for slow in [-0.2, 0.0, 0.2, 0.33, 0.5] {
            for bps in RATES {
                let mut pin = Pin::at(bps);
                pin.slow = slow * pin.bit;
                pin.frame("123#0011223344556677");
                pin.frame("18FF1234#55AA");
                let off = off(pin.measure(), bps);
                assert!(off < 0.001, "{bps}, {slow}: {off}");
            }
        }
    }

    #[test]
    fn another_node_s_acknowledgement_and_a_glitch_move_nothing() {
        let mut pin = Pin::at(500e3);
        pin.frame("123#1122334455667788");
        pin.frame("456#1122334455667788");
        let ack = pin.edges.len() - 2;
        for edge in &mut pin.edges[ack..] {
            edge.at += 7.0;
        }
        // Two ticks of dominant level within a recessive bit.
        let place = pin.edges.iter().position(|edge| !edge.dominant).unwrap();
        let at = pin.edges[place].at + 9.0;
        let glitch = [true, false].map(|dominant| PinEdge {
            at: at + if dominant { 0.0 } else { 2.0 },
            dominant,
            unsure: false,
        });
        pin.edges.splice((place + 1)..=place, glitch);
        let measured = measure(&pin.edges, LEAST, MOST).unwrap();
        assert_eq!((measured.frames, measured.acknowledged), (2, 2));
        assert!((TICK_HZ / measured.bit_ticks / 500e3 - 1.0).abs() < 0.001);
    }

    #[test]
    fn what_was_missed_spoils_one_frame_only() {
        let mut pin = Pin::at(1e6);
        for text in FRAMES {
            pin.frame(text);
        }
        pin.edges.drain(10..13);
        pin.edges[10].unsure = true;
        let measured = measure(&pin.edges, LEAST, MOST).unwrap();
        assert_eq!(measured.frames, 4);
        assert!((TICK_HZ / measured.bit_ticks / 1e6 - 1.0).abs() < 0.001);
    }

    #[test]
    fn a_frame_that_nobody_acknowledges_is_read_and_reported() {
        let mut pin = Pin::at(250e3);
        let mut bits = levels(&"123#1122".parse().unwrap());
        bits.truncate(bits.len() - ACK_SLOT_FROM_END + 1);
        bits.extend([false; 6]);
        bits.extend([true; 11]);
        pin.levels(&bits);
        let measured = measure(&pin.edges, LEAST, MOST).unwrap();
        assert_eq!((measured.frames, measured.acknowledged), (1, 0));
    }

    #[test]
    fn noise_and_other_signals_are_no_frames() {
        let mut random = 12_345_u64;
        let mut next = || {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> 33) as f64
        };
        for kind in 0..20 {
            let mut at = 0.0;
            let edges: Vec<PinEdge> = (0..600)
                .map(|n| {
                    // Random pulses; a square wave; a serial line of 8 bits.
                    at += match kind % 3 {
                        0 => 5.0 + next() % 500.0,
                        1 => 100.0,
                        _ => 104.0 * (1.0 + next() % 9.0),
                    };
                    PinEdge { at, dominant: n % 2 == 0, unsure: false }
                })
                .collect();
            assert_eq!(measure(&edges, LEAST, MOST), None, "{kind}");
        }
    }
}
