//! Writing TRC.

use super::super::bit_rates::{self, BitRates};
use super::super::calendar::{Date, NS_PER_DAY, start_of_trace};
use super::super::codec::Encode;
use super::super::event_text;
use super::super::left_out::LeftOut;
use super::super::text;
use super::super::writer::WriteOptions;
use super::super::zone::Zone;
use super::{BIT_RATE, EPOCH_DAY, TrcVersion, WARNING_ID, bit_rate_text, error_code, status_of};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

const NS_PER_MS: i64 = 1_000_000;

const NO_BUS: &str = "the channel of frames, which this version of TRC has no column for";

/// Writes TRC.
pub(crate) struct Encoder {
    version: TrcVersion,
    start_ns: Option<i64>,
    /// Number of rows so far.
    rows: u64,
    /// The zone of the date.
    zone: Zone,
    bit_rates: BitRates,
}

/// The last rows of every version's header, without the leading `;`: the columns' names.
fn legend(version: TrcVersion) -> &'static [&'static str] {
    match version {
        TrcVersion::V1_0 => &[
            "    Columns description:",
            "    ~~~~~~~~~~~~~~~~~~~~~",
            "    +-current number in actual sample",
            "    |       +time offset of message (ms)",
            "    |       |         +ID of message (hex)",
            "    |       |         |     +data length code",
            "    |       |         |     |   +data bytes (hex) ...",
            "    |       |         |     |   |",
            "----+-   ---+---  ----+---  +  -+ -- -- ...",
        ],
        TrcVersion::V1_1 => &[
            "   Message Number",
            "   |         Time Offset (ms)",
            "   |         |        Type",
            "   |         |        |        ID (hex)",
            "   |         |        |        |     Data Length",
            "   |         |        |        |     |   Data Bytes (hex) ...",
            "   |         |        |        |     |   |",
            "---+--   ----+----  --+--  ----+---  +  -+ -- -- -- -- -- -- --",
        ],
        TrcVersion::V1_2 => &[
            "   Message Number",
            "   |         Time Offset (ms)",
            "   |         |       Bus",
            "   |         |       |    Type",
            "   |         |       |    |       ID (hex)",
            "   |         |       |    |       |    Data Length Code",
            "   |         |       |    |       |    |    Data Bytes (hex) ...",
            "   |         |       |    |       |    |    |",
            "---+-- ------+------ +- --+-- ----+--- +--- -+ -- -- -- -- -- -- --",
        ],
        TrcVersion::V1_3 => &[
            "   Message Number",
            "   |         Time Offset (ms)",
            "   |         |       Bus",
            "   |         |       |    Type",
            "   |         |       |    |       ID (hex)",
            "   |         |       |    |       |    Reserved",
            "   |         |       |    |       |    |   Data Length Code",
            "   |         |       |    |       |    |   |    Data Bytes (hex) ...",
            "   |         |       |    |       |    |   |    |",
            "---+-- ------+------ +- --+-- ----+--- +- -+-- -+ -- -- -- -- -- -- --",
        ],
        TrcVersion::V2_0 => &[
            "   Message   Time    Type ID     Rx/Tx",
            "   Number    Offset  |    [hex]  |  Data Length",
            "   |         [ms]    |    |      |  |  Data [hex] ...",
            "   |         |       |    |      |  |  |",
            "---+-- ------+------ +- --+----- +- +- +- -- -- -- -- -- -- --",
        ],
        TrcVersion::V2_1 => &[
            "   Message   Time    Type    ID     Rx/Tx",
            "   Number    Offset  |  Bus  [hex]  |  Reserved",
            "   |         [ms]    |  |    |      |  |  Data Length Code",
            "   |         |       |  |    |      |  |  |    Data [hex] ...",
            "   |         |       |  |    |      |  |  |    |",
            "---+-- ------+------ +- +- --+----- +- +- +--- +- -- -- -- -- -- -- --",
        ],
    }
}

