//! Whom to ask, and how: the options of transfers.

use std::time::Duration;

use cantap::Id;
use cantap_protocols::iso_tp::{Endpoint, Pair};
use cantap_work::uds::{FlowControl, TransferOptions};

use crate::args;

/// The first pair of ISO 15765-4.
const OBD_PAIR: Pair = Pair {
    a: Endpoint { id: Id::standard_truncated(0x7E0), address: None },
    b: Endpoint { id: Id::standard_truncated(0x7E8), address: None },
};

/// Whom to ask, and the parameters of transfers; commands flatten this into their arguments.
#[derive(clap::Args)]
pub struct TransferArgs {
    /// The ECU: the identifier of requests, and that of its answers; 6F1/12:612/F1 if the first data byte is an address. Without it, those of the only
    /// ECU of --odx, or 7E0:7E8.
    #[arg(long, value_name = "ID:ID", global = true)]
    pair: Option<Pair>,
    /// Ask all ECUs at once: with 7DF, or with 18DB33F1 if the pair has 29-bit identifiers.
    #[arg(long, global = true)]
    functional: bool,
    /// How long to wait for the beginning of an answer (P2, plus delays by gateways).
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = args::positive_duration, global = true)]
    p2: Duration,
    /// The same after the ECU has said that its answer is pending (P2*).
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = args::positive_duration, global = true)]
    p2_star: Duration,
    /// Maximum time to wait for one answer, however often it is pending; also for sending a long request, and for --key-command.
    #[arg(long, value_name = "TIME", default_value = "60s", value_parser = args::positive_duration, global = true)]
    patience: Duration,
    /// How long to wait for the next frame of an answer (N_Cr), and for flow control (N_Bs).
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = args::positive_duration, global = true)]
    frame_timeout: Duration,
    /// How often in a row the ECU's flow control may ask to wait (N_WFTmax).
    #[arg(long, value_name = "N", default_value_t = 10, global = true)]
    max_waits: u32,
    /// Minimum separation of an answer's frames (STmin): up to 127ms, or 100us to 900us.
    #[arg(long, value_name = "STMIN", default_value = "0ms", value_parser = separation, global = true)]
    separation: u8,
    /// Frames of an answer per flow control frame; 0 for all.
    #[arg(long, value_name = "N", default_value_t = 0, global = true)]
    block_size: u8,
    /// The byte that pads frames to eight bytes, in hexadecimal; none keeps them as short as possible.
    #[arg(long, value_name = "HEX|none", default_value = "CC", value_parser = padding, global = true)]
    padding: Padding,
    /// Who sends the first flow control frame of an answer.
    #[arg(long, value_enum, default_value = "auto", global = true)]
    flow_control: FlowBy,
    /// How long a session that was opened may be without a request, as while a key is computed, before "tester present" is sent.
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = args::positive_duration, global = true)]
    keep_alive: Duration,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum FlowBy {
    /// The device if the answer is longer than a frame by the standards, as a VIN; otherwise this computer.
    Auto,
    /// This computer, once it has seen that one is needed.
    Host,
    /// The device, within microseconds, after the ECU's next frame of any kind.
    Device,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Padding(Option<u8>);

fn padding(text: &str) -> Result<Padding, String> {
    match text {
        "none" => Ok(Padding(None)),
        _ => u8::from_str_radix(text, 16)
            .map(|byte| Padding(Some(byte)))
            .map_err(|_| "write a byte in hexadecimal, as CC, or none".to_owned()),
    }
}

/// Encoded as in flow control.
fn separation(text: &str) -> Result<u8, String> {
    let time = args::duration(text)?;
    match time.as_micros() {
        us @ 0..=127_000 if us % 1000 == 0 => Ok((us / 1000) as u8),
        us @ 100..=900 if us % 100 == 0 => Ok(0xF0 + (us / 100) as u8),
        _ => Err("flow control knows whole milliseconds up to 127ms, and 100us to 900us in steps of 100us"
            .to_owned()),
    }
}

impl TransferArgs {
    /// The same without clap, for this pair if none was given.
    pub fn options(&self, usual: Option<Pair>) -> TransferOptions {
        TransferOptions {
            pair: self.pair.or(usual).unwrap_or(OBD_PAIR),
            functional: self.functional,
            p2: self.p2,
            p2_star: self.p2_star,
            patience: self.patience,
            frame_timeout: self.frame_timeout,
            max_waits: self.max_waits,
            separation: self.separation,
            block_size: self.block_size,
            padding: self.padding.0,
            flow_control: match self.flow_control {
                FlowBy::Auto => FlowControl::Auto,
                FlowBy::Host => FlowControl::Host,
                FlowBy::Device => FlowControl::Device,
            },
            keep_alive: self.keep_alive,
        }
    }
}
