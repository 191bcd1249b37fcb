//! The buses: each channel listens for a while, and where that does not explain itself, the edges on its receive pin are measured.

use std::time::{Duration, Instant};

use cantap::Channel;
use cantap::autobaud::{Limits, Outcome as Measured};
use cantap::wire::message::{ChannelConfig, Mode, capability};
use cantap_address::OpenDevice;
use cantap_trace::counted;

use super::check::{BusFigures, Check, Examination, Verdict, channels, is_stopped};
use crate::bit_rate_search::{self, Search};
use crate::bus_hints::{BusEvidence, BusHint, HintPlace};
use crate::channel_options::ChannelOptions;
use crate::report::Reporter;
use crate::requested_rate::RequestedRate;
use crate::{Meter, advice, rounded};

/// How long to wait for an edge on a bus on which nothing was received.
const PATIENCE: Duration = Duration::from_secs(1);
/// How often to check for Ctrl-C.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// Bit rates that differ by less than this are the same: a crystal is not exact.
const SAME_RATE: f64 = 0.005;

/// Examines the buses, one after the other. Only if none of them has traffic is silence a problem: often not every channel is connected.
pub fn examine(device: &OpenDevice, examination: &Examination) -> Vec<Check> {
    let mut checks = Vec::new();
    for channel in channels(examination, device.hello()) {
        let check = if is_stopped() {
            Check::new("bus", Verdict::Skipped, "stopped before it was listened to")
        } else {
            let bus = Bus { device, channel, time: examination.time };
            let rate = RequestedRate::of(&examination.bitrates, channel.number());
            bus.examine(rate).unwrap_or_else(|error| {
                Check::problem("bus", advice::sentence(&error), "correct that, and examine it again")
            })
        };
        checks.push(check.on(channel.number()));
    }
    let is_silent =
        |check: &Check| check.bus.as_ref().is_some_and(|bus| bus.hint == Some(BusHint::Silent.name()));
    if checks.iter().any(|check| check.bus.as_ref().is_some_and(|bus| bus.frames > 0)) {
        for check in checks.iter_mut().filter(|check| is_silent(check)) {
            check.outcome = Verdict::Note;
        }
    }
    checks
}

struct Bus<'a> {
    device: &'a OpenDevice,
    channel: Channel,
    time: Duration,
}

