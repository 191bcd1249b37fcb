//! A board that the page itself has open, on a serial port of the browser: its bytes become the records of a live trace.
//!
//! The page moves bytes and tells the time, which WebAssembly has none of; the session is the library's [`Listener`], which only listens.

use cantap::device::UtcNs;
use cantap::listener::{Listener, Stage};
use cantap_trace::{TraceEvent, TraceRecord};
use cantap_wire::{CHANNELS, Channel, USB_PID, USB_VID};
use serde::{Deserialize, Serialize};

use crate::message::{Bytes, Sections};

/// What one read of the port brought.
#[derive(Deserialize)]
pub struct Piece {
    pub bytes: Bytes,
    /// When, in milliseconds since 1970.
    pub at: f64,
}

/// The answer to `boardUsb` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct UsbId {
    vendor_id: u16,
    product_id: u16,
}

/// What messages call the place of the board: a page is not told more.
const ADDRESS: &str = "USB";

/// How a board is recognised.
pub const USB_ID: UsbId = UsbId { vendor_id: USB_VID, product_id: USB_PID };

/// `BoardState` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct BoardState {
    stage: &'static str,
    error: Option<String>,
    device: Option<String>,
    firmware: Option<String>,
    channels: Vec<ChannelState>,
    corrupt: u64,
    uncertainty_ns: Option<i64>,
    /// To be written to the port.
    pub write: Bytes,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct ChannelState {
    channel: u8,
    bitrate: u32,
    mode: &'static str,
    state: &'static str,
    counters: (u8, u8),
    received: u64,
    lost: u64,
    /// What the device says it took from its controller, and what that lost: received and lost, once the channel is closed.
    counted: u64,
}

/// A session, and the trace's end as far as it matters to the next one.
pub struct Board {
    listener: Listener,
    latest_ns: i64,
}

/// A time of the page: milliseconds since 1970, to a fraction of a microsecond.
fn utc(ms: f64) -> UtcNs {
    UtcNs((ms * 1e6) as i64)
}

impl Board {
    /// Begins a session. `bitrates`: of each channel that is opened, in bit/s. A trace that goes on is given the `latest_ns` of its records.
    pub fn open(bitrates: [Option<u32>; CHANNELS], now: f64, latest_ns: Option<i64>) -> Self {
        let latest_ns = latest_ns.unwrap_or(i64::MIN);
        Self { listener: Listener::new(ADDRESS, bitrates, utc(now)).after(latest_ns), latest_ns }
    }

    /// Whether the session still runs.
    pub fn is_open(&self) -> bool {
        self.listener.stage() != Stage::Over
    }

    /// Takes what one read brought, or nothing.
    pub fn take(&mut self, bytes: &[u8], at: f64) {
        self.listener.take(bytes, utc(at));
    }

    /// Closes the channels.
    pub fn stop(&mut self) {
        self.listener.stop();
    }

    /// The port is gone.
    pub fn vanished(&mut self, reason: &str) {
        self.listener.vanished(reason);
    }

    /// The records that have come.
    pub fn records(&mut self) -> Vec<TraceRecord> {
        let records = std::mem::take(self.listener.records());
        self.latest_ns = records.last().map_or(self.latest_ns, |last| last.time_ns);
        records
    }

    /// What stands between this session and another one in the same trace: from the last record on, nothing is known of the channels.
    pub fn gap(&self) -> Vec<TraceRecord> {
        if self.latest_ns == i64::MIN {
            return Vec::new();
        }
        let gap = |channel: Channel| TraceRecord {
            time_ns: self.latest_ns,
            device_ns: None,
            channel: channel.number(),
            event: TraceEvent::GAP,
        };
        // One that was lost has left its own.
        let in_order = self.listener.error().is_none();
        self.listener.channels().filter(|_| in_order).map(|(channel, _)| gap(channel)).collect()
    }

    /// The time of the last record.
    pub const fn latest_ns(&self) -> i64 {
        self.latest_ns
    }

    /// What the page shows and writes.
    pub fn state(&mut self, sections: &mut Sections) -> BoardState {
        let write = sections.bytes(&self.listener.output());
        let uncertainty_ns = self.listener.clock().uncertainty_ns;
        let listener = &self.listener;
        let hello = listener.hello();
        let counters = listener.counters();
        let channel = |(channel, config): (Channel, cantap_wire::message::ChannelConfig)| {
            let status = listener.status().map(|status| status.channels[channel.index()]);
            let counted = counters.channels[channel.index()];
            ChannelState {
                channel: channel.number(),
                bitrate: config.timing.bitrate_bps(hello.map_or(1, |hello| hello.can_clock_hz)),
                mode: config.mode.name(),
                state: status.map_or("", |status| status.state.name()),
                counters: status.map_or((0, 0), |status| (status.tec, status.rec)),
                received: counted.received,
                lost: counted.lost(),
                counted: status.map_or(0, |of| u64::from(of.frames) + u64::from(of.lost_controller)),
            }
        };
        BoardState {
            stage: match listener.stage() {
                Stage::Greeting => "greeting",
                Stage::Opening => "opening",
                Stage::Listening => "listening",
                Stage::Stopping => "stopping",
                Stage::Over => "over",
            },
            error: listener.error().map(ToString::to_string),
            device: hello.map(|hello| format!("{} {}", hello.board, hello.serial)),
            firmware: hello.map(|hello| hello.firmware.map(|part| part.to_string()).join(".")),
            channels: listener.channels().map(channel).collect(),
            corrupt: counters.corrupt,
            uncertainty_ns,
            write,
        }
    }
}
