//! Finds the nodes that exist.

use std::io::Write as _;

use anyhow::anyhow;
use cantap_protocols::active::node_scan::{FoundNode, NodeScan};
use cantap_protocols::active::sdo::{SdoClient, SdoError, SdoIds, SdoJob};
use cantap_protocols::canopen::{CanOpen, Sheet, state_name};
use serde_json::{Value, json};

use crate::args;
use crate::speak_args::SpeakArgs;
use cantap_work::speaking::Speaking;

/// The command line.
#[derive(clap::Args)]
pub(super) struct ScanArgs {
    /// Only these nodes: 1 to 127, as 5 or 1-20.
    #[arg(value_name = "NODES", default_value = "1-127", value_parser = nodes)]
    nodes: (u8, u8),
    /// Send nothing: only listen to heartbeats, for this long.
    #[arg(long, value_name = "TIME", value_parser = args::positive_duration)]
    listen: Option<std::time::Duration>,
}

fn nodes(text: &str) -> Result<(u8, u8), String> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    match (first.parse(), last.parse()) {
        (Ok(first), Ok(last)) if 1 <= first && first <= last && last <= 127 => Ok((first, last)),
        _ => Err("write a node from 1 to 127, or a range, as 1-20".to_owned()),
    }
}

/// Objects that identify a node: its name in JSON, index, sub-index.
const IDENTITY: [(&str, u16, u8); 5] = [
    ("vendor_id", 0x1018, 1),
    ("product_code", 0x1018, 2),
    ("revision", 0x1018, 3),
    ("serial_number", 0x1018, 4),
    ("name", 0x1008, 0),
];

/// Scans, asks the nodes that answer for their identity, and shows them; an error if there is none.
pub(super) fn run(
    speak: &SpeakArgs,
    args: &ScanArgs,
    wait_ns: u64,
    sheets: Vec<Sheet>,
) -> anyhow::Result<()> {
    let device = if args.listen.is_some() { speak.listen()? } else { speak.open()? };
    let mut speaking = speak.speak(&device, Box::new(CanOpen::new(sheets)));
    let (first, last) = args.nodes;
    let mut scan = match args.listen {
        Some(time) => NodeScan::new([], args::nanoseconds(time)),
        None => NodeScan::new(first..=last, wait_ns),
    };
    speaking.run(&mut scan)?;
    let mut found = Vec::new();
    for node in scan.found() {
        found.push(describe(&mut speaking, node, wait_ns)?);
    }
    let mut out = std::io::stdout().lock();
    if speak.json {
        writeln!(out, "{}", json!({ "channel": speak.channel().number(), "nodes": found }))?;
    } else {
        for node in &found {
            writeln!(out, "{}", line(node))?;
        }
    }
    // Nothing found is not what was asked for.
    let nobody = found.is_empty().then(|| match args.listen {
        Some(_) => format!("no node sent a heartbeat; {}; without --listen, nodes are asked", speaking.circumstances()),
        None => format!(
            "no node answered or sent a heartbeat; {}; check the bit rate, and that the nodes are on; a node without a number is found by \
             `cantap canopen lss`",
            speaking.circumstances()
        ),
    });
    let deaf = speaking.judge();
    drop(speaking);
    device.stop()?;
    deaf?;
    nobody.map_or(Ok(()), |nobody| Err(anyhow!(nobody)))
}

fn describe(speaking: &mut Speaking<'_>, node: FoundNode, wait_ns: u64) -> anyhow::Result<Value> {
    let mut object = json!({
        "node": node.node,
        "answers": node.answers,
        "state": node.state.and_then(state_name),
        "device_type": node.device_type,
    });
    for (name, index, sub) in IDENTITY {
        let mut value = Value::Null;
        if node.answers {
            let mut client = SdoClient::new(SdoIds::of(node.node), index, sub, SdoJob::Read, false, wait_ns);
            speaking.run(&mut client)?;
            // A node need not answer for an object that it does not have.
            match client.finish() {
                Ok(data) => {
                    value = match <[u8; 4]>::try_from(&data[..]) {
                        Ok(word) if index == 0x1018 => u32::from_le_bytes(word).into(),
                        _ => String::from_utf8_lossy(&data).trim_end_matches('\0').into(),
                    };
                }
                Err(SdoError::Aborted { .. } | SdoError::NoAnswer { .. }) => {}
                Err(error) => eprintln!("cantap: node {}, object {index:04X}:{sub:X}: {error}", node.node),
            }
        }
        object[name] = value;
    }
    Ok(object)
}

fn line(node: &Value) -> String {
    let mut parts = vec![format!("node {}", node["node"])];
    let state = node["state"].as_str();
    let answers = node["answers"] == true;
    parts.push(match (state, answers) {
        (Some(state), true) => state.to_owned(),
        (Some(state), false) => format!("{state}, does not answer by SDO"),
        (None, _) => "no heartbeat heard".to_owned(),
    });
    for (key, title) in [
        ("device_type", "device type"),
        ("vendor_id", "vendor"),
        ("product_code", "product"),
        ("revision", "revision"),
        ("serial_number", "serial number"),
    ] {
        if let Some(number) = node[key].as_u64() {
            parts.push(format!("{title} {number:08X}"));
        }
    }
    if let Some(name) = node["name"].as_str() {
        parts.push(format!("\"{name}\""));
    }
    parts.join(", ")
}
