//! The bit rates of channels, as files say them. A format without a place of its own for them gets a side note in its head, which is the same text
//! in all: `cantap: bit-rates 1=500000 2=250000`, each channel from 1 with its rate in bit/s, outside CAN FD's data phases.

use cantap_can::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};

use super::channel_info::ChannelInfo;
use super::event_text::MARK;

const NAME: &str = "bit-rates ";

/// What is known: channel from 1, bit/s. What a file says of a channel first counts.
pub(crate) type BitRates = Vec<(u8, u32)>;

/// Adds what a file says of a channel, unless it cannot be: other programs write zero, or the speed of what is not a bus.
pub(crate) fn learn(known: &mut BitRates, channel: u8, bitrate_bps: u32) {
    let is_possible = (MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(&bitrate_bps);
    if is_possible && known.iter().all(|(other, _)| *other != channel) {
        known.push((channel, bitrate_bps));
    }
}

/// The rates that are known of these channels.
pub(crate) fn known(channels: &[ChannelInfo]) -> BitRates {
    let mut known = BitRates::new();
    for ChannelInfo { channel, bitrate_bps, .. } in channels {
        if let Some(bitrate_bps) = bitrate_bps {
            learn(&mut known, *channel, *bitrate_bps);
        }
    }
    known
}

/// `1=500000 2=250000`.
pub(crate) fn listed(rates: &[(u8, u32)]) -> String {
    rates.iter().map(|(channel, bps)| format!("{channel}={bps}")).collect::<Vec<_>>().join(" ")
}

/// Adds the rates of such a list, up to what is none.
pub(crate) fn learn_list(known: &mut BitRates, list: &str) {
    let rate = |word: &str| {
        let (channel, bps) = word.split_once('=')?;
        Some((channel.parse().ok()?, bps.parse().ok()?))
    };
    for (channel, bps) in list.split_ascii_whitespace().map_while(rate) {
        learn(known, channel, bps);
    }
}

/// The side note about these channels; `None` if nothing is known.
pub(crate) fn note(channels: &[ChannelInfo]) -> Option<String> {
    let rates = &known(channels);
    (!rates.is_empty()).then(|| format!("{MARK}{NAME}{}", listed(rates)))
}

/// Adds the rates of a side note in a comment. Returns whether it is one.
pub(crate) fn learn_note(known: &mut BitRates, comment: &[u8]) -> bool {
    let list = memchr::memmem::find(comment, MARK.as_bytes())
        .and_then(|at| comment[at + MARK.len()..].strip_prefix(NAME.as_bytes()))
        .and_then(|list| std::str::from_utf8(list).ok());
    list.map(|list| learn_list(known, list)).is_some()
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::super::trc::TrcVersion;
    use super::super::{Format, ReadOptions, TraceReader, WriteOptions, tests};
    use super::*;
    use cantap_trace::testing::data_record;

    const WITH_RATES: [Format; 10] = [
        Format::Asc,
        Format::Blf,
        Format::Mf4,
        Format::Pcapng,
        Format::Trc(TrcVersion::V1_0),
        Format::Trc(TrcVersion::V1_1),
        Format::Trc(TrcVersion::V1_2),
        Format::Trc(TrcVersion::V1_3),
        Format::Trc(TrcVersion::V2_0),
        Format::Trc(TrcVersion::V2_1),
    ];

    fn info(channel: u8, bitrate_bps: Option<u32>) -> ChannelInfo {
        ChannelInfo { channel, bitrate_bps, description: String::new() }
    }

    /// The rates that a reading of the file ends with, what it gives before the first record included, and the file.
    fn rates(format: Format, channels: Vec<ChannelInfo>) -> (BitRates, Vec<u8>) {
        let options = WriteOptions { format: Some(format), channels, ..WriteOptions::default() };
        let record = data_record(1_500_000_000_000_000_000);
        let (bytes, left_out) = tests::write_with(&options, &[record]);
        // Into a stream, MF4's head has no numbers of records.
        assert!(left_out.is_empty() || matches!(format, Format::Trc(_) | Format::Mf4), "{format}");
        let mut reader =
            TraceReader::from_source("test", Cursor::new(bytes.clone()), format, &ReadOptions::default())
                .unwrap();
        let first = reader.next().unwrap().unwrap();
        let known = reader.bit_rates().to_vec();
        assert_eq!(first.time_ns, record.time_ns, "{format}");
        assert_eq!(reader.count(), 0, "{format}");
        (known, bytes)
    }

    #[test]
    fn a_trace_remembers_the_bit_rates_of_its_channels() {
        for format in WITH_RATES {
            let channels = vec![info(1, Some(500_000)), info(2, Some(83_333)), info(3, None)];
            assert_eq!(rates(format, channels).0, [(1, 500_000), (2, 83_333)], "{format}");
            assert_eq!(rates(format, vec![info(2, Some(1_000_000))]).0, [(2, 1_000_000)], "{format}");
            let without = rates(format, vec![info(1, None)]);
            let nothing = rates(format, Vec::new());
            assert!(without.0.is_empty() && nothing.0.is_empty(), "{format}");
            // Nothing is known, nothing is said.
            assert!(format == Format::Pcapng || without.1 == nothing.1, "{format}");
        }
    }

    /// As PCAN-Explorer writes its head, in several versions of it.
    #[test]
    fn the_bit_rates_in_peaks_own_heads_are_read() {
        let head = ";$FILEVERSION=1.3\r\n;$STARTTIME=44548.6028595139\r\n;\r\n;   C:\\a.trc\r\n;---\r\n\
            ;   Bus  Name   Connection         Protocol  Bit rate\r\n\
            ;   1    PCAN   Untitled@pcan_usb  CAN       500 kbit/s\r\n\
            ;   2    PTCAN  Light@pcan_usb     CAN\r\n\
            ;   3    J1     USB1@pcan_usb      J1939     250 kBit/s\r\n\
            ;   4    C      D                  CAN FD    Nominal 1 MBit/s, Data 8 MBit/s\r\n\
            ;   N/A  N/A    N/A                N/A\r\n\
            ;---\r\n;   5  not in the table  800 kBit/s\r\n";
        let row = "     1)     17535.000 1  Rx    00000100 -  2    01 02\r\n";
        let format = Format::Trc(TrcVersion::V1_3);
        let source = Cursor::new(format!("{head}{row}"));
        let mut reader = TraceReader::from_source("test", source, format, &ReadOptions::default()).unwrap();
        assert_eq!(reader.by_ref().map(Result::unwrap).count(), 1);
        assert_eq!(reader.bit_rates(), [(1, 500_000), (3, 250_000), (4, 1_000_000)]);
    }

    #[test]
    fn a_note_in_a_candump_log_counts() {
        let log = "# cantap: bit-rates 1=500000\n(1.000000) can0 123#11\n";
        let options = ReadOptions::default();
        let mut reader =
            TraceReader::from_source("test", Cursor::new(log), Format::Candump, &options).unwrap();
        assert_eq!(reader.by_ref().map(Result::unwrap).count(), 1);
        assert_eq!(reader.bit_rates(), [(1, 500_000)]);
    }

    #[test]
    fn what_cannot_be_a_bit_rate_is_none() {
        let mut known = BitRates::new();
        assert!(learn_note(&mut known, b"x cantap: bit-rates 1=0 2=99999999 3=250000 3=125000 x 4=125000"));
        assert_eq!(known, [(3, 250_000)]);
        assert!(!learn_note(&mut known, b"cantap: lost 5") && !learn_note(&mut known, b"bit-rates 1=500000"));
        assert_eq!(known, [(3, 250_000)]);
    }
}
