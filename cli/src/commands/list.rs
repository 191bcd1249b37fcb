//! `cantap list`: which boards, makers' adapters and CAN interfaces there are, and which servers announce themselves on the network.

mod makers;
mod network;

use std::io::Write;
use std::process::ExitCode;

use cantap_trace::counted;

use self::network::Network;
use crate::stderr;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Boards are found by their USB IDs. Until cantap has a product ID of its own these are pid.codes' test \
                IDs, so another project's board may be listed too; `cantap info` tells.\n\n\
                CAN interfaces are those of Linux, such as can0, whatever adapter is behind them.\n\n\
                PEAK's and Kvaser's channels are those that PCAN-Basic and CANlib know, if they are installed. None is opened.\n\n\
                Servers are found by socketcand's beacons and by DNS-SD, with which anybody on the network can announce anything: where one is and \
                what it is called is what it says of itself.\n\n\
                Examples:\n  \
                cantap list\n  \
                cantap list --network\n  \
                cantap list --json"
)]
pub struct Args {
    /// Also look for three seconds for servers: those that speak socketcand, of this computer and of the network, and those of other computers that are
    /// started with --announce.
    #[arg(long)]
    network: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Ask a maker's library in this process.
    #[arg(long, hide = true, value_name = "MAKER")]
    ask_library: Option<String>,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if let Some(maker) = &args.ask_library {
        makers::answer(maker)?;
        return Ok(ExitCode::SUCCESS);
    }
    let boards = cantap::device::list()?;
    let makers = makers::find();
    let interfaces = cantap_adapters::can_interfaces();
    let network = args.network.then(Network::look).transpose()?;
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
        let adapters: Vec<_> = makers.channels.iter().map(makers::json_of).collect();
        let unusable: Vec<_> = makers
            .unusable
            .iter()
            .map(|(library, reason)| serde_json::json!({ "library": library, "reason": reason }))
            .collect();
        let mut object = serde_json::json!({
            "devices": devices,
            "adapters": adapters,
            "interfaces": interfaces,
            "without_address": makers.without_address,
            "unusable": unusable,
        });
        if let Some(network) = &network {
            network.put(&mut object);
        }
        writeln!(out, "{object}")?;
        return Ok(ExitCode::SUCCESS);
    }
    if boards.is_empty() && makers.channels.is_empty() && interfaces.is_empty() {
        stderr::tell("cantap: no board is connected; plug one in, or use -d virtual, which needs none\n");
    }
    for board in boards {
        let serial = board.serial_number.as_deref().unwrap_or("-");
        writeln!(out, "{}\t{}\t{serial}", board.port, board.product.as_deref().unwrap_or("-"))?;
    }
    for name in &interfaces {
        writeln!(out, "{name}\tCAN interface of this computer\t-")?;
    }
    for channel in &makers.channels {
        let in_use = if channel.in_use == Some(true) { "\tanother program has it" } else { "" };
        let serial = channel.serial_number.as_deref().unwrap_or("-");
        writeln!(out, "{}\t{}\t{serial}{in_use}", channel.device, channel.product)?;
    }
    tell_unusable(&makers);
    if let Some(network) = network {
        network.print(&mut out)?;
        drop(out);
        network.tell_left_out();
    }
    Ok(ExitCode::SUCCESS)
}

/// Says which libraries have not answered, and what is not listed of the others.
fn tell_unusable(makers: &makers::Found) {
    for (library, reason) in &makers.unusable {
        stderr::warn(&format!("{library}'s channels are not known: {reason}"));
    }
    if makers.without_address > 0 {
        stderr::tell(&format!(
            "cantap: left out: {}, of kinds that cannot be addressed here\n",
            counted(makers.without_address, "channel")
        ));
    }
}
