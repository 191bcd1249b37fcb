//! The requests: `Requests` in `api.ts`.

use cantap_wire::CHANNELS;
use serde::Deserialize;

use crate::board::Piece;
use crate::descriptions::Connections;
use crate::message::Bytes;
use crate::own_database::SignalEdit;

/// A request with its parameters. Times are in seconds since the first record; `None` is before the beginning, or after the end.
#[derive(Deserialize)]
#[serde(tag = "request", content = "parameters", rename_all = "camelCase", rename_all_fields = "camelCase")]
pub enum Request {
    Open { name: String, bytes: Bytes, more: bool, size: Option<u64>, keep: Option<usize> },
    Append { bytes: Bytes, more: bool },
    Summary {},
    Bitrate { channel: u8, bitrate: u32, data_bitrate: Option<u32> },
    Database { name: String, bytes: Bytes, channel: Option<u8> },
    Connections(Connections),
    Messages {},
    Filter { filter: String },
    Rows { view: u32, from: usize, count: usize },
    RowAt { view: u32, time: Option<f64> },
    Find { view: u32, text: String, from: i64, backwards: bool },
    Decode { index: usize },
    Ids { at: Option<f64> },
    Bits { channel: u8, id: u32, extended: bool, from: Option<f64>, to: Option<f64> },
    Series { signal: u64, from: Option<f64>, to: Option<f64>, columns: usize },
    RawSeries(Box<RawSeries>),
    Load { channel: u8, from: Option<f64>, to: Option<f64>, columns: usize },
    Gaps { from: Option<f64>, to: Option<f64> },
    Interval { from: f64, to: f64 },
    Periods { channel: u8, id: u32, extended: bool },
    Conversations { from: Option<f64>, to: Option<f64>, limit: usize },
    Fields { records: usize },
    FieldSeries { field: usize, from: Option<f64>, to: Option<f64>, columns: usize },
    Findings {},
    EditSignal(Box<SignalEdit>),
    SetOwnDatabase { dbc: String },
    Export { view: u32, format: String, from: Option<f64>, to: Option<f64> },
    Formats {},
    BoardUsb {},
    BoardOpen { name: String, bitrates: [Option<u32>; CHANNELS], now: f64, again: bool },
    BoardTake { pieces: Vec<Piece>, now: f64 },
    BoardStop {},
    BoardVanished { reason: String },
}

/// The parameters of `rawSeries`.
#[derive(Deserialize)]
pub struct RawSeries {
    #[serde(flatten)]
    pub edit: SignalEdit,
    pub from: Option<f64>,
    pub to: Option<f64>,
    pub columns: usize,
}
