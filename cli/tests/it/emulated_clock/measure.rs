//! How accurately device time is mapped to UTC, and one board's time to another's: measured on boards that run the firmware's ELF,
//! whose true time is known.
//!
//! World time is what the emulated USB host's frames count exactly. The computer's clock runs from another crystal, the boards from
//! their own. A round trip takes the time that the emulated bus and the firmware need; an operating system adds a random time in each
//! direction.

use std::sync::Arc;

use cantap::device::{ClockMap, ClockReport, CommonClock, Follower, NotCommon, SofMark, Ticks, UtcNs};
use cantap::wire::{Command, Event, Reply};
use cantap_emu::Image;
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{Rig, RigError};
use cantap_sim::{CYCLES_PER_SECOND, CYCLES_PER_US};

/// UTC when the boards are switched on.
const START_NS: i64 = 1_700_000_000_000_000_000;
/// How much faster than the frames the computer's clock runs.
const COMPUTER_PPM: f64 = 25.0;
/// USB allows a host ±500 ns from frame to frame (2.0, 7.1.12).
const SOF_JITTER: u64 = CYCLES_PER_US / 2;
/// The operating system's minimum delay in each direction, which is also the mean of the random addition: a
/// thread is woken.
const LEAST_DELAY_NS: f64 = 30_000.0;
const MORE_DELAY_NS: f64 = 100_000.0;
/// How often to check for the answer.
const LOOK_CYCLES: u64 = 20 * CYCLES_PER_US;
/// Number of round trips at the start.
const ROUNDS: u32 = 8;
/// Number of times per second at which errors are measured.
const PLACES: u32 = 20;

/// Measured errors, in microseconds.
#[derive(Clone, Copy, Debug)]
pub struct Errors {
    pub median_us: f64,
    pub worst_us: f64,
}

impl Errors {
    fn of(mut errors_us: Vec<f64>) -> Self {
        errors_us.sort_by(f64::total_cmp);
        let at = |share: f64| errors_us.get((errors_us.len() as f64 * share) as usize).copied();
        Self {
            median_us: at(0.5).unwrap_or(f64::NAN),
            worst_us: errors_us.last().copied().unwrap_or(f64::NAN),
        }
    }
}

/// One board, with its time from round trips alone and from USB frames.
struct Board {
    rig: Rig,
    ppm: f64,
    alone: ClockMap,
    frames: ClockMap,
    events: usize,
    delays: u64,
}

impl Board {
    fn start(image: Image, ppm: f64) -> Result<Self, RigError> {
        let timing = Timing { board_ppm: ppm, sof_jitter: SOF_JITTER, ..Timing::hasty(CLOCK) };
        let mut rig = Rig::new(image, board::setup(), timing);
        let hello = rig.connect()?;
        let map = ClockMap::new(hello.tick_hz, UtcNs(START_NS));
        let delays = ppm.to_bits() | 1;
        let mut board = Self { rig, ppm, alone: map.clone(), frames: map, events: 0, delays };
        for _ in 0..ROUNDS {
            board.ask()?;
        }
        board.alone.settle();
        board.frames.settle();
        Ok(board)
    }

    /// The core's cycle count at a world time.
    fn cycle(&self, world_s: f64) -> u64 {
        (world_s * CYCLES_PER_SECOND as f64 * (1.0 + self.ppm * 1e-6)) as u64
    }

    fn world_s(&self, cycle: u64) -> f64 {
        cycle as f64 / CYCLES_PER_SECOND as f64 / (1.0 + self.ppm * 1e-6)
    }

    /// The stamp timer at a world time.
    fn ticks(&mut self, world_s: f64) -> Ticks {
        let since = self.cycle(world_s) - self.rig.clock_origin();
        Ticks(since * 12 / CYCLES_PER_US)
    }

    fn delay_ns(&mut self) -> i64 {
        // Xorshift (Marsaglia 2003), to a number from 0 to 1.
        self.delays ^= self.delays << 13;
        self.delays ^= self.delays >> 7;
        self.delays ^= self.delays << 17;
        let even = (self.delays >> 11) as f64 / (1_u64 << 53) as f64;
        (LEAST_DELAY_NS - (1.0 - even).ln() * MORE_DELAY_NS) as i64
    }

