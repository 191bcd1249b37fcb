//! How full frames that were sent have made their buses.

use cantap::Channel;
use cantap::device::Transmission;
use cantap::wire::CHANNELS;
use cantap_work::rounded;
use serde_json::{Value, json};

/// How full the buses were, from the first frame sent to the last one known to have ended.
pub struct Filled {
    bitrates_bps: [u32; CHANNELS],
    frames: [u64; CHANNELS],
    bits: [f64; CHANNELS],
    /// Bit rates of the data phases of CAN FD frames, as far as they are known.
    data_bitrates_bps: [Option<u32>; CHANNELS],
    /// How long one of the frames took is not known.
    is_unknown: [bool; CHANNELS],
    span_ticks: [Option<(u64, u64)>; CHANNELS],
}

impl Filled {
    /// Nothing was sent yet. A bit rate of 0 is not known.
    pub const fn new(bitrates_bps: [u32; CHANNELS], data_bitrates_bps: [Option<u32>; CHANNELS]) -> Self {
        Self {
            bitrates_bps,
            data_bitrates_bps,
            frames: [0; CHANNELS],
            bits: [0.0; CHANNELS],
            is_unknown: [false; CHANNELS],
            span_ticks: [None; CHANNELS],
        }
    }

    /// Takes ends of transmissions.
    pub fn add(&mut self, ends: &[Transmission]) {
        for end in ends {
            let Ok(frame) = &end.result else { continue };
            let channel = end.channel.index();
            match &mut self.span_ticks[channel] {
                None => self.span_ticks[channel] = Some((end.ticks, end.ticks)),
                Some((_, last)) => {
                    *last = end.ticks;
                    self.frames[channel] += 1;
                    let bits = frame.bus_bits();
                    self.bits[channel] += f64::from(bits.nominal);
                    // As many bits of the nominal rate as take that long.
                    match self.data_bitrates_bps[channel] {
                        Some(data_bps) => {
                            let ratio = f64::from(self.bitrates_bps[channel]) / f64::from(data_bps.max(1));
                            self.bits[channel] += f64::from(bits.data) * ratio;
                        }
                        None => self.is_unknown[channel] |= bits.data > 0,
                    }
                }
            }
        }
    }

    /// Each channel's frames per second, and its load in per cent, counting only what was sent here.
    fn rates(&self, tick_hz: u32) -> impl Iterator<Item = (Channel, f64, Option<f64>)> + use<'_> {
        Channel::ALL.into_iter().filter_map(move |channel| {
            let index = channel.index();
            let (first, last) = self.span_ticks[index].filter(|(first, last)| first < last)?;
            let seconds = (last - first) as f64 / f64::from(tick_hz);
            let load_pct = self.bits[index] * 100.0 / (f64::from(self.bitrates_bps[index]) * seconds);
            let load_pct = (!self.is_unknown[index] && self.bitrates_bps[index] > 0).then_some(load_pct);
            Some((channel, self.frames[index] as f64 / seconds, load_pct))
        })
    }

    /// Prints it.
    pub fn tell(&self, tick_hz: u32) {
        for (channel, frames_per_s, load_pct) in self.rates(tick_hz) {
            let load = load_pct.map_or_else(
                || "unknown, as the bit rate is".to_owned(),
                |load_pct| format!("{load_pct:.1} %"),
            );
            eprintln!("cantap: channel {}: {frames_per_s:.0} frames/s, bus load {load}", channel.number());
        }
    }

    /// The same for scripts.
    pub fn object(&self, tick_hz: u32) -> Value {
        self.rates(tick_hz)
            .map(|(channel, frames_per_s, load_pct)| {
                json!({
                    "channel": channel.number(),
                    "frames_per_s": rounded(frames_per_s, 1),
                    "bus_load_pct": load_pct.map(|load_pct| rounded(load_pct, 2)),
                })
            })
            .collect()
    }
}