/// A time as days since 1899-12-30, exact to a nanosecond.
fn days(time_ns: i64) -> String {
    const DIGITS: u32 = 15;
    let days = time_ns.div_euclid(NS_PER_DAY) + EPOCH_DAY;
    let of_day = i128::from(time_ns.rem_euclid(NS_PER_DAY));
    let ns_per_day = i128::from(NS_PER_DAY);
    let fraction = (of_day * 10_i128.pow(DIGITS) + ns_per_day / 2) / ns_per_day;
    format!("{days}.{fraction:015}")
}

impl Encoder {
    /// `zone` is the zone of the file's date.
    pub(crate) fn new(version: TrcVersion, options: &WriteOptions) -> Self {
        let bit_rates = bit_rates::known(&options.channels);
        Self { version, start_ns: None, rows: 0, zone: options.zone.clone(), bit_rates }
    }

    fn head(&mut self, first_ns: i64, out: &mut Vec<u8>) -> i64 {
        let start_ns = start_of_trace(first_ns);
        self.start_ns = Some(start_ns);
        let clock_ns = self.zone.clock_ns(start_ns);
        let date = Date::of(clock_ns);
        let (hour, minute, second, ns) = date.clock();
        let (day, month, year, ms) = (date.day, date.month, date.year, ns / 1_000_000);
        let start = format!("{day:02}.{month:02}.{year:04} {hour:02}:{minute:02}:{second:02}.{ms:03}");
        let mut lines = Vec::new();
        let rule = "-".repeat(79);
        if self.version == TrcVersion::V1_0 {
            lines.extend(["#".repeat(74), String::new()]);
            lines.push(format!("    Start time: {start}"));
            lines.extend([
                "    PCAN-Net: N/A".to_owned(),
                "    Generated by cantap".to_owned(),
                String::new(),
            ]);
        } else {
            lines.push(format!("$FILEVERSION={}", self.version.name()));
            lines.push(format!("$STARTTIME={}", days(clock_ns)));
            match self.version {
                TrcVersion::V2_0 => lines.push("$COLUMNS=N,O,T,I,d,l,D".to_owned()),
                TrcVersion::V2_1 => lines.push("$COLUMNS=N,O,T,B,I,d,R,L,D".to_owned()),
                _ => {}
            }
            // PEAK's headers have tenths of a millisecond here in 1.1, and microseconds in later versions.
            let more = if self.version < TrcVersion::V1_2 { "0" } else { "000" };
            lines.extend([String::new(), format!("   Start time: {start}.{more}")]);
            lines.extend(["   Generated by cantap".to_owned(), rule.clone()]);
        }
        if !self.bit_rates.is_empty() {
            lines.push(format!("   Bus  Name     Connection  Protocol  {BIT_RATE}"));
            let row = |(channel, bps): &(u8, u32)| {
                let name = cantap_trace::Interface(*channel).to_string();
                format!("   {channel:<4} {name:<8} cantap      CAN       {}", bit_rate_text(*bps))
            };
            lines.extend(self.bit_rates.iter().map(row));
            lines.push(rule);
        }
        lines.extend(legend(self.version).iter().map(|line| (*line).to_owned()));
        for line in lines {
            out.push(b';');
            out.extend_from_slice(line.as_bytes());
            out.extend_from_slice(b"\r\n");
        }
        start_ns
    }

    /// The number and time of a row, and a space.
    #[inline]
    fn row(&mut self, time_ns: i64, out: &mut Vec<u8>) {
        self.rows += 1;
        let at = out.len();
        text::push_decimal(out, self.rows);
        if self.version < TrcVersion::V2_0 {
            out.push(b')');
        }
        text::pad_left(out, at, 7);
        out.push(b' ');
        let at = out.len();
        text::push_time(out, time_ns, NS_PER_MS, self.version.decimals(), b'.');
        let width = match self.version {
            TrcVersion::V1_0 => 9,
            TrcVersion::V1_1 => 11,
            _ => 13,
        };
        text::pad_left(out, at, width);
        out.push(b' ');
    }

    /// The bus column, if there is one.
    fn bus(&self, channel: u8, out: &mut Vec<u8>) {
        if self.version.has_bus() {
            let at = out.len();
            text::push_decimal(out, u64::from(channel));
            text::pad_right(out, at, 3);
            // PEAK's buses have up to two digits, Vector's and ours three.
            if channel >= 100 {
                out.push(b' ');
            }
        }
    }

