//! `--announce`: other computers find the server by DNS-SD.

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context;
use cantap_serve::Board;
use cantap_serve::dns_sd::{self, Announcing, Listener};

use crate::stderr;
use crate::usage_error::usage;

/// Whether there will be something that others can reach.
pub fn check(announce: bool, tcp: Option<SocketAddr>) -> anyhow::Result<()> {
    match tcp {
        Some(address) if announce && address.ip().is_loopback() => Err(usage(format!(
            "--announce: other computers cannot reach {address}; give an address of the network with --tcp"
        ))),
        _ => Ok(()),
    }
}

/// Announces each board's listener.
pub fn start(boards: &[Arc<Board>], addresses: &[SocketAddr]) -> anyhow::Result<Announcing> {
    let serial = |board: &Board| board.hello().map(|hello| hello.serial.as_str().to_owned());
    let listeners = boards.iter().zip(addresses);
    let listeners: Vec<Listener> =
        listeners.map(|(board, address)| Listener { serial: serial(board), address: *address }).collect();
    let announcing = dns_sd::announce(&listeners).context("the server cannot be announced on its network")?;
    let places: Vec<String> = addresses.iter().map(ToString::to_string).collect();
    stderr::tell(&format!("cantap: everybody on the network is told of {}\n", places.join(" and ")));
    Ok(announcing)
}
