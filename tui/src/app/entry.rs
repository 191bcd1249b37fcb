//! A frame in the send list, and how it is typed.

use std::time::Duration;

use cantap::Frame;
use cantap_signals::encode;
use cantap_trace::grammar;

use super::super::model::Model;
use cantap_work::channels::MOST_CHANNELS;

/// A frame in the send list.
#[derive(Clone, Debug, PartialEq)]
pub struct SendEntry {
    /// As typed: a frame, or a message with its signals.
    pub text: String,
    /// The channel's number, from 1.
    pub channel: u8,
    /// The frame.
    pub frame: Frame,
    /// The period; `None` to send once per key press.
    pub period: Option<Duration>,
    /// The device's slot that is sending it, if any.
    pub slot: Option<u8>,
    /// How often it was sent by key.
    pub sent: u64,
}

/// A line of the send list: `[CHANNEL:]FRAME [PERIOD]`, or a message with its signals instead of the frame.
pub fn parse_entry(text: &str, model: &Model) -> Result<SendEntry, String> {
    let (what, period) = match text.split_once(char::is_whitespace) {
        Some((what, period)) => (what, Some(grammar::duration(period.trim())?)),
        None => (text, None),
    };
    if period.is_some_and(|period| period.is_zero()) {
        return Err("a period must be longer than nothing, such as 100ms".to_owned());
    }
    let (channel, what) = match what.split_once(':') {
        Some((number, rest)) => match grammar::channel(number).filter(|number| *number <= MOST_CHANNELS) {
            Some(number) => (Some(number), rest),
            None => (None, what),
        },
        None => (None, what),
    };
    let (frame, of_database) = if what.contains('#') {
        (grammar::frame(what)?, None)
    } else {
        let encoded =
            encode::encode(model.seen.signals.decoder(), channel, what).map_err(|error| error.to_string())?;
        (encoded.frame, encoded.channel)
    };
    let channel = channel.or(of_database).unwrap_or(1);
    Ok(SendEntry { text: text.to_owned(), channel, frame, period, slot: None, sent: 0 })
}
