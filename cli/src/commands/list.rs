//! `cantap list`: which boards are connected.

use std::io::Write;
use std::process::ExitCode;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Boards are found by their USB IDs. Until cantap has a product ID of its own these are pid.codes' test \
                IDs, so another project's board may be listed too; `cantap info` tells.\n\n\
                Examples:\n  \
                cantap list\n  \
                cantap list --json"
)]
pub struct Args {
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let boards = cantap::device::list()?;
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
        writeln!(out, "{}", serde_json::json!({ "devices": devices }))?;
    } else if boards.is_empty() {
        eprintln!("cantap: no board is connected; plug one in, or use -d virtual, which needs none");
    } else {
        for board in boards {
            let serial = board.serial_number.as_deref().unwrap_or("-");
            writeln!(out, "{}\t{}\t{serial}", board.port, board.product.as_deref().unwrap_or("-"))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}
