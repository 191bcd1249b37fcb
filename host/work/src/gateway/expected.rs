//! What a gateway with these rules makes of a frame, for whoever looks for it on the other bus.

use cantap::Channel;
use cantap::wire::message::{GatewayRule, Modifier};
use cantap_analysis::delay::Expected;
use cantap_firmware::bus::periodic::apply;
use cantap_trace::TraceFrame;

use super::Rules;

/// The rules for one channel.
pub struct Map {
    places: Vec<Place>,
}

struct Place {
    part: GatewayRule,
    /// Bits of the data that depend on what the gateway has sent before.
    unknown: [u8; 8],
    period_ns: i64,
    held_ns: i64,
}

impl Map {
    /// The rules for what a channel receives.
    pub fn new(rules: &Rules, from: Channel) -> Self {
        let nanoseconds = |time: std::time::Duration| i64::try_from(time.as_nanos()).unwrap_or(i64::MAX);
        let mut places = Vec::new();
        for rule in rules.rules.iter().filter(|rule| rule.from == from) {
            let (period_ns, held_ns) = (nanoseconds(rule.period), nanoseconds(rule.delay));
            for part in &rule.parts {
                let unknown = part.pass.as_ref().map_or([0; 8], |pass| unknown(&pass.modifiers));
                places.push(Place { part: part.clone(), unknown, period_ns, held_ns });
            }
        }
        Self { places }
    }

    /// Whether there are no rules for the channel.
    pub fn is_empty(&self) -> bool {
        self.places.is_empty()
    }

    /// What the other bus should carry; `None` if the frame is not passed on. An FD frame never is.
    pub fn expected(&self, frame: &TraceFrame) -> Option<Expected> {
        let frame = frame.classic()?;
        let (rule, place) =
            self.places.iter().enumerate().find(|(_, place)| place.part.filter.matches(frame))?;
        let pass = place.part.pass.as_ref()?;
        let sent = apply(&pass.modifiers, &pass.changed(frame)?, 0, 0);
        Some(Expected {
            frame: sent.into(),
            unknown: place.unknown,
            rule,
            period_ns: place.period_ns,
            held_ns: place.held_ns,
        })
    }
}

/// The bits of counters, and of checksums over such.
fn unknown(modifiers: &[Modifier]) -> [u8; 8] {
    let mut unknown = [0; 8];
    for modifier in modifiers {
        match *modifier {
            Modifier::Counter { byte, low_bit, bits } => {
                if let Some(place) = unknown.get_mut(usize::from(byte)) {
                    *place |= (((1_u16 << bits) - 1) as u8) << low_bit;
                }
            }
            Modifier::Checksum { byte, .. } => {
                let holder = usize::from(byte);
                let covers = unknown.iter().enumerate().any(|(at, bits)| at != holder && *bits != 0);
                if let Some(place) = unknown.get_mut(holder) {
                    *place = if covers { 0xFF } else { 0 };
                }
            }
            Modifier::Random { byte } => {
                if let Some(place) = unknown.get_mut(usize::from(byte)) {
                    *place = 0xFF;
                }
            }
        }
    }
    unknown
}