impl Bus<'_> {
    fn place(&self) -> HintPlace<'_> {
        let number = self.channel.number();
        HintPlace { number, device: self.device.name(), channel_there: number }
    }

    fn examine(&self, requested: Option<RequestedRate>) -> anyhow::Result<Check> {
        let is_known = match requested {
            Some(rate) => !rate.is_auto(),
            None => {
                self.device.bitrate_of_bus(self.channel).is_some()
                    || self.device.defaults(self.channel)?.is_some()
            }
        };
        let can_measure = bit_rate_search::is_possible(self.device);
        let is_set_elsewhere = self.device.hello().capabilities & capability::NO_BIT_RATE != 0;
        let is_known = is_known || is_set_elsewhere && requested.is_none();
        if !is_known && !can_measure {
            return Ok(Check::problem(
                "bus",
                "this device cannot find a bit rate by listening",
                "give the bus's bit rate, such as -b 500k",
            ));
        }
        let found_bps = if is_known {
            None
        } else {
            match bit_rate_search::search(self.device, self.channel, &limits(), &mut |_| !is_stopped())? {
                Search::Measured(outcome) if outcome_bps(outcome).is_none() => {
                    return Ok(self.of_search(outcome));
                }
                found => found.bitrate_bps(),
            }
        };
        let rates =
            found_bps.map(|bitrate_bps| RequestedRate { channel: None, bitrate_bps: Some(bitrate_bps) });
        let own = requested.filter(|_| is_known).map(|rate| RequestedRate { channel: None, ..rate });
        let options = ChannelOptions::listening(rates.or(own));
        let received = self.listen(&options)?;
        let Some(hint) = received.evidence.hint(received.is_filtered) else { return Ok(received.good()) };
        let is_certain = hint == BusHint::Disturbed || !can_measure || is_stopped();
        if is_certain {
            return Ok(received.with(hint, &self.place()));
        }
        let outcome = bit_rate_search::measure(self.device, self.channel, &limits(), &mut |_| !is_stopped())?;
        Ok(self.refined(&received, hint, outcome))
    }

    /// Receives for a while, without sending or acknowledging anything.
    fn listen(&self, options: &ChannelOptions) -> anyhow::Result<Received> {
        let channel = self.channel;
        let opened = options.open(
            self.device,
            [channel].into_iter(),
            Mode::ListenOnly,
            Some(&[]),
            &Reporter::silent(),
        )?;
        let config = opened.first().map(|(_, config)| *config);
        let clock_hz = self.device.hello().can_clock_hz;
        let meter =
            config.map_or_else(|| Meter::new(0), |config: ChannelConfig| Meter::of(&config, clock_hz));
        let mut received = Received {
            bitrate_bps: config.and_then(|config| config.timing.known_bitrate_bps(clock_hz)),
            evidence: BusEvidence::default(),
            meter: meter.with_data_bitrate(self.device.data_bitrate(channel)),
            is_filtered: self.device.is_filtered(channel),
        };
        let mut records = self.device.records();
        let ends = Instant::now() + self.time;
        while Instant::now() < ends && !is_stopped() {
            let left = ends.saturating_duration_since(Instant::now());
            let Some(batch) = records.next_batch(left.min(LOOK_EVERY))? else { break };
            received.evidence.take_all(channel.number(), &batch);
            batch
                .iter()
                .filter(|record| record.channel == channel.number())
                .for_each(|record| received.meter.push(record));
        }
        self.device.close_channel(channel)?;
        // What arrived while it was being closed belongs to no other channel's figures.
        while records.next_batch(Duration::ZERO)?.is_some_and(|batch| !batch.is_empty()) {}
        Ok(received)
    }

    /// A bit rate was to be found, and there is none.
    fn of_search(&self, outcome: Measured) -> Check {
        let figures = |hint: BusHint| BusFigures {
            bitrate_bps: None,
            frames: 0,
            bus_errors: 0,
            hint: Some(hint.name()),
        };
        if let Some(hint) = hint_of(outcome) {
            let check = Check::problem("bus", hint.meaning(), hint.next_step(&self.place()));
            return Check { bus: Some(figures(hint)), ..check };
        }
        self.of_failure(outcome)
    }

    fn of_failure(&self, outcome: Measured) -> Check {
        let text = bit_rate_search::failure(outcome, self.channel.number(), PATIENCE.as_secs_f64());
        let (found, next) =
            text.split_once("; ").unwrap_or((&text, "examine it again when there is more traffic"));
        Check::problem("bus", found, next)
    }

    /// What the edges on the pin say about a hint.
    fn refined(&self, received: &Received, hint: BusHint, outcome: Measured) -> Check {
        let place = self.place();
        if let Some(certain) = hint_of(outcome) {
            return received.with(certain, &place);
        }
        match outcome_bps(outcome) {
            Some(bitrate_bps) if received.bitrate_bps.is_some_and(|own| !is_same(bitrate_bps, own)) => {
                let own_bps = received.bitrate_bps.unwrap_or_default();
                let mut check = received.with(BusHint::WrongBitRate, &place);
                check.found = format!("the bus runs at {bitrate_bps} bit/s, not at {own_bps}");
                check.next = Some(format!("give -b {}:{bitrate_bps}", place.number));
                check
            }
            // There is something after all, at the bit rate that was listened at.
            Some(_) if hint == BusHint::Silent => {
                let next = "listen longer: -t 10s".to_owned();
                Check {
                    next: Some(next),
                    ..received.check(Verdict::Note, Some(hint), "traffic is sparse: it began only later")
                }
            }
            Some(_) => received.with(BusHint::Disturbed, &place),
            None if outcome == Measured::Stopped => received.with(hint, &place),
            None => Check { bus: Some(received.figures(Some(hint))), ..self.of_failure(outcome) },
        }
    }
}

fn limits() -> Limits {
    Limits { silence: PATIENCE }
}

const fn outcome_bps(outcome: Measured) -> Option<u32> {
    match outcome {
        Measured::Found { bitrate_bps, .. } => Some(bitrate_bps),
        _ => None,
    }
}

