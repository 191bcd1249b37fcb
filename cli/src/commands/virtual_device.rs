//! `cantap virtual`: the virtual device as a serial port for any program.

use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

use cantap_virtual::{Options, canopen, car, ecu, open_terminal};

use cantap_work::interrupt;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Options, separated by commas:\n  \
                        car              a vehicle: 500k on channel 1, 125k on channel 2; --dbc prints\n                   \
                        its database. It goes with errors, disturb, ack, channels,\n                   \
                        seed, settings, pace, ppm and serial\n  \
                        canopen          CANopen nodes on channel 1, one of them without a number;\n                   \
                        --print-eds prints their sheet. It does not go with load,\n                   \
                        frames, burst and log\n  \
                        ecu              an ECU with XCP and CCP on channel 1; --print-a2l prints its\n                   \
                        description. It does not go with load, frames, burst and log\n  load=PCT         bus load, 0 to 100 (50)\n  \
                        frames=KIND      std0, std8, ext0, ext8, rtr, mix (mix)\n  \
                        bitrate=RATE     of the bus (default: the rate it is opened at)\n  \
                        burst=N/PERIOD   N frames back to back every PERIOD, in place of a load\n  \
                        errors=PCT       share of the frames that are destroyed (0)\n  \
                        disturb=N        the first N frames that the device sends are destroyed:\n                   \
                        32 make it bus-off (0)\n  \
                        ack=yes|no       whether simulated nodes acknowledge (yes)\n  \
                        wire=apart|joined  a bus for each channel, or one for both (apart)\n  \
                        channels=1|2|both  which buses have traffic (both)\n  \
                        seed=N           another sequence of frames (1)\n  \
                        settings=FILE    where the device keeps what it saves, over a power cycle\n  \
                        pace=real|fast   real time, or as fast as the host reads (real)\n  \
                        ppm=N            how much too fast its crystal is, in parts per million (0)\n  \
                        serial=NAME      the serial number that it tells (VIRTUAL)\n  \
                        log=FILE         replay a trace file at its own times; must come last\n\n\
                        The same options follow `virtual:` wherever a device is asked for.\n\n\
                        Examples:\n  cantap virtual load=100,frames=std0\n  cantap virtual bitrate=250k,log=drive.log\n  \
                        cantap virtual car\n  cantap virtual car --dbc > car.dbc")]
pub struct Args {
    /// The simulated buses.
    #[arg(default_value = "")]
    options: Options,
    /// Print the vehicle's database (a DBC file) and exit.
    #[arg(long, conflicts_with_all = ["print_eds", "print_a2l"])]
    dbc: bool,
    /// Print the sheet of the CANopen nodes (an EDS file) and exit.
    #[arg(long, conflicts_with = "print_a2l")]
    print_eds: bool,
    /// Print the description of the ECU (an A2L file) and exit.
    #[arg(long)]
    print_a2l: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.dbc {
        std::io::stdout().lock().write_all(car::DATABASE.as_bytes())?;
        return Ok(ExitCode::SUCCESS);
    }
    if args.print_eds {
        std::io::stdout().lock().write_all(canopen::SHEET.as_bytes())?;
        return Ok(ExitCode::SUCCESS);
    }
    if args.print_a2l {
        std::io::stdout().lock().write_all(ecu::DESCRIPTION.as_bytes())?;
        return Ok(ExitCode::SUCCESS);
    }
    interrupt::watch()?;
    let terminal = open_terminal(args.options.clone())?;
    let mut out = std::io::stdout().lock();
    writeln!(out, "{}", terminal.path())?;
    out.flush()?;
    eprintln!("cantap: the virtual device is at {}; Ctrl-C ends it", terminal.path());
    while !interrupt::requested() {
        if !terminal.is_running() {
            eprintln!(
                "cantap: the virtual device left its firmware for a bootloader, which it does not have: it is gone"
            );
            break;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(ExitCode::SUCCESS)
}
