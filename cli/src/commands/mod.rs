//! The subcommands. Each file has an `Args` for its command line and a `run`.

pub mod align;
pub mod autobaud;
pub mod bits;
#[cfg(target_os = "linux")]
pub mod bridge;
pub mod canopen;
pub mod capture;
pub mod care;
pub mod completions;
pub mod conversations;
pub mod convert;
pub mod db;
pub mod decode;
pub mod defaults;
pub mod demo;
pub mod diff;
pub mod extcap;
pub mod r#gen;
pub mod info;
pub mod j1939;
pub mod list;
pub mod man;
pub mod monitor;
pub mod obd;
pub mod plot;
pub mod replay;
pub mod search;
pub mod selftest;
pub mod send;
pub mod serve;
pub mod stats;
pub mod status;
pub mod timing;
pub mod uds;
pub mod update;
#[cfg(unix)]
pub mod virtual_device;

use std::process::ExitCode;

/// One subcommand.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Show a frame's exact length on the bus, stuff bits and CRC.
    Bits(bits::Args),
    /// Watch a bus or a trace: frames, identifiers, signals, graphs, statistics; send and record.
    Monitor(monitor::Args),
    /// Draw signals, bus load or periods of a trace: SVG, PNG, HTML, or in the terminal.
    Plot(plot::Args),
    /// Measure a trace or a bus: load, rates, periods, losses, errors.
    Stats(stats::Args),
    /// Convert a trace from any format to any other: filtered, cut out, split.
    Convert(convert::Args),
    /// Show what two traces say differently: IDs, periods, lengths, bits.
    Diff(diff::Args),
    /// Set traces of several recorders on one clock by the frames that they share.
    Align(align::Args),
    /// Find frames in a trace by ID, data or a condition on signals.
    Search(search::Args),
    /// List every bit timing of a bit rate, what each is worth, and the one to choose.
    Timing(timing::Args),
    /// Capture what a device hears into a file.
    Capture(capture::Args),
    /// Show what the frames mean: requests and responses, transfers, by protocol.
    Conversations(conversations::Args),
    /// Ask a vehicle by OBD-II: what it supports, live values, trouble codes, its VIN.
    Obd(Box<obd::Args>),
    /// Ask an ECU by UDS: identifiers, sessions, routines, trouble codes, any request.
    Uds(Box<uds::Args>),
    /// Talk with CANopen nodes: find them, read and write objects, start and stop them, give them numbers.
    Canopen(Box<canopen::Args>),
    /// Talk with J1939 nodes: claim an address, ask for parameter groups and trouble codes, send messages.
    J1939(Box<j1939::Args>),
    /// Print the completion script of a shell.
    Completions(completions::Args),
    /// Write the manual pages.
    #[command(hide = true)]
    Man(man::Args),
    /// Show what databases say, and how they suit a trace.
    Db(db::Args),
    /// Show a trace as signals, by a database.
    Decode(decode::Args),
    /// Capture the worst traffic there is, without a board, and check that nothing is lost silently.
    Demo(demo::Args),
    /// Show what a device is.
    Info(info::Args),
    /// List connected boards.
    List(list::Args),
    /// Run a virtual device behind a pseudo terminal.
    #[cfg(unix)]
    Virtual(virtual_device::Args),
    /// Carry a device's channels to and from CAN interfaces of Linux: SocketCAN.
    #[cfg(target_os = "linux")]
    Bridge(bridge::Args),
    /// Share a device: many programs at once, on this machine or on others.
    Serve(serve::Args),
    /// Be interfaces of Wireshark: `cantap extcap install`.
    Extcap(Box<extcap::Args>),
    /// Show a device's state: counters, errors, queue, temperature, registers.
    Status(status::Args),
    /// Test a board: everything that it can show by itself, and a report to send in.
    Selftest(selftest::Args),
    /// Find a bus's bit rate by listening only.
    Autobaud(autobaud::Args),
    /// Send frames: now, periodically, or in reply.
    Send(Box<send::Args>),
    /// Send made-up frames, with cangen's options.
    Gen(r#gen::Args),
    /// Play a trace on a bus at its own times.
    Replay(Box<replay::Args>),
    /// Blink a device's LEDs, to find it among others.
    Identify(care::Identify),
    /// Restart a device's firmware.
    Reset(care::Reset),
    /// Bring a device into its USB bootloader and write a firmware.
    Update(update::Args),
    /// Keep a configuration on the device over a power cycle, or erase it.
    Defaults(Box<defaults::Args>),
}

impl Command {
    /// Runs it. `line` describes the whole command.
    pub fn run(self, line: clap::Command) -> anyhow::Result<ExitCode> {
        match self {
            Self::Bits(args) => bits::run(&args),
            Self::Monitor(args) => monitor::run(&args),
            Self::Plot(args) => plot::run(&args),
            Self::Stats(args) => stats::run(&args),
            Self::Convert(args) => convert::run(&args),
            Self::Diff(args) => diff::run(&args),
            Self::Align(args) => align::run(&args),
            Self::Search(args) => search::run(&args),
            Self::Timing(args) => timing::run(&args),
            Self::Capture(args) => capture::run(&args),
            Self::Conversations(args) => conversations::run(&args),
            Self::Obd(args) => obd::run(&args),
            Self::Uds(args) => uds::run(&args),
            Self::Canopen(args) => canopen::run(&args),
            Self::J1939(args) => j1939::run(&args),
            Self::Completions(args) => completions::run(&args),
            Self::Man(args) => man::run(&args, line),
            Self::Db(args) => db::run(&args),
            Self::Decode(args) => decode::run(&args),
            Self::Demo(args) => demo::run(&args),
            Self::Info(args) => info::run(&args),
            Self::List(args) => list::run(&args),
            #[cfg(unix)]
            Self::Virtual(args) => virtual_device::run(&args),
            Self::Status(args) => status::run(&args),
            Self::Selftest(args) => selftest::run(&args),
            Self::Autobaud(args) => autobaud::run(&args),
            #[cfg(target_os = "linux")]
            Self::Bridge(args) => bridge::run(&args),
            Self::Extcap(args) => extcap::run(*args),
            Self::Serve(args) => serve::run(&args),
            Self::Send(args) => send::run(&args),
            Self::Gen(args) => r#gen::run(&args),
            Self::Replay(args) => replay::run(&args),
            Self::Identify(args) => care::identify(&args),
            Self::Reset(args) => care::reset(&args),
            Self::Update(args) => update::run(&args),
            Self::Defaults(args) => defaults::run(&args),
        }
    }
}
