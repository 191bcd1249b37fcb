//! A frame as scripts see it.

use cantap_can::{Channel, Frame};
use cantap_trace::grammar;
use rhai::{Blob, Engine};

use crate::script_result::Result;

/// A frame with where and when it was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScriptFrame {
    /// The bus that it was or will be on.
    pub channel: Channel,
    /// The frame.
    pub frame: Frame,
    /// When it ended, in nanoseconds since the run began.
    pub at_ns: u64,
}

impl ScriptFrame {
    /// One that was on no bus.
    pub const fn new(frame: Frame) -> Self {
        Self { channel: Channel::Can1, frame, at_ns: 0 }
    }

    /// From can-utils' text, as `123#0102`.
    pub fn parse(text: &str) -> std::result::Result<Self, String> {
        grammar::frame(text).map(Self::new)
    }
}

/// A channel by its number.
pub fn channel_of(number: i64) -> Result<Channel> {
    let channel = u8::try_from(number).ok().and_then(Channel::from_number);
    channel.ok_or_else(|| format!("there is no channel {number}; there are 1 and 2").into())
}

/// Makes frames known to an engine.
pub fn register(engine: &mut Engine) {
    engine
        .register_type_with_name::<ScriptFrame>("Frame")
        .register_get("id", |frame: &mut ScriptFrame| i64::from(frame.frame.id().raw()))
        .register_get("extended", |frame: &mut ScriptFrame| frame.frame.id().is_extended())
        .register_get("remote", |frame: &mut ScriptFrame| frame.frame.is_remote())
        .register_get("dlc", |frame: &mut ScriptFrame| i64::from(frame.frame.dlc()))
        .register_get("data", |frame: &mut ScriptFrame| -> Blob { frame.frame.data().to_vec() })
        .register_get("channel", |frame: &mut ScriptFrame| i64::from(frame.channel.number()))
        .register_get("time", |frame: &mut ScriptFrame| frame.at_ns as f64 / 1e9)
        .register_fn("to_string", |frame: &mut ScriptFrame| frame.frame.to_string())
        .register_fn("to_debug", |frame: &mut ScriptFrame| frame.frame.to_string())
        .register_fn("==", |a: ScriptFrame, b: ScriptFrame| a.frame == b.frame && a.channel == b.channel)
        .register_fn("!=", |a: ScriptFrame, b: ScriptFrame| a.frame != b.frame || a.channel != b.channel);
}
