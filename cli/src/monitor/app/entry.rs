//! A frame in the send list, and how it is typed.

use std::time::Duration;

use cantap::{Channel, Frame};
use cantap_signals::encode;

use super::super::model::Model;

/// A frame in the send list.
#[derive(Clone, Debug, PartialEq)]
pub struct SendEntry {
    /// As typed: a frame, or a message with its signals.
    pub text: String,
    /// Where to.
    pub channel: Channel,
    /// The frame.
    pub frame: Frame,
    /// How often; once per key without.
    pub period: Option<Duration>,
    /// The device's slot that sends it now, if one does.
    pub slot: Option<u8>,
    /// How often it was sent by key.
    pub sent: u64,
}

/// A line of the send list: `[CHANNEL:]FRAME [PERIOD]`, or a message with its signals in the frame's place.
pub fn parse_entry(text: &str, model: &Model) -> Result<SendEntry, String> {
    let (what, period) = match text.split_once(char::is_whitespace) {
        Some((what, period)) => (what, Some(crate::args::duration(period.trim())?)),
        None => (text, None),
    };
    if period.is_some_and(|period| period.is_zero()) {
        return Err("a period must be longer than nothing, such as 100ms".to_owned());
    }
    let (channel, what) = match what.split_once(':') {
        Some((number @ ("1" | "2"), what)) => (number.parse().ok().and_then(Channel::from_number), what),
        _ => (None, what),
    };
    let (frame, of_database) = if what.contains('#') {
        (what.parse::<Frame>().map_err(|error| error.to_string())?, None)
    } else {
        let number = channel.map(Channel::number);
        let encoded =
            encode::encode(model.seen.signals.decoder(), number, what).map_err(|error| error.to_string())?;
        (encoded.frame, encoded.channel.and_then(Channel::from_number))
    };
    let channel = channel.or(of_database).unwrap_or(Channel::Can1);
    Ok(SendEntry { text: text.to_owned(), channel, frame, period, slot: None, sent: 0 })
}
