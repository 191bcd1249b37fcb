//! A channel that a program with a protocol of its own has open. It is only listened to until that program sends: then the bus is left for a
//! moment, and joined as a node that acknowledges.

use std::sync::Arc;
use std::time::{Duration, Instant};

use cantap::{Device, DeviceError};
use cantap_trace::TraceFrame;
use cantap_wire::Channel;
use cantap_wire::message::{ChannelConfig, Mode, TxFdFrame, TxFrame};

/// Tags wrap here: far below the board's own.
const TAGS: u32 = 1 << 24;

/// An open channel.
pub struct OpenBus {
    /// The client's session with the board.
    pub device: Arc<Device>,
    /// Which.
    pub channel: Channel,
    /// How it is open.
    pub config: ChannelConfig,
    /// The mode for sending, if the client may send.
    pub sends_in: Option<Mode>,
    next_tag: u32,
    /// When it last had something sent.
    sent_at: Instant,
    /// After sending nothing for this long, it only listens again.
    idle_after: Option<Duration>,
}

impl OpenBus {
    pub fn new(
        device: Arc<Device>,
        channel: Channel,
        config: ChannelConfig,
        sends_in: Option<Mode>,
        idle_after: Option<Duration>,
    ) -> Self {
        Self { device, channel, config, sends_in, next_tag: 0, sent_at: Instant::now(), idle_after }
    }

    /// Opens the bus for sending, when a client sends. `missed` is called if the client has missed what was on the bus meanwhile.
    pub fn may_send(&mut self, missed: impl FnOnce()) -> Result<(), String> {
        let Some(mode) = self.sends_in else { return Err("the bus was opened to listen only".to_owned()) };
        self.sent_at = Instant::now();
        if self.config.mode == mode { Ok(()) } else { self.change_mode(mode, missed) }
    }

    /// Something that it sent repeatedly has ended: from now on, it sends nothing.
    pub fn has_ended_sending(&mut self) {
        self.sent_at = Instant::now();
    }

    /// Only listens again, if nothing was sent for long enough: a client need not say anything, and one that has been stopped would keep
    /// the board acknowledging for ever. Returns for how long, if it does.
    pub fn listen_again(&mut self, missed: impl FnOnce()) -> Result<Option<Duration>, String> {
        let is_idle = |after: &Duration| self.sent_at.elapsed() >= *after;
        let Some(after) = self.idle_after.filter(is_idle) else { return Ok(None) };
        if self.config.mode == Mode::ListenOnly {
            return Ok(None);
        }
        self.change_mode(Mode::ListenOnly, missed)?;
        Ok(Some(after))
    }

    /// Opens the channel in another mode, or, if that is refused, as before.
    pub fn change_mode(&mut self, mode: Mode, missed: impl FnOnce()) -> Result<(), String> {
        let reason = |error: DeviceError| error.to_string();
        let config = ChannelConfig { mode, ..self.config };
        self.device.close_channel(self.channel).map_err(reason)?;
        let opened = self.device.open_channel(self.channel, Some(config));
        if opened.is_err() {
            self.device.open_channel(self.channel, Some(self.config)).map_err(reason)?;
        }
        missed();
        self.config = opened.map_err(reason)?;
        Ok(())
    }

    /// The tag of the next frame.
    pub const fn next_tag(&mut self) -> u32 {
        let tag = self.next_tag;
        self.next_tag = (tag + 1) % TAGS;
        tag
    }

    /// Has a frame sent; the bus must be open for it.
    pub fn send(&self, tag: u32, frame: impl Into<TraceFrame>) -> Result<(), String> {
        let (channel, at_ticks) = (self.channel, None);
        let sent = match frame.into() {
            TraceFrame::Classic(frame) => self.device.send(channel, &[TxFrame { tag, frame, at_ticks }]),
            TraceFrame::Fd(frame) => self.device.send_fd(channel, &[TxFdFrame { tag, frame, at_ticks }]),
        };
        sent.map(drop).map_err(|error| error.to_string())
    }
}
