//! A frame in the send list, and how it is typed.

use std::sync::Arc;
use std::time::Duration;

use cantap::Frame;
use cantap::periodic::check_modifiers;
use cantap::wire::message::{MAX_MODIFIERS, Modifier};
use cantap_signals::{Decoder, encode};
use cantap_trace::grammar;

use super::super::model::Model;
use super::super::order::{Modifiers, Repeated};
use cantap_work::changing::Changing;
use cantap_work::channels::MOST_CHANNELS;
use cantap_work::gateway::{checksum, counter};

/// A frame in the send list.
#[derive(Clone, Debug)]
pub struct SendEntry {
    /// As typed: a frame, or a message with its signals.
    pub text: String,
    /// The channel's number, from 1.
    pub channel: u8,
    /// The frame.
    pub frame: Frame,
    /// The period; `None` to send once per key press.
    pub period: Option<Duration>,
    /// What changes each time it is sent periodically.
    pub modifiers: Modifiers,
    /// The message, if its values change with time, and what encodes it.
    pub changing: Option<(Arc<Changing>, Arc<Decoder>)>,
    /// The group that is started and stopped together with it.
    pub group: Option<String>,
    /// The device's slot that is sending it, if any.
    pub slot: Option<u8>,
    /// How often it was sent by key.
    pub sent: u64,
}

impl SendEntry {
    /// What the source is to send periodically, if it has a period.
    pub fn repeated(&self) -> Option<Repeated> {
        let Self { frame, period, modifiers, changing, .. } = self;
        let (modifiers, changing) = (modifiers.clone(), changing.clone());
        period.map(|period| Repeated { frame: *frame, period, modifiers, changing })
    }
}

/// What follows the frame, in any order.
#[derive(Default)]
struct Options {
    period: Option<Duration>,
    counters: Vec<Modifier>,
    checksums: Vec<Modifier>,
    group: Option<String>,
}

impl Options {
    fn parse(text: &str) -> Result<Self, String> {
        let mut options = Self::default();
        for word in text.split_whitespace() {
            match word.split_once('=') {
                Some(("counter", value)) => options.counters.push(counter(value)?),
                Some(("random", value)) => {
                    let byte = value.parse().map_err(|_| "write random=BYTE, such as random=5")?;
                    options.counters.push(Modifier::Random { byte });
                }
                Some(("checksum", value)) => options.checksums.push(checksum(value)?),
                Some(("group", name)) if !name.is_empty() => options.group = Some(name.to_owned()),
                Some((name, _)) => {
                    return Err(format!(
                        "there is no option '{name}'; there are counter=, random=, checksum=, group="
                    ));
                }
                None if options.period.is_some() => {
                    return Err(format!("'{word}' is one period too many"));
                }
                None => options.period = Some(grammar::duration(word)?),
            }
        }
        if options.period.is_some_and(|period| period.is_zero()) {
            return Err("a period must be longer than nothing, such as 100ms".to_owned());
        }
        Ok(options)
    }

    /// A checksum is over everything else that changes.
    fn modifiers(&self) -> Result<Modifiers, String> {
        let all: Vec<_> = self.counters.iter().chain(&self.checksums).copied().collect();
        let modifiers = Modifiers::from_slice(&all);
        modifiers.map_err(|_| format!("a frame takes {MAX_MODIFIERS} of counter=, random=, checksum="))
    }
}

/// Where the frame or message ends: at the first blank that is in neither quotes nor brackets.
fn end_of_frame(text: &str) -> usize {
    let (mut is_quoted, mut depth) = (false, 0_u32);
    let end = text.find(|character: char| {
        match character {
            '"' => is_quoted = !is_quoted,
            '(' if !is_quoted => depth += 1,
            ')' if !is_quoted => depth = depth.saturating_sub(1),
            _ => return character.is_whitespace() && !is_quoted && depth == 0,
        }
        false
    });
    end.unwrap_or(text.len())
}

/// A line of the send list: `[CHANNEL:]FRAME [PERIOD] [counter=…] [random=…] [checksum=…] [group=…]`, or a message with its signals instead of
/// the frame.
pub fn parse_entry(text: &str, model: &Model) -> Result<SendEntry, String> {
    let (what, rest) = text.split_at(end_of_frame(text));
    let options = Options::parse(rest)?;
    let modifiers = options.modifiers()?;
    let Options { period, group, .. } = options;
    let (channel, what) = match what.split_once(':') {
        Some((number, rest)) => match grammar::channel(number).filter(|number| *number <= MOST_CHANNELS) {
            Some(number) => (Some(number), rest),
            None => (None, what),
        },
        None => (None, what),
    };
    let decoder = model.seen.signals.decoder();
    let mut changing = None;
    let (frame, of_database) = if what.contains('#') {
        (grammar::frame(what)?, None)
    } else if let Some(waves) = Changing::parse(what).map_err(|error| error.to_string())? {
        if period.is_none() {
            return Err("a value that changes with time needs a period behind it, such as 20ms".to_owned());
        }
        let waves = waves.with_modifiers(modifiers.clone());
        let frame = waves.check(decoder, channel).map_err(|error| error.to_string())?;
        changing = Some((Arc::new(waves), Arc::clone(decoder)));
        (frame, None)
    } else {
        let encoded = encode::encode(decoder, channel, what).map_err(|error| error.to_string())?;
        (encoded.frame, encoded.channel)
    };
    if period.is_none() && !modifiers.is_empty() {
        return Err("counter=, random= and checksum= need a period, such as 100ms".to_owned());
    }
    check_modifiers(&frame, &modifiers).map_err(|error| error.to_string())?;
    let channel = channel.or(of_database).unwrap_or(1);
    let text = text.to_owned();
    Ok(SendEntry { text, channel, frame, period, modifiers, changing, group, slot: None, sent: 0 })
}