    fn frame(
        &mut self,
        record: &TraceRecord,
        frame: &cantap_can::Frame,
        direction: Direction,
        out: &mut Vec<u8>,
        left_out: &mut LeftOut,
    ) {
        let version = self.version;
        if !version.has_bus() && record.channel != 1 {
            left_out.note(NO_BUS);
        }
        let direction_text: &[u8] = match direction {
            Direction::Rx => b"Rx",
            Direction::Tx => b"Tx",
        };
        if version == TrcVersion::V1_0 && direction == Direction::Tx {
            left_out.note("the direction of sent frames, which TRC 1.0 has no column for");
        }
        let id = |out: &mut Vec<u8>| {
            if frame.id().is_extended() {
                text::push_hex(out, frame.id().raw(), 8);
            } else {
                out.extend_from_slice(b"    ");
                text::push_hex(out, frame.id().raw(), 4);
            }
        };
        if version >= TrcVersion::V2_0 {
            out.extend_from_slice(if frame.is_remote() { b"RR " } else { b"DT " });
            self.bus(record.channel, out);
            id(out);
            out.push(b' ');
            out.extend_from_slice(direction_text);
            out.push(b' ');
        } else {
            if version == TrcVersion::V1_0 {
                out.push(b' ');
            } else {
                if version == TrcVersion::V1_1 {
                    out.push(b' ');
                }
                self.bus(record.channel, out);
                out.extend_from_slice(direction_text);
                out.extend_from_slice(if version == TrcVersion::V1_1 { b"     " } else { b"    " });
            }
            id(out);
            out.push(b' ');
        }
        if matches!(version, TrcVersion::V1_3 | TrcVersion::V2_1) {
            out.extend_from_slice(b"-  ");
        } else if version < TrcVersion::V1_2 {
            out.push(b' ');
        }
        let at = out.len();
        let dlc = if version.has_length() { frame.dlc().min(8) } else { frame.dlc() };
        if dlc != frame.dlc() {
            left_out.note("length codes above 8, in whose place this version of TRC has the number of bytes");
        }
        text::push_decimal(out, u64::from(dlc));
        let last = match version {
            TrcVersion::V1_0 | TrcVersion::V1_1 | TrcVersion::V2_0 => 2,
            _ => 4,
        };
        if frame.is_remote() {
            if version < TrcVersion::V2_0 {
                text::pad_right(out, at, last);
                out.extend_from_slice(b" RTR");
            }
        } else if dlc > 0 {
            text::pad_right(out, at, last);
            for byte in frame.data() {
                out.push(b' ');
                text::push_hex_byte(out, *byte);
            }
        }
    }

    /// A CAN FD frame; version 2 has rows for these.
    fn flexible(
        &mut self,
        record: &TraceRecord,
        frame: &FdFrame,
        direction: Direction,
        out: &mut Vec<u8>,
        left_out: &mut LeftOut,
    ) {
        if !self.version.has_bus() && record.channel != 1 {
            left_out.note(NO_BUS);
        }
        out.extend_from_slice(match (frame.brs(), frame.esi()) {
            (false, false) => b"FD ",
            (true, false) => b"FB ",
            (false, true) => b"FE ",
            (true, true) => b"BI ",
        });
        self.bus(record.channel, out);
        let id = frame.id();
        let (digits, spaces) = if id.is_extended() { (8, 0) } else { (4, 4) };
        out.resize(out.len() + spaces, b' ');
        text::push_hex(out, id.raw(), digits);
        out.extend_from_slice(if direction == Direction::Tx { b" Tx " } else { b" Rx " });
        let (number, width) = if self.version.has_length() {
            (frame.data_len() as u8, 2)
        } else {
            out.extend_from_slice(b"-  ");
            (frame.dlc(), 4)
        };
        let at = out.len();
        text::push_decimal(out, u64::from(number));
        if frame.data_len() > 0 {
            text::pad_right(out, at, width);
        }
        for byte in frame.data() {
            out.push(b' ');
            text::push_hex_byte(out, *byte);
        }
    }

