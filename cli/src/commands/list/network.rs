//! Servers that announce themselves: by socketcand's beacons, and by DNS-SD.

use std::io::{self, Write};
use std::time::Duration;

use cantap_serve::beacon::{self, Announced, Found};
use cantap_serve::dns_sd::{self, Browsed};
use serde_json::{Value, json};

use crate::stderr;

/// Beacons are sent at least every three seconds.
const LISTEN_FOR: Duration = Duration::from_millis(3100);

/// What was heard of servers.
pub struct Network {
    beacons: Announced,
    browsed: Browsed,
}

impl Network {
    /// Listens, and asks.
    pub fn look() -> anyhow::Result<Self> {
        let browsing = std::thread::spawn(|| dns_sd::browse_for(LISTEN_FOR));
        let beacons = beacon::listen_for(LISTEN_FOR);
        let browsed = browsing.join().unwrap_or_else(|_| Err(io::ErrorKind::Other.into()));
        let beacons = beacons.map_err(|error| {
            anyhow::anyhow!("nobody can listen for servers at UDP port {}: {error}", beacon::PORT)
        })?;
        let browsed = browsed.unwrap_or_else(|error| {
            stderr::warn(&format!("servers that announce themselves by DNS-SD are not found: {error}"));
            Browsed { is_cut: true, ..Browsed::default() }
        });
        Ok(Self { beacons, browsed })
    }

    /// Adds it for scripts.
    pub fn put(&self, object: &mut Value) {
        let named = self.browsed.servers.iter().map(
            |server| json!({ "devices": [tls(server)], "name": server.name, "from": null, "more_buses": 0 }),
        );
        object["servers"] = self.beacons.servers.iter().map(of_beacon).chain(named).collect();
        object["beacons_left_out"] = self.beacons.beacons_left_out.into();
        object["unreadable"] = self.beacons.unreadable.into();
        object["servers_left_out"] = self.browsed.left_out.into();
        object["servers_nowhere"] = self.browsed.unusable.into();
        object["servers_cut"] = self.browsed.is_cut.into();
    }

    /// Prints it for people.
    pub fn print(&self, out: &mut impl Write) -> io::Result<()> {
        for server in &self.beacons.servers {
            for bus in &server.buses {
                writeln!(out, "{}\t{}\t{}", address(server, bus), server.name, server.from)?;
            }
        }
        for server in &self.browsed.servers {
            writeln!(out, "{}\t{}\t-", tls(server), server.name)?;
        }
        Ok(())
    }

    /// Says what is not listed.
    pub fn tell_left_out(&self) {
        let Announced { servers, beacons_left_out, unreadable } = &self.beacons;
        if servers.is_empty() && self.browsed.servers.is_empty() {
            stderr::tell(
                "cantap: no server announced itself; `cantap serve` does with --socketcand or --announce, and others need not\n",
            );
        }
        if *beacons_left_out > 0 {
            stderr::warn(&format!(
                "{beacons_left_out} beacons of further servers are left out, because {} are listed already: somebody may be inventing them",
                servers.len()
            ));
        }
        let more: usize = servers.iter().map(|server| server.more_buses).sum();
        if more > 0 {
            stderr::warn(&format!("{more} further buses of these servers are left out"));
        }
        if *unreadable > 0 {
            stderr::tell(&format!(
                "cantap: {unreadable} datagrams at UDP port {} were no beacons\n",
                beacon::PORT
            ));
        }
        let Browsed { left_out, unusable, is_cut, .. } = self.browsed;
        if left_out > 0 || is_cut {
            let more = if is_cut { "at least " } else { "" };
            stderr::warn(&format!(
                "{more}{left_out} servers that were announced are left out: they did not say where they are, or somebody may be inventing them"
            ));
        }
        if unusable > 0 {
            stderr::warn(&format!("{unusable} servers are announced at places where none can be"));
        }
    }
}

/// A bus of a server as `-d` takes it.
fn address(server: &Found, bus: &str) -> String {
    format!("socketcand://{}/{bus}", server.place)
}

/// The same for a server of this project's own protocol.
fn tls(server: &dns_sd::AnnouncedServer) -> String {
    format!("tls://{}", server.place)
}

fn of_beacon(server: &Found) -> Value {
    let devices: Vec<String> = server.buses.iter().map(|bus| address(server, bus)).collect();
    json!({ "devices": devices, "name": server.name, "from": server.from.to_string(), "more_buses": server.more_buses })
}