/// What is certain from the edges alone.
const fn hint_of(outcome: Measured) -> Option<BusHint> {
    match outcome {
        Measured::NoTraffic => Some(BusHint::Silent),
        Measured::Stuck => Some(BusHint::DominantBus),
        Measured::Unconfirmed { acknowledged: false, .. } => Some(BusHint::LoneSender),
        _ => None,
    }
}

fn is_same(left_bps: u32, right_bps: u32) -> bool {
    (f64::from(left_bps) / f64::from(right_bps.max(1)) - 1.0).abs() < SAME_RATE
}

/// What was received from a bus.
struct Received {
    /// If known.
    bitrate_bps: Option<u32>,
    evidence: BusEvidence,
    meter: Meter,
    is_filtered: bool,
}

impl Received {
    fn figures(&self, hint: Option<BusHint>) -> BusFigures {
        BusFigures {
            bitrate_bps: self.bitrate_bps,
            frames: self.evidence.frames(),
            bus_errors: self.evidence.errors(),
            hint: hint.map(BusHint::name),
        }
    }

    fn check(&self, outcome: Verdict, hint: Option<BusHint>, found: impl Into<String>) -> Check {
        Check { bus: Some(self.figures(hint)), ..Check::new("bus", outcome, found) }
    }

    fn good(&self) -> Check {
        let load = self
            .meter
            .bus_load_pct()
            .map_or_else(String::new, |load| format!(", load {} %", rounded(load, 1)));
        let errors = match self.evidence.errors() {
            0 => "no errors".to_owned(),
            count => format!("{count} ({})", self.evidence.errors_text(), count = counted(count, "error")),
        };
        let text = format!(
            "{}{}{load}, {errors}",
            counted(self.evidence.frames(), "frame"),
            self.bitrate_bps.map_or_else(String::new, |rate| format!(" at {rate} bit/s"))
        );
        self.check(Verdict::Ok, None, text)
    }

    fn with(&self, hint: BusHint, place: &HintPlace<'_>) -> Check {
        let figures = match (self.evidence.frames(), self.evidence.errors()) {
            (_, 0) => String::new(),
            (frames, errors) => {
                format!(
                    " ({frames}, {errors}: {})",
                    self.evidence.errors_text(),
                    frames = counted(frames, "frame"),
                    errors = counted(errors, "error")
                )
            }
        };
        let rate = self.bitrate_bps.map_or_else(String::new, |rate| format!("at {rate} bit/s "));
        let found = format!("{rate}{}{figures}", hint.meaning());
        Check { next: Some(hint.next_step(place)), ..self.check(Verdict::Problem, Some(hint), found) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_address::Address;

    fn device() -> OpenDevice {
        Address::of_virtual_device().open().unwrap()
    }

    fn received() -> Received {
        let evidence = BusEvidence::default();
        Received { bitrate_bps: Some(500_000), evidence, meter: Meter::new(500_000), is_filtered: false }
    }

    /// Only the edges tell them apart: a controller reports neither frames nor errors of both.
    #[test]
    fn a_dominant_bus_is_told_from_a_silent_one_by_its_edges() {
        let device = device();
        let bus = Bus { device: &device, channel: Channel::Can1, time: Duration::ZERO };
        let hint = |check: Check| check.bus.unwrap().hint;
        let refined = |outcome| bus.refined(&received(), BusHint::Silent, outcome);
        assert_eq!(hint(refined(Measured::Stuck)), Some("dominant-bus"));
        assert_eq!(hint(refined(Measured::NoTraffic)), Some("silent"));
        assert_eq!(hint(bus.of_search(Measured::Stuck)), Some("dominant-bus"));
        let unreadable = refined(Measured::Unreadable { edges: 7 });
        assert!(unreadable.found.contains("7 edges") && unreadable.next.is_some(), "{unreadable:?}");
    }

    #[test]
    fn rates_within_a_crystal_s_error_are_the_same() {
        assert!(is_same(500_000, 500_000) && is_same(83_333, 83_334));
        assert!(!is_same(500_000, 495_000) && !is_same(125_000, 0));
    }
}
