//! What a page shows of the device, besides what is received. It is sent whole whenever it has changed.

use serde::Serialize;

/// Of everything.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct State {
    /// Whether the command allows sending and taking part.
    pub may_send: bool,
    /// Whether pages may choose bit rates and filters.
    pub may_configure: bool,
    /// Whether pages may begin recordings.
    pub may_record: bool,
    /// The option of the command that allows sending.
    pub send_option: String,
    /// The devices in the order of their channels.
    pub devices: Vec<DeviceState>,
    /// The open channels.
    pub channels: Vec<ChannelState>,
    /// Whether the channels take part in their buses.
    pub is_normal: bool,
    /// What passes, in candump's syntax; empty for everything.
    pub filters: Vec<String>,
    /// The recording that is under way.
    pub recording: Option<RecordingState>,
    /// What the device sends by itself.
    pub periodic: Vec<PeriodicState>,
    /// What a vehicle answers, once it was asked.
    pub vehicle: Option<VehicleState>,
    /// How many pages are open.
    pub pages: usize,
    /// Why nothing is received any more, if so.
    pub ended: Option<String>,
}

/// Of one device.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct DeviceState {
    /// Its address.
    pub name: String,
    /// Whether it is there.
    pub is_there: bool,
    /// Why it is not.
    pub reason: Option<String>,
}

/// Of one channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct ChannelState {
    /// From 1.
    pub channel: u8,
    /// Bit/s; none where somebody else has set it and nobody here knows.
    pub bitrate: Option<u32>,
    /// The controller's state, by its name: `active`, `warning`, `passive`, `bus-off`.
    pub state: &'static str,
    /// Transmit and receive error counters.
    pub counters: (u8, u8),
}

/// Of a recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct RecordingState {
    /// The file's name.
    pub name: String,
    /// Records written.
    pub records: u64,
    /// Bytes on the disk.
    pub bytes: u64,
    /// Whole seconds from its first record to the latest one that arrived.
    pub seconds: u64,
    /// The condition around whose events records are written, if that is not all of them.
    pub condition: Option<String>,
    /// How often it came true.
    pub events: u64,
}

impl RecordingState {
    /// Of a recording, by the time of what arrived last, in nanoseconds.
    pub fn new(state: cantap_work::recording::RecordingState, latest_ns: i64) -> Self {
        let length_ns = if state.records == 0 { 0 } else { latest_ns.saturating_sub(state.since_ns) };
        Self {
            name: state.path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            records: state.records,
            bytes: state.bytes,
            seconds: u64::try_from(length_ns / 1_000_000_000).unwrap_or(0),
            condition: state.condition,
            events: state.events,
        }
    }
}

/// Of a frame that the device sends periodically.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct PeriodicState {
    /// From 1.
    pub channel: u8,
    /// Its place on the device.
    pub slot: u8,
    /// As candump writes it.
    pub frame: String,
    /// Milliseconds.
    pub period_ms: f64,
}

/// Of a vehicle that is asked by OBD-II.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct VehicleState {
    /// Whether it is being asked.
    pub is_asked: bool,
    /// How that goes, in a sentence.
    pub text: String,
    /// Its VIN, trouble codes and values.
    pub rows: Vec<VehicleRow>,
}

/// What an ECU has answered.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct VehicleRow {
    /// The parameter in hexadecimal, behind its service if that is not the one of current values; empty for trouble codes.
    pub parameter: String,
    /// What the value is.
    pub name: String,
    /// Where the ECU answers from.
    pub ecu: String,
    /// The latest value with its unit.
    pub value: String,
    /// Whether the ECU has answered the last time.
    pub is_current: bool,
    /// The least and the most so far, of numbers.
    pub range: Option<(String, String)>,
}
