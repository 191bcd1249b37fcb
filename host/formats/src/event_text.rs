//! Events as words, for formats that allow comments but have no form for these events: `lost 5+
//! queue`, `bus-error stuff tec=8 rec=0`, `state passive`, `errors-suppressed 17`,
//! `transmit-failed aborted tag=3`, `transmit-failed overtaken tag=4294901760 periods=12`, `disturbed 6000` (ns),
//! `lin 3C tx 01FF checksum=C2`, `lin 0A rx fault=no-response`.

use std::fmt;
use std::str::FromStr;

use super::text;
use cantap_trace::{
    BusErrorKind, Direction, ErrorState, LinFault, LinFrame, LossStage, TraceEvent, TransmitFailure,
};

/// Marks such a text in a comment.
pub(crate) const MARK: &str = "cantap: ";

/// An event other than a frame, as words. A frame has none and displays as nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct EventText(pub TraceEvent);

impl fmt::Display for EventText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            TraceEvent::Frame { .. } => return Ok(()),
            TraceEvent::Lost { stage, count, at_least } => {
                write!(f, "lost {count}{}", if *at_least { "+" } else { "" })?;
                if let Some(stage) = stage {
                    write!(f, " {}", stage.name())?;
                }
            }
            TraceEvent::BusError { kind, .. } => {
                f.write_str("bus-error")?;
                if let Some(kind) = kind {
                    write!(f, " {}", kind.name())?;
                }
            }
            TraceEvent::ErrorsSuppressed { count } => write!(f, "errors-suppressed {count}")?,
            TraceEvent::State { state, .. } => write!(f, "state {}", state.name())?,
            TraceEvent::TransmitFailed { tag, reason } => {
                write!(f, "transmit-failed {} tag={tag}", reason.name())?;
                if let TransmitFailure::Overtaken { periods } = reason {
                    write!(f, " periods={periods}")?;
                }
            }
            TraceEvent::Disturbed { length_ns } => write!(f, "disturbed {length_ns}")?,
            TraceEvent::Lin { frame, direction } => {
                let way = if *direction == Direction::Tx { "tx" } else { "rx" };
                write!(f, "lin {:02X} {way}", frame.id())?;
                for (at, byte) in frame.data().iter().enumerate() {
                    write!(f, "{}{byte:02X}", if at == 0 { " " } else { "" })?;
                }
                if let Some(checksum) = frame.checksum {
                    write!(f, " checksum={checksum:02X}")?;
                }
                if let Some(fault) = frame.fault {
                    write!(f, " fault={}", fault.name())?;
                }
            }
        }
        if let TraceEvent::BusError { counters: Some((tec, rec)), .. }
        | TraceEvent::State { counters: Some((tec, rec)), .. } = &self.0
        {
            write!(f, " tec={tec} rec={rec}")?;
        }
        Ok(())
    }
}

/// Not an event's text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct NoEvent;

impl FromStr for EventText {
    type Err = NoEvent;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse(text).map(EventText).ok_or(NoEvent)
    }
}

fn parse(text: &str) -> Option<TraceEvent> {
    let mut words = text.split_ascii_whitespace();
    let what = words.next()?;
    if what == "lin" {
        return lin(words);
    }
    let (mut plain, mut tag, mut periods, mut tec, mut rec) = ([None; 2], None, None, None, None);
    for word in words {
        match word.split_once('=') {
            Some(("tag", value)) => tag = Some(value.parse().ok()?),
            Some(("periods", value)) => periods = Some(value.parse().ok()?),
            Some(("tec", value)) => tec = Some(value.parse().ok()?),
            Some(("rec", value)) => rec = Some(value.parse().ok()?),
            Some(_) => return None,
            None => *plain.iter_mut().find(|slot| slot.is_none())? = Some(word),
        }
    }
    let counters = tec.zip(rec);
    Some(match (what, plain) {
        ("lost", [Some(count), stage]) => {
            let (count, at_least) = match count.strip_suffix('+') {
                Some(count) => (count, true),
                None => (count, false),
            };
            let stage = match stage {
                Some(stage) => Some(LossStage::from_name(stage)?),
                None => None,
            };
            TraceEvent::Lost { stage, count: count.parse().ok()?, at_least }
        }
        ("bus-error", [None, None]) => TraceEvent::BusError { kind: None, counters },
        ("bus-error", [Some(kind), None]) => {
            TraceEvent::BusError { kind: Some(BusErrorKind::from_name(kind)?), counters }
        }
        ("errors-suppressed", [Some(count), None]) => {
            TraceEvent::ErrorsSuppressed { count: count.parse().ok()? }
        }
        ("state", [Some(state), None]) => {
            TraceEvent::State { state: ErrorState::from_name(state)?, counters }
        }
        ("transmit-failed", [Some(reason), None]) => {
            TraceEvent::TransmitFailed { tag: tag?, reason: TransmitFailure::from_name(reason, periods)? }
        }
        ("disturbed", [Some(length_ns), None]) => {
            TraceEvent::Disturbed { length_ns: length_ns.parse().ok()? }
        }
        _ => return None,
    })
}

fn lin<'a>(mut words: impl Iterator<Item = &'a str>) -> Option<TraceEvent> {
    let id = u8::from_str_radix(words.next()?, 16).ok()?;
    let direction = match words.next()? {
        "tx" => Direction::Tx,
        "rx" => Direction::Rx,
        _ => return None,
    };
    let mut frame = LinFrame::new(id, &[])?;
    for word in words {
        match word.split_once('=') {
            Some(("checksum", sum)) => frame.checksum = Some(u8::from_str_radix(sum, 16).ok()?),
            Some(("fault", name)) => frame.fault = Some(LinFault::from_name(name)?),
            Some(_) => return None,
            None => {
                let pairs = word.as_bytes().chunks(2).map(|pair| match pair {
                    [high, low] => text::hex_pair(*high, *low),
                    _ => None,
                });
                let data: Vec<u8> = pairs.collect::<Option<_>>()?;
                frame = LinFrame::new(id, &data)?.with(frame.checksum, frame.fault);
            }
        }
    }
    Some(TraceEvent::Lin { frame, direction })
}

/// The event in a text that contains [`MARK`].
pub(crate) fn marked(text: &[u8]) -> Option<TraceEvent> {
    let at = memchr::memmem::find(text, MARK.as_bytes())?;
    parse(std::str::from_utf8(&text[at + MARK.len()..]).ok()?)
}

/// Appends an event's text with [`MARK`] in front.
pub(crate) fn push_marked(out: &mut Vec<u8>, event: &TraceEvent) {
    out.extend_from_slice(format!("{MARK}{}", EventText(*event)).as_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::testing::{event, lin};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_event_round_trips(event in prop_oneof![event(), lin()]) {
            let text = EventText(event).to_string();
            prop_assert_eq!(text.parse(), Ok(EventText(event)), "{}", text);
        }

        #[test]
        fn any_text_is_an_event_or_not(text: String) {
            if let Some(event) = parse(&text) {
                prop_assert_eq!(parse(&EventText(event).to_string()), Some(event));
            }
        }
    }
}