    /// An event in a row of version 1: a warning or an error, followed by the exact text.
    fn event_1(&self, record: &TraceRecord, out: &mut Vec<u8>) {
        // In 1.0, only a warning's row is distinguishable from a frame's for every program.
        let error = match record.event {
            TraceEvent::BusError { kind, counters } if self.version > TrcVersion::V1_0 => {
                Some((error_code(kind), counters.unwrap_or_default()))
            }
            _ => None,
        };
        let [kind, id, data] = if let Some(((class, position), (tec, rec))) = error {
            let data = format!("00 {position:02X} {rec:02X} {tec:02X}");
            ["Error ".to_owned(), format!("    {class:04X}"), data]
        } else {
            let [a, b, c, d] = status_of(&record.event).to_be_bytes();
            let id = String::from_utf8_lossy(WARNING_ID).into_owned();
            ["Warng ".to_owned(), id, format!("{a:02X} {b:02X} {c:02X} {d:02X}")]
        };
        if self.version > TrcVersion::V1_0 {
            self.bus(record.channel, out);
            out.extend_from_slice(kind.as_bytes());
        }
        out.extend_from_slice(id.as_bytes());
        out.extend_from_slice(if self.version == TrcVersion::V1_3 { b" -  4  " } else { b"  4  " });
        out.extend_from_slice(data.as_bytes());
        out.push(b' ');
        push_text(record, out);
    }

    /// An event in version 2: a row with the exact text, then a row in the format's own form, if it has one.
    fn event_2(&mut self, record: &TraceRecord, offset_ns: i64, out: &mut Vec<u8>) {
        out.extend_from_slice(b"EV ");
        push_text(record, out);
        let native = match record.event {
            TraceEvent::BusError { kind, counters } => {
                let (class, position) = error_code(kind);
                let (tec, rec) = counters.unwrap_or_default();
                Some(("ER", vec![class, 0, position, rec, tec]))
            }
            TraceEvent::Lost { .. } | TraceEvent::State { .. } => {
                Some(("ST", status_of(&record.event).to_be_bytes().to_vec()))
            }
            _ => None,
        };
        let Some((kind, data)) = native else { return };
        out.extend_from_slice(b"\r\n");
        self.row(offset_ns, out);
        out.extend_from_slice(kind.as_bytes());
        out.push(b' ');
        self.bus(record.channel, out);
        if self.version == TrcVersion::V2_1 {
            out.extend_from_slice(format!("       - Rx -  {:<4}", data.len()).as_bytes());
        } else {
            out.extend_from_slice(b"         Rx   ");
        }
        for byte in data {
            out.push(b' ');
            text::push_hex_byte(out, byte);
        }
    }
}

/// The channel and the exact text of an event.
fn push_text(record: &TraceRecord, out: &mut Vec<u8>) {
    out.extend_from_slice(format!("CAN {} ", record.channel).as_bytes());
    event_text::push_marked(out, &record.event);
}

impl Encode for Encoder {
    #[inline]
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut) {
        let start_ns = match self.start_ns {
            Some(start_ns) => start_ns,
            None => self.head(record.time_ns, out),
        };
        let offset_ns = record.time_ns.saturating_sub(start_ns);
        if self.version < TrcVersion::V2_0 && record.frame().is_some_and(TraceFrame::is_fd) {
            left_out.note("CAN FD frames, which TRC has since version 2.0");
            return;
        }
        let resolution_ns = NS_PER_MS / 10_i64.pow(self.version.decimals());
        if resolution_ns > 1000 && offset_ns % resolution_ns != 0 {
            left_out.note("the digits of times beyond this version's resolution");
        }
        self.row(offset_ns, out);
        match &record.event {
            TraceEvent::Frame { frame: TraceFrame::Fd(frame), direction, .. } => {
                self.flexible(record, frame, *direction, out, left_out);
            }
            TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction, .. } => {
                self.frame(record, frame, *direction, out, left_out);
            }
            _ if self.version >= TrcVersion::V2_0 => self.event_2(record, offset_ns, out),
            _ => self.event_1(record, out),
        }
        out.extend_from_slice(b"\r\n");
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        if self.start_ns.is_none() {
            self.head(0, out);
        }
    }
}