    /// A round trip.
    fn ask(&mut self) -> Result<(), RigError> {
        let asked = utc(self.world_s(self.rig.now())).plus(-self.delay_ns());
        let (id, bytes) = self.rig.session.request(Command::Time);
        self.rig.with_host(|host, _| host.send(&bytes));
        let ticks = loop {
            self.rig.run_for(LOOK_CYCLES)?;
            let answer = self.rig.session.response(id).map(|response| response.result);
            if let Some(Ok(Reply::Time(ticks))) = answer {
                break Ticks(ticks);
            }
        };
        let answered = utc(self.world_s(self.rig.now())).plus(self.delay_ns());
        for (ticks, event) in &self.rig.events()[self.events..] {
            if let Event::SofMark { frame, doubled } = *event {
                self.frames.mark(SofMark { frame, at: Ticks(*ticks), doubled });
            }
        }
        self.events = self.rig.events().len();
        self.alone.add(ticks, asked, answered);
        self.frames.add(ticks, asked, answered);
        Ok(())
    }

    fn run_until(&mut self, world_s: f64) -> Result<(), RigError> {
        let cycles = self.cycle(world_s).saturating_sub(self.rig.now());
        self.rig.run_for(cycles)
    }
}

/// The computer's clock at a world time.
fn utc(world_s: f64) -> UtcNs {
    UtcNs(START_NS + (world_s * 1e9 * (1.0 + COMPUTER_PPM * 1e-6)) as i64)
}

/// The quality of two boards' clocks.
#[derive(Debug)]
pub struct Clocks {
    /// The first board's UTC from round trips alone, and its own report at the end.
    pub alone: (Errors, ClockReport),
    /// The same with USB frames.
    pub frames: (Errors, ClockReport),
    /// The second board's time from the first one's: from the frames, and from each one's UTC with round trips
    /// alone.
    pub common: Result<Errors, NotCommon>,
    pub by_utc: Errors,
    /// The second board's times converted to the first one's clock while both run, as in a capture, compared with the first one's
    /// map for the same moment.
    pub live: Errors,
}

/// Two boards on one computer, this many parts per million fast, for this many seconds of emulated time; errors count from `settled_s` on.
pub fn measure(image: &Image, ppm: [f64; 2], seconds: u32, settled_s: u32) -> Result<Clocks, RigError> {
    let start = |ppm| Board::start(image.clone(), ppm).map(Box::new);
    let mut boards = [start(ppm[0])?, start(ppm[1])?];
    let (mut alone, mut frames, mut by_utc, mut live) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut follower = Follower::default();
    for second in 1..seconds {
        for board in &mut boards {
            board.run_until(f64::from(second))?;
            board.ask()?;
        }
        let [first, other] = boards.each_ref().map(|board| Arc::new(board.frames.clone()));
        follower.update(first, other);
        if second < settled_s {
            // Like records that are not measured.
            for place in 1..PLACES {
                let ticks = boards[1].ticks(f64::from(second) + f64::from(place) / f64::from(PLACES));
                follower.place(boards[1].frames.utc(ticks).0);
            }
            continue;
        }
        for place in 1..PLACES {
            let world_s = f64::from(second) + 0.02 + f64::from(place) / f64::from(PLACES);
            let [ticks, other] = boards.each_mut().map(|board| board.ticks(world_s));
            let off = |utc_now: UtcNs| utc_now.since(utc(world_s)).abs() as f64 / 1e3;
            alone.push(off(boards[0].alone.utc(ticks)));
            frames.push(off(boards[0].frames.utc(ticks)));
            let apart = boards[0].alone.utc(ticks).since(boards[1].alone.utc(other));
            by_utc.push(apart.abs() as f64 / 1e3);
            let placed = follower.place(boards[1].frames.utc(other).0);
            live.push((placed - boards[0].frames.utc(ticks).0).abs() as f64 / 1e3);
        }
    }
    let [first, second] = &mut boards;
    let common = CommonClock::between(&first.frames, &second.frames).map(|common| {
        let place = |n: u32| f64::from(settled_s) + f64::from(n) / f64::from(PLACES);
        let off = |n: u32| {
            let (ticks, other) = (first.ticks(place(n)), second.ticks(place(n)));
            let mapped = common.to_second(first.frames.frames(), ticks, second.frames.frames());
            mapped.map_or(f64::INFINITY, |mapped| mapped.since(other).abs() as f64 / 12.0)
        };
        Errors::of((0..(seconds - settled_s) * PLACES).map(off).collect())
    });
    Ok(Clocks {
        alone: (Errors::of(alone), first.alone.report()),
        frames: (Errors::of(frames), first.frames.report()),
        common,
        by_utc: Errors::of(by_utc),
        live: Errors::of(live),
    })
}
