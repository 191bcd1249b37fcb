//! The tables that the programs for USBCAN adapters save, CANTest and USB-CAN Tool: columns with Chinese names, in UTF-8 or GBK, or
//! with English ones, between commas or tabs, such as `序号,系统时间,时间标识,CAN通道,传输方向,ID号,帧类型,帧格式,长度,数据` and then
//! `0,="12:04:59.533",0x592897,ch1,接收,0x0009001C,数据帧,扩展帧,0x08,x| 05 C3 8A 43 00 02 EE 00`.
//!
//! As shown by programs that read such files. The adapter's stamp counts tenths of a millisecond, or is in seconds if it has a point.

use std::borrow::Cow;

use encoding_rs::GBK;

use super::calendar::NS_PER_DAY;
use super::frame_fields::{FdFields, FrameFields, Payload, hex_byte, identifier};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::table;
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::fd::FD_MAX_BYTES;
use cantap_trace::{Direction, TraceRecord};

const RESTARTED: &str =
    "the adapter's stamps and the computer's clock went apart: the times go on from the computer's";
const NO_STAMP: &str = "frames that were sent have no stamp: they stand at that of the frame before them";
const NOT_SENT: &str = "frames that could not be sent";

/// A stamp's unit.
const STAMP_NS: i64 = 100_000;

/// Arrival at the computer is later than an adapter's stamp, but never by so much.
const APART_NS: i64 = 2 * NS_PER_S;

/// What a column has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    /// When the computer got it.
    Clock,
    /// When the adapter did; in some files the computer's time of day.
    Stamp,
    Channel,
    Direction,
    Id,
    /// Of one or two words: 11 bits or 29, data or remote, CAN or CAN FD. Programs differ in which they call type, and which format.
    Kind,
    Len,
    Data,
    Other,
}

impl Part {
    fn of_name(name: &str) -> Self {
        let name = name.split(['(', '（']).next().unwrap_or_default().replace(' ', "").to_lowercase();
        match name.as_str() {
            "系统时间" | "systemtime" => Self::Clock,
            "时间标识" | "时间戳" | "时间标签" | "时间" | "timestamp" | "timesteamp" | "time" => {
                Self::Stamp
            }
            "can通道" | "通道" | "通道号" | "第几路can" | "channel" | "canchannel" => Self::Channel,
            "传输方向" | "方向" | "direction" => Self::Direction,
            "id" | "id号" | "帧id" | "canid" | "frameid" => Self::Id,
            "帧类型" | "帧格式" | "can类型" | "type" | "format" => Self::Kind,
            "长度" | "数据长度" | "dlc" | "length" | "len" => Self::Len,
            "数据" | "data" => Self::Data,
            _ => Self::Other,
        }
    }
}

/// Reads a table.
#[derive(Default)]
pub(crate) struct Decoder {
    separator: u8,
    parts: Vec<Part>,
    /// The computer's time and the adapter's at the same frame.
    anchor: Option<(i64, i64)>,
    /// The last time of day, and the days before it.
    day: (i64, i64),
    /// The last frame's time, in nanoseconds; 0 before the first.
    last_ns: i64,
    note: Option<&'static str>,
}

/// A line in UTF-8; GBK has no comma, tab or digit within its characters.
fn utf8(line: &[u8]) -> Cow<'_, str> {
    let line = line.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(line);
    str::from_utf8(line).map_or_else(|_| GBK.decode_without_bom_handling(line).0, Cow::Borrowed)
}

/// What the columns have, if a line is the names above them, and what is between them.
fn head(line: &[u8]) -> Option<(u8, Vec<Part>)> {
    let line = utf8(line);
    let begins =
        ["序号", "Index,Direction,", "Index,System Time,", "Index\tDirection\t", "Index\tSystem Time\t"];
    if !begins.iter().any(|begin| line.starts_with(begin)) {
        return None;
    }
    let separator = if line.contains('\t') { '\t' } else { ',' };
    let parts: Vec<_> = line.split(separator).map(|name| Part::of_name(name.trim())).collect();
    let has = |part| parts.contains(&part);
    let is_whole = has(Part::Id) && has(Part::Data) && (has(Part::Clock) || has(Part::Stamp));
    is_whole.then_some((separator as u8, parts))
}

