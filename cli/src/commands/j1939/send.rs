//! What `cantap j1939 send` sends.

use std::io::Write as _;
use std::time::Duration;

use cantap_protocols::active::station::StationJob;
use cantap_protocols::j1939::{Header, MOST_FAST_BYTES, fast_frames};
use cantap_protocols::nmea2000;
use cantap_trace::{counted, grammar};

use crate::args;
use crate::commands::uds::hex::{self, Hex};
use crate::usage_error::usage;

/// The address of all.
pub(super) const GLOBAL: u8 = 255;
/// The longest message by J1939's transport, in bytes.
const MOST_BYTES: usize = 1785;
const FRAME_BYTES: usize = 8;
/// J1939-71's for most groups.
const PRIORITY: u8 = 6;
/// Shorter than this, this computer does not keep a period.
const SHORTEST_PERIOD: Duration = Duration::from_millis(10);

/// The command line.
#[derive(clap::Args)]
pub(super) struct SendArgs {
    /// The group: 65260, 0xFEEC, or the name of an NMEA 2000 group, as 'Wind Data'.
    #[arg(value_name = "GROUP")]
    group: String,
    /// Its bytes in hexadecimal, or values of an NMEA 2000 group by CANboat's names, as 'Wind Speed=6 m/s' Reference=Apparent. NAME_2 is the second field
    /// with a name; what is not given is not available.
    #[arg(value_name = "HEX|FIELD=VALUE", required = true)]
    values: Vec<String>,
    /// The receiver: an address, or all.
    #[arg(long, value_name = "ADDRESS", default_value = "all", value_parser = address)]
    to: u8,
    /// 0, the highest, to 7; otherwise as CANboat has it for the group, or 6.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(0..=7))]
    priority: Option<u8>,
    /// How more than eight bytes are sent; auto is fast-packet for groups that NMEA 2000 sends so.
    #[arg(long, value_enum, default_value = "auto")]
    transport: Transport,
    /// Send it again and again, this long after it was begun, until Ctrl-C, --count or --time.
    #[arg(long, value_name = "TIME", value_parser = args::positive_duration)]
    pub(super) period: Option<Duration>,
    /// How many times.
    #[arg(short = 'n', long, value_name = "N", requires = "period", value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) count: Option<u32>,
    /// End after this time.
    #[arg(short, long, value_name = "TIME", requires = "period", value_parser = args::positive_duration)]
    pub(super) time: Option<Duration>,
    /// Print the frames that would be sent from --address, and send nothing.
    #[arg(long)]
    pub(super) preview: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Transport {
    Auto,
    /// NMEA 2000's: up to 223 bytes, also of eight bytes or fewer.
    FastPacket,
    /// J1939's: up to 1785 bytes, by BAM to all, by RTS/CTS to one.
    J1939,
}

/// A message that can be sent.
pub(super) struct Message {
    pgn: u32,
    to: u8,
    priority: u8,
    is_fast: bool,
    data: Vec<u8>,
}

pub(super) fn address(text: &str) -> Result<u8, String> {
    match (text, args::byte(text)) {
        ("all", _) => Ok(GLOBAL),
        (_, Some(address @ 0..=253)) => Ok(address),
        _ => Err("addresses are 0 to 253 (0x00 to 0xFD), or all".to_owned()),
    }
}

/// A group's number, if it is one.
pub(super) fn usable(pgn: u32) -> Result<u32, String> {
    if pgn >> 8 & 0xFF < 240 && pgn & 0xFF != 0 {
        return Err(
            "groups below 0xF000 end in 00: the last byte is the address, which --to gives".to_owned()
        );
    }
    Ok(pgn)
}

/// `1 message was`, `2 messages were`.
pub(super) fn were(messages: u32) -> String {
    let number = usize::try_from(messages).unwrap_or(usize::MAX);
    format!("{} {}", counted(number, "message"), if messages == 1 { "was" } else { "were" })
}

impl SendArgs {
    /// Everything is checked before anything is sent.
    pub(super) fn message(&self) -> anyhow::Result<Message> {
        if self.period.is_some_and(|period| period < SHORTEST_PERIOD) {
            return Err(usage(format!("a period is at least {} ms", SHORTEST_PERIOD.as_millis())));
        }
        let (pgn, priority, data) = self.content()?;
        let pgn = usable(pgn).map_err(usage)?;
        if self.to != GLOBAL && pgn >> 8 & 0xFF >= 240 {
            return Err(usage(format!("the group {pgn} goes to all; omit --to")));
        }
        let is_fast = match self.transport {
            Transport::Auto => nmea2000::is_fast(pgn),
            Transport::FastPacket => true,
            Transport::J1939 => false,
        };
        let most = if is_fast { MOST_FAST_BYTES } else { MOST_BYTES };
        if data.len() > most {
            let way = if is_fast { "by fast packet " } else { "" };
            return Err(usage(format!(
                "a message {way}has at most {most} bytes, and this one has {}",
                data.len()
            )));
        }
        let priority = self.priority.or(priority).unwrap_or(PRIORITY);
        Ok(Message { pgn, to: self.to, priority, is_fast, data })
    }

    fn content(&self) -> anyhow::Result<(u32, Option<u8>, Vec<u8>)> {
        let number = grammar::parameter_group(&self.group);
        let pairs: Vec<_> = self.values.iter().filter_map(|value| value.split_once('=')).collect();
        match (pairs.len() == self.values.len(), &self.values[..]) {
            (true, _) => {
                let group = number.map_or_else(|| self.group.clone(), |pgn| pgn.to_string());
                let made = nmea2000::encode(&group, &pairs).map_err(|error| usage(error.to_string()))?;
                Ok((made.pgn, made.priority, made.data))
            }
            (false, [bytes]) => {
                let Hex(data) = hex::bytes(bytes).map_err(usage)?;
                let Some(pgn) = number else {
                    return Err(usage(format!(
                        "'{}' is no group's number up to 262143, as 65260 or 0xFEEC; a name goes with FIELD=VALUE",
                        self.group
                    )));
                };
                Ok((pgn, None, data))
            }
            _ => Err(usage("write all bytes in one argument, or each value as FIELD=VALUE")),
        }
    }
}

impl Message {
    pub(super) fn job(self) -> StationJob {
        let Self { pgn, to, priority, is_fast, data } = self;
        if is_fast {
            StationJob::SendFast { pgn, to, priority, data }
        } else {
            StationJob::Send { pgn, to, priority, data }
        }
    }

    /// Prints its frames, if it has them without an answer of others.
    pub(super) fn print(&self, source: u8, json: bool) -> anyhow::Result<()> {
        let header = Header { priority: self.priority, pgn: self.pgn, source, destination: self.to };
        let frames = if self.is_fast {
            fast_frames(header, 0, &self.data)
        } else if self.data.len() <= FRAME_BYTES {
            cantap::Frame::data_frame(header.id(), &self.data).into_iter().collect()
        } else {
            return Err(usage(
                "what J1939's transport sends depends on its receiver; --preview is for fast packets and single frames",
            ));
        };
        let mut out = std::io::stdout().lock();
        for frame in frames {
            if json {
                writeln!(out, "{}", serde_json::json!({ "frame": frame.to_string() }))?;
            } else {
                writeln!(out, "{frame}")?;
            }
        }
        Ok(())
    }
}
