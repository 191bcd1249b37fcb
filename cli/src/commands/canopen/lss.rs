//! Layer setting services.

use std::io::Write as _;

use anyhow::anyhow;
use cantap_protocols::active::Machine as _;
use cantap_protocols::active::lss::{FastScan, LssAddress, LssError, LssMaster, LssOrder, bit_rate_index};
use cantap_protocols::canopen::CanOpen;
use serde_json::json;

use crate::args;
use crate::speak_args::SpeakArgs;
use crate::usage_error::usage;
use cantap_work::interrupt;
use cantap_work::speaking::Speaking;

/// The command line.
#[derive(clap::Args)]
pub(super) struct LssArgs {
    /// The node's identity (object 1018) in hexadecimal, if known: vendor, product, revision, serial number, as
    /// 29C:1:10002:4D2. Without it, a node without a number is searched for.
    #[arg(long, value_name = "VENDOR:PRODUCT:REVISION:SERIAL", value_parser = address)]
    identity: Option<LssAddress>,
    /// Give it this number, 1 to 127.
    #[arg(long, value_name = "NODE", value_parser = clap::value_parser!(u8).range(1..=127))]
    node: Option<u8>,
    /// Give it this bit rate, which takes effect after a restart.
    #[arg(long, value_name = "RATE", value_parser = args::bitrate)]
    node_bitrate: Option<u32>,
    /// Have it keep both over a restart.
    #[arg(long)]
    store: bool,
}

fn address(text: &str) -> Result<LssAddress, String> {
    let parts = text.split(':').map(|part| u32::from_str_radix(part, 16).ok()).collect::<Option<Vec<_>>>();
    match parts.as_deref() {
        Some(&[vendor, product, revision, serial]) => Ok(LssAddress { vendor, product, revision, serial }),
        _ => Err("write four numbers in hexadecimal, as 29C:1:10002:4D2".to_owned()),
    }
}

/// Finds a node, and configures it as requested.
pub(super) fn run(speak: &SpeakArgs, args: &LssArgs, timeout_ns: u64) -> anyhow::Result<()> {
    let index = args
        .node_bitrate
        .map(|bps| {
            bit_rate_index(bps)
                .ok_or_else(|| usage("nodes know 10k, 20k, 50k, 125k, 250k, 500k, 800k and 1M".to_owned()))
        })
        .transpose()?;
    let device = speak.open()?;
    let mut speaking = speak.speak(&device, Box::new(CanOpen::new(Vec::new())));
    // No other node may take the orders.
    order(&mut speaking, LssOrder::SwitchAll(false), timeout_ns)?;
    let configured = configure(&mut speaking, args, index, timeout_ns);
    // Whatever happened, no node must stay in configuration mode.
    let released = match LssMaster::new(LssOrder::SwitchAll(false), timeout_ns).next(0) {
        Some(frame) if interrupt::requested() => speaking.send_last(frame),
        _ => order(&mut speaking, LssOrder::SwitchAll(false), timeout_ns),
    };
    let found = configured?;
    released?;
    let LssAddress { vendor, product, revision, serial } = found;
    let mut out = std::io::stdout().lock();
    if speak.json {
        let object = json!({
            "channel": speak.channel().number(),
            "vendor_id": vendor,
            "product_code": product,
            "revision": revision,
            "serial_number": serial,
            "node": args.node,
            "bitrate_bps": args.node_bitrate,
            "stored": args.store,
        });
        writeln!(out, "{object}")?;
    } else {
        write!(
            out,
            "vendor {vendor:08X}, product {product:08X}, revision {revision:08X}, serial number {serial:08X}"
        )?;
        if let Some(node) = args.node {
            write!(out, ": node {node} from now on")?;
        }
        if let Some(bps) = args.node_bitrate {
            write!(out, ", {bps} bit/s after a restart")?;
        }
        writeln!(out, "{}", if args.store { ", stored" } else { "" })?;
    }
    drop(speaking);
    device.stop()?;
    Ok(())
}

/// Finds the node, and gives it what was asked for.
fn configure(
    speaking: &mut Speaking<'_>,
    args: &LssArgs,
    bit_rate: Option<u8>,
    timeout_ns: u64,
) -> anyhow::Result<LssAddress> {
    let found = match args.identity {
        Some(address) => {
            order(speaking, LssOrder::Switch(address), timeout_ns)?;
            address
        }
        None => scan(speaking, timeout_ns)?,
    };
    let orders = [
        args.node.map(LssOrder::SetNode),
        bit_rate.map(LssOrder::SetBitRate),
        args.store.then_some(LssOrder::Store),
    ];
    for wanted in orders.into_iter().flatten() {
        order(speaking, wanted, timeout_ns)?;
    }
    Ok(found)
}

fn scan(speaking: &mut Speaking<'_>, timeout_ns: u64) -> anyhow::Result<LssAddress> {
    let mut scan = FastScan::new(timeout_ns);
    speaking.run(&mut scan)?;
    scan.finish().map_err(|error| match error {
        LssError::Nobody => anyhow!(
            "{error}; {}; a node that has a number does not answer it: give its --identity",
            speaking.circumstances()
        ),
        error => anyhow!(error),
    })
}

fn order(speaking: &mut Speaking<'_>, order: LssOrder, timeout_ns: u64) -> anyhow::Result<()> {
    let mut master = LssMaster::new(order, timeout_ns);
    speaking.run(&mut master)?;
    master.finish().map_err(|error| match error {
        LssError::NoAnswer { .. } => anyhow!("{error}; {}", speaking.circumstances()),
        error => anyhow!(error),
    })
}