/// Whether a file's first line is that of such a table.
pub(crate) fn is_head(line: &[u8]) -> bool {
    head(line).is_some()
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() {
            return Ok(Line::Nothing);
        }
        // It may come again in the middle, where files were joined.
        if let Some((separator, parts)) = head(line) {
            (self.separator, self.parts) = (separator, parts);
            return Ok(Line::Nothing);
        }
        let text = utf8(line);
        let separator = char::from(self.separator);
        let cells: Vec<_> = text.split(separator).map(|cell| cell.trim_matches([' ', '=', '"'])).collect();
        if cells.len() < self.parts.iter().rposition(|part| *part != Part::Other).map_or(0, |last| last + 1) {
            return Err(Fault::malformed("a cell for each of the columns", line));
        }
        let parts = std::mem::take(&mut self.parts);
        let read = self.row(&parts, &cells, zone);
        self.parts = parts;
        read
    }

    fn note(&mut self) -> Option<&'static str> {
        self.note.take()
    }
}

/// What the words for the kind of frame say.
#[derive(Default)]
struct Kind {
    extended: Option<bool>,
    remote: bool,
    fd: Option<FdFields>,
}

impl Kind {
    fn add(&mut self, cell: &str) {
        let lower = cell.to_ascii_lowercase();
        let has = |words: &[&str]| words.iter().any(|word| lower.contains(word));
        if has(&["扩展", "ext"]) {
            self.extended = Some(true);
        } else if has(&["标准", "standard", "std"]) {
            self.extended = Some(false);
        }
        self.remote |= has(&["远程", "remote"]);
        if has(&["canfd"]) {
            self.fd = Some(FdFields { brs: has(&["加速", "brs"]), esi: false });
        }
    }
}

impl Decoder {
    fn row(&mut self, parts: &[Part], cells: &[&str], zone: &Zone) -> Result<Line, Fault> {
        let (mut clock, mut stamp, mut channel, mut direction) = (None, None, 1, Direction::Rx);
        let (mut id, mut data, mut len, mut kind) = ("", "", None, Kind::default());
        for (part, cell) in parts.iter().zip(cells) {
            match part {
                Part::Clock => clock = self.clock(cell, zone)?,
                Part::Stamp if cell.contains(':') => clock = self.clock(cell, zone)?,
                Part::Stamp => stamp = stamp_ns(cell)?,
                Part::Channel => channel = channel_of(cell.as_bytes())?,
                Part::Direction => match direction_of(cell)? {
                    Some(way) => direction = way,
                    None => return Ok(Line::LeftOut(NOT_SENT)),
                },
                Part::Id => id = cell,
                Part::Kind => kind.add(cell),
                Part::Len => len = Some(length(cell.as_bytes())?),
                Part::Data => data = cell,
                Part::Other => {}
            }
        }
        let time_ns = match self.time_ns(clock, stamp) {
            Some(time_ns) => time_ns,
            // The adapter stamps what it receives; without the computer's time there is nothing else.
            None if direction == Direction::Tx => {
                self.note = Some(NO_STAMP);
                self.last_ns
            }
            None => return Err(Fault::malformed("a time in each row", b"")),
        };
        self.last_ns = time_ns;
        let digits = id.trim_end_matches(['H', 'h', ' ']).as_bytes();
        let raw = text::number(digits, false);
        let raw =
            raw.ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id.as_bytes()))?;
        let id = identifier(raw, kind.extended.unwrap_or(raw > 0x7FF), id.as_bytes())?;
        let words = data.strip_prefix("x|").unwrap_or(data).split_ascii_whitespace().map(str::as_bytes);
        let len = len.unwrap_or_else(|| words.clone().count());
        let Kind { remote, mut fd, .. } = kind;
        if len > 8 && !remote {
            fd.get_or_insert_default();
        }
        let fields = FrameFields { id, remote, direction, len: len as u8, fd };
        let data =
            if remote { Payload::EMPTY } else { Payload::exactly(words, fields.data_len(), hex_byte)? };
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? }))
    }

    /// The computer's time. One of day goes on after midnight.
    fn clock(&mut self, cell: &str, zone: &Zone) -> Result<Option<i64>, Fault> {
        if cell.is_empty() {
            return Ok(None);
        }
        let fault = || Fault::malformed("a time such as 12:04:59.533", cell.as_bytes());
        if cell.contains(['-', '/']) {
            return table::date(cell.as_bytes(), zone).map(Some).ok_or_else(fault);
        }
        // CANTest has a point before the tenths of a millisecond, too.
        let (whole, part) = cell.split_once('.').unwrap_or((cell, "0"));
        let of_day = table::date(format!("{whole}.{}", part.replace('.', "")).as_bytes(), zone);
        let of_day = of_day.ok_or_else(fault)?;
        let (last, days) = self.day;
        let passed = of_day < last - NS_PER_DAY / 2;
        self.day = (of_day, days + i64::from(passed));
        Ok(Some(of_day + self.day.1 * NS_PER_DAY))
    }

    /// The computer's time as exactly as the adapter's stamps say.
    fn time_ns(&mut self, clock: Option<i64>, stamp: Option<i64>) -> Option<i64> {
        let (Some(clock), Some(stamp)) = (clock, stamp) else { return clock.or(stamp) };
        if let Some((clock_then, stamp_then)) = self.anchor {
            let time_ns = clock_then + (stamp - stamp_then);
            if (time_ns - clock).abs() < APART_NS {
                return Some(time_ns);
            }
            self.note = Some(RESTARTED);
        }
        self.anchor = Some((clock, stamp));
        Some(clock)
    }
}

