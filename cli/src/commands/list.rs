//! `cantap list`: which boards are connected, and which servers announce themselves on the network.

use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

use cantap_serve::beacon::{self, Announced, Found};

use crate::stderr;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Boards are found by their USB IDs. Until cantap has a product ID of its own these are pid.codes' test \
                IDs, so another project's board may be listed too; `cantap info` tells.\n\n\
                Servers are found by socketcand's beacons, which anybody on the network can send: where one is and what it is called is what \
                it says of itself.\n\n\
                Examples:\n  \
                cantap list\n  \
                cantap list --network\n  \
                cantap list --json"
)]
pub struct Args {
    /// Also listen for three seconds for servers that speak socketcand: those of this computer, and those at addresses of the network.
    #[arg(long)]
    network: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Servers announce themselves at least every three seconds.
const LISTEN_FOR: Duration = Duration::from_millis(3100);

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let boards = cantap::device::list()?;
    let announced = if args.network {
        let found = beacon::listen_for(LISTEN_FOR);
        Some(found.map_err(|error| {
            anyhow::anyhow!("nobody can listen for servers at UDP port {}: {error}", beacon::PORT)
        })?)
    } else {
        None
    };
    let mut out = std::io::stdout().lock();
    if args.json {
        let devices: Vec<_> = boards
            .iter()
            .map(|board| {
                serde_json::json!({
                    "device": board.port,
                    "serial_number": board.serial_number,
                    "product": board.product,
                })
            })
            .collect();
        let mut object = serde_json::json!({ "devices": devices });
        if let Some(announced) = &announced {
            object["servers"] = announced.servers.iter().map(json_of).collect();
            object["beacons_left_out"] = announced.beacons_left_out.into();
            object["unreadable"] = announced.unreadable.into();
        }
        writeln!(out, "{object}")?;
        return Ok(ExitCode::SUCCESS);
    }
    if boards.is_empty() {
        stderr::tell("cantap: no board is connected; plug one in, or use -d virtual, which needs none\n");
    } else {
        for board in boards {
            let serial = board.serial_number.as_deref().unwrap_or("-");
            writeln!(out, "{}\t{}\t{serial}", board.port, board.product.as_deref().unwrap_or("-"))?;
        }
    }
    let Some(announced) = announced else { return Ok(ExitCode::SUCCESS) };
    for server in &announced.servers {
        for bus in &server.buses {
            writeln!(out, "{}\t{}\t{}", address(server, bus), server.name, server.from)?;
        }
    }
    drop(out);
    tell_left_out(&announced);
    Ok(ExitCode::SUCCESS)
}

/// Says what is not listed.
fn tell_left_out(announced: &Announced) {
    let Announced { servers, beacons_left_out, unreadable } = announced;
    if servers.is_empty() {
        stderr::tell(
            "cantap: no server announced itself; `cantap serve --socketcand` does, and others need not\n",
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
}

/// A bus of a server as `-d` takes it.
fn address(server: &Found, bus: &str) -> String {
    format!("socketcand://{}/{bus}", server.place)
}

fn json_of(server: &Found) -> serde_json::Value {
    let devices: Vec<String> = server.buses.iter().map(|bus| address(server, bus)).collect();
    serde_json::json!({ "devices": devices, "name": server.name, "from": server.from.to_string(), "more_buses": server.more_buses })
}
