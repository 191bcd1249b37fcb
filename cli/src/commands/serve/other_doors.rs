//! Listeners for programs that do not know the board's own protocol, and for those that watch the server.

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context;
use cantap::Channel;
use cantap::wire::CHANNELS;
use cantap_serve::cannelloni::{self, Tunnel};
use cantap_serve::listen::Listening;
use cantap_serve::{Board, Role, cannelloni_tcp, gvret, lines, metrics, socketcand};

use super::doors::{Allowed, Door, TcpTunnelArg, TunnelArg, address, allow, loopback};
use crate::stderr;
use crate::usage_error::usage;

/// The default port of `--lines`.
const LINES_PORT: u16 = 29_538;
/// The default port of `--metrics`.
const METRICS_PORT: u16 = 29_539;

/// Each for all boards, but for a tunnel, which is for one channel.
pub struct OtherDoors {
    socketcand: Option<SocketAddr>,
    gvret: Option<SocketAddr>,
    tunnels: Vec<TunnelArg>,
    tcp_tunnels: Vec<TcpTunnelArg>,
    lines: Option<SocketAddr>,
    metrics: Option<SocketAddr>,
}

impl OtherDoors {
    /// Those that a command line asks for, by the options of these names.
    pub fn of(
        [socketcand, gvret, lines, metrics]: [Option<&str>; 4],
        tunnels: &[TunnelArg],
        tcp_tunnels: &[TcpTunnelArg],
        boards: usize,
    ) -> anyhow::Result<Self> {
        let most = boards * CHANNELS;
        let numbers = tunnels.iter().map(|tunnel| ("--cannelloni", tunnel.number));
        let mut numbers = numbers.chain(tcp_tunnels.iter().map(|tunnel| ("--cannelloni-tcp", tunnel.number)));
        if let Some((option, number)) = numbers.find(|(_, number)| usize::from(*number) > most) {
            return Err(usage(format!("{option}: there is no channel {number}, only 1 to {most}")));
        }
        Ok(Self {
            socketcand: socketcand.map(|text| address(text, socketcand::PORT)).transpose()?,
            gvret: gvret.map(|text| address(text, gvret::PORT)).transpose()?,
            tunnels: tunnels.to_vec(),
            tcp_tunnels: tcp_tunnels.to_vec(),
            lines: lines.map(|text| loopback(text, LINES_PORT)).transpose()?,
            metrics: metrics.map(|text| address(text, METRICS_PORT)).transpose()?,
        })
    }

    /// Opens them. Returns their names.
    pub fn listen(&self, all: &[Allowed], boards: &[Arc<Board>]) -> anyhow::Result<Vec<(String, Listening)>> {
        let mut ways = Vec::new();
        if let Some(address) = self.socketcand {
            let role = allow(all, Door::Socketcand);
            let way = socketcand::listen(boards, address, role).with_context(|| {
                format!("nobody can listen at {address}; give another port with --socketcand")
            })?;
            let address = way.address().unwrap_or(address);
            say_who_may_send(all, Door::Socketcand, "socketcand", address);
            ways.push((format!("can://{address}"), way));
        }
        if let Some(address) = self.gvret {
            let role = allow(all, Door::Gvret);
            let way = gvret::listen(boards, address, role).with_context(|| {
                let advice = if address.port() < 1024 {
                    " (ports below 1024 take rights: `setcap cap_net_bind_service=+ep` on the program, or systemd's socket)"
                } else {
                    ""
                };
                format!("nobody can listen at {address}; give another port with --gvret{advice}")
            })?;
            let address = way.address().unwrap_or(address);
            say_who_may_send(all, Door::Gvret, "gvret", address);
            if boards.len() > gvret::MOST_BOARDS {
                stderr::warn(&format!(
                    "GVRET has no place for channels above {}: nobody reaches them at {address}",
                    gvret::MOST_BOARDS * CHANNELS
                ));
            }
            ways.push((format!("gvret:tcp://{address}"), way));
        }
        for TunnelArg { number, local, peer } in &self.tunnels {
            let at = usize::from(*number) - 1;
            let (board, channel) = (Arc::clone(&boards[at / CHANNELS]), Channel::ALL[at % CHANNELS]);
            let role = allow(all, Door::Cannelloni);
            let (local, peer) = (*local, *peer);
            let way = cannelloni::open(Tunnel { board, channel, local, peer, role }).with_context(|| {
                format!("no tunnel begins at {local}; give another port with --cannelloni")
            })?;
            let local = way.address().unwrap_or(local);
            if !local.ip().is_loopback() || !peer.ip().is_loopback() {
                stderr::warn(&format!(
                    "channel {number} goes to {peer} as it is, for everybody on the way; nobody can send from there"
                ));
            } else if role >= Role::Send {
                stderr::warn(&format!(
                    "every user and program of this computer that takes {peer} can send on channel {number}: the protocol does not ask who \
                     they are"
                ));
            }
            ways.push((format!("cannelloni://{local}?listen={}", peer.port()), way));
        }
        for TcpTunnelArg { number, address } in &self.tcp_tunnels {
            let at = usize::from(*number) - 1;
            let (board, channel) = (&boards[at / CHANNELS], Channel::ALL[at % CHANNELS]);
            let role = allow(all, Door::Cannelloni);
            let way = cannelloni_tcp::listen(board, channel, *address, role).with_context(|| {
                format!("nobody can listen at {address}; give another port with --cannelloni-tcp")
            })?;
            let address = way.address().unwrap_or(*address);
            say_who_may_send(all, Door::Cannelloni, "cannelloni", address);
            ways.push((format!("cannelloni:tcp://{address}"), way));
        }
        if let Some(address) = self.lines {
            let way = lines::listen(boards, address)
                .with_context(|| format!("nobody can listen at {address}; give another port with --lines"))?;
            ways.push((format!("lines at {}", way.address().unwrap_or(address)), way));
        }
        if let Some(address) = self.metrics {
            let way = metrics::listen(boards, address).with_context(|| {
                format!("nobody can listen at {address}; give another port with --metrics")
            })?;
            let address = way.address().unwrap_or(address);
            if !address.ip().is_loopback() {
                stderr::warn(&format!("anyone who reaches {address} can read the server's figures"));
            }
            ways.push((format!("http://{address}/metrics"), way));
        }
        Ok(ways)
    }
}

/// What a listener that asks nobody who it is means for the buses.
fn say_who_may_send(all: &[Allowed], door: Door, name: &str, address: SocketAddr) {
    let role = allow(all, door);
    if !address.ip().is_loopback() {
        stderr::warn(&format!("anyone who reaches {address} can listen to the buses; nobody can send there"));
    } else if role >= Role::Send {
        stderr::warn(&format!(
            "every user and program of this computer can send on the buses at {address}: the protocol does not ask who they are"
        ));
    } else if allow(all, Door::Tcp) > role {
        stderr::tell(&format!(
            "cantap: clients at {address} may only listen; --allow {name}:send lets every program of this computer send there\n"
        ));
    }
}