/// The adapter's time; frames that were sent have none.
fn stamp_ns(cell: &str) -> Result<Option<i64>, Fault> {
    let fault = || Fault::malformed("a stamp such as 0x592897 or 1572.2328", cell.as_bytes());
    match (cell, text::after_0x(cell.as_bytes())) {
        ("" | "-" | "无", _) => Ok(None),
        (_, Some(digits)) => {
            text::hex(digits).map(|ticks| Some(i64::from(ticks) * STAMP_NS)).ok_or_else(fault)
        }
        _ if cell.contains('.') => text::time(cell.as_bytes(), NS_PER_S, b'.').map(Some).ok_or_else(fault),
        _ => Err(fault()),
    }
}

fn channel_of(cell: &[u8]) -> Result<u8, Fault> {
    let digits = cell.iter().rev().take_while(|byte| byte.is_ascii_digit()).count();
    let number = text::decimal(&cell[cell.len() - digits..]).and_then(|number| u8::try_from(number).ok());
    number.ok_or_else(|| Fault::malformed("a channel such as ch1", cell))
}

/// `None` for a frame that was not on the bus.
fn direction_of(cell: &str) -> Result<Option<Direction>, Fault> {
    match cell.to_ascii_lowercase().as_str() {
        "发送失败" => Ok(None),
        "接收" | "receive" | "rx" | "" => Ok(Some(Direction::Rx)),
        "发送" | "发送成功" | "send" | "transmit" | "tx" => Ok(Some(Direction::Tx)),
        _ => Err(Fault::malformed("'接收' or 'Receive', '发送' or 'Send'", cell.as_bytes())),
    }
}

fn length(cell: &[u8]) -> Result<usize, Fault> {
    let len = match text::after_0x(cell) {
        Some(digits) => text::hex(digits).map(u64::from),
        None => text::decimal(cell),
    };
    let len = len.filter(|len| *len <= FD_MAX_BYTES as u64);
    len.map(|len| len as usize).ok_or_else(|| Fault::malformed("a length of 0 to 64", cell))
}

#[cfg(test)]
mod tests {
    use encoding_rs::GBK;

    use super::super::tests;
    use crate::{Format, ReadOptions, TraceReader};

    fn as_log(file: impl AsRef<[u8]>) -> (String, Vec<String>) {
        tests::as_log(Format::UsbCan, file)
    }

    #[test]
    fn the_adapters_stamps_go_on_from_the_first_time_of_day() {
        let table = "序号,系统时间,时间标识,CAN通道,传输方向,ID号,帧类型,帧格式,长度,数据\r\n\
            0,=\"23:59:59.900\",0x592897,ch1,接收,0x0009001C,数据帧,扩展帧,0x08,x| 05 C3 8A 43 00 02 EE 00 \r\n\
            1,=\"00:00:00.100\",0x5928FB,ch2,接收,0x0406,数据帧,标准帧,0x02,x| 06 01 \r\n\
            2,=\"00:00:00.300\",无,ch1,发送,0x0600,远程帧,标准帧,0x04,x| \r\n\
            3,=\"00:00:09.000\",0x000001,ch1,接收,0x0600,数据帧,标准帧,0x00,x| \r\n";
        let expected = "(86399.900000) can0 0009001C#05C38A430002EE00\n(86399.910000) can1 406#0601\n\
            (86400.300000) can0 600#R4 T\n(86409.000000) can0 600#\n";
        for file in
            [table.as_bytes().to_vec(), GBK.encode(table).0.to_vec(), ("\u{feff}".to_owned() + table).into()]
        {
            let (log, issues) = as_log(&file);
            assert_eq!(log, expected);
            assert_eq!(issues, Vec::<String>::new());
            assert_eq!(Format::of_content(&file), Some(Format::UsbCan));
            let source = std::io::Cursor::new(file);
            let mut reader =
                TraceReader::from_source("a.csv", source, Format::UsbCan, &ReadOptions::default()).unwrap();
            assert_eq!(reader.by_ref().count(), 4);
            assert_eq!(reader.notes().iter().collect::<Vec<_>>(), [(super::RESTARTED, 1)]);
        }
    }

    #[test]
    fn the_other_programs_tables_are_read() {
        let (log, issues) = as_log(
            "Index,Direction,Timesteamp,ID,Format,Type,Length,Data,\n\
             0,Receive,15:57:03.554.1,0x000001aa,Standard,Data,0x06,00 00 00 00 00 B1 ,\n\
             序号,传输方向,时间戳,消息名,ID,PGN(H),帧格式,帧类型,长度,数据,注释,\n\
             1,接收,57424.2328,--,0CF02990,00F029,扩展帧,数据帧,02,10 A1 ,,\n\
             序号\t传输方向\t时间标识\tID号\t帧格式\t帧类型\t长度\t数据\n2\t发送\t57425.5\t00000214 H\t标准帧\t数据帧\t1\t96 \n\
             序号,系统时间,时间标识,CAN通道,ID号,帧类型,帧格式,CAN类型,长度,数据\n\
             3,=\"15:57:06.761949,385.624895,ch1,0x27,数据帧,标准帧,CANFD加速,12,x| 01 01 02 03 04 05 06 07 08 09 0A 0B\n",
        );
        assert_eq!(issues, Vec::<String>::new());
        let expected = "(57423.554100) can0 1AA#0000000000B1\n(57424.232800) can0 0CF02990#10A1\n(57425.500000) can0 214#96 T\n\
            (57426.761949) can0 027##1010102030405060708090A0B\n";
        assert_eq!(log, expected);
    }

    /// CANTest without the column of the computer's time: only what was received has a stamp.
    #[test]
    fn frames_that_were_sent_without_a_stamp_stand_at_the_one_before() {
        let table = "序号\t传输方向\t时间标识\t名称\t帧ID\t帧格式\t帧类型\t数据长度\t数据(HEX)\n\
             0\t接收\t0x3039\t无\t0x00000123\t数据帧\t标准帧\t0x02\t01 02\n\
             1\t发送\t无\t无\t0x18fef100\t数据帧\t扩展帧\t0x01\t03\n2\t接收\t无\t无\t0x00000123\t数据帧\t标准帧\t0x00\t\n";
        let source = std::io::Cursor::new(table);
        let mut reader =
            TraceReader::from_source("a.txt", source, Format::UsbCan, &ReadOptions::default()).unwrap();
        assert_eq!(reader.by_ref().flatten().count(), 2);
        assert_eq!(reader.notes().iter().collect::<Vec<_>>(), [(super::NO_STAMP, 1)]);
        let (log, issues) = as_log(table);
        assert_eq!(log, "(1.234500) can0 123#0102\n(1.234500) can0 18FEF100#03 T\n");
        assert_eq!(issues.len(), 1, "{issues:?}");
    }

    #[test]
    fn a_row_that_is_no_frame_is_named_and_the_others_are_read() {
        let head = "序号,传输方向,时间戳,ID,帧格式,帧类型,长度,数据\n";
        let (log, issues) = as_log(format!(
            "{head}0,接收,1.5,0x7FF,标准帧,数据帧,1,11\n1,接收,1,0x1,标准帧,数据帧,1,11\n2,接收,1.5,0x800,标准帧,数据帧,1,11\n\
             3,接收,1.5,0x1,标准帧,数据帧,2,11\n4,转发,1.5,0x1,标准帧,数据帧,1,11\n5,接收,1.5,0x1,标准帧,数据帧,65,11\n\
             6,接收,1.5\n7,接收,25:00:00.1,0x1,标准帧,数据帧,1,11\n8,发送失败,1.5,0x1,标准帧,数据帧,1,11\n"
        ));
        assert_eq!((log.as_str(), issues.len()), ("(1.500000) can0 7FF#11\n", 7), "{issues:#?}");
    }
}
