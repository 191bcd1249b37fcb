//! The subcommands. Each file has an `Args` for its command line and a `run`.

pub mod align;
pub mod autobaud;
pub mod bits;
#[cfg(target_os = "linux")]
pub mod bridge;
pub mod canopen;
pub mod capture;
pub mod care;
pub mod compare_adapters;
pub mod completions;
pub mod conversations;
pub mod convert;
pub mod db;
pub mod decode;
pub mod defaults;
pub mod delay;
pub mod diff;
pub mod disturb;
pub mod doctor;
pub mod extcap;
pub mod gateway;
pub mod r#gen;
pub mod help;
pub mod info;
#[cfg(target_os = "linux")]
pub mod interface;
pub mod j1939;
pub mod list;
pub mod man;
pub mod monitor;
pub mod obd;
pub mod page;
pub mod plot;
pub mod replay;
pub mod report;
pub mod run;
pub mod search;
pub mod selftest;
pub mod send;
pub mod serve;
pub mod stats;
pub mod status;
pub mod timing;
pub mod twin;
pub mod uds;
pub mod ui;
pub mod update;
#[cfg(unix)]
pub mod virtual_device;
pub mod xcp;

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
    /// Make a page of a trace that opens in any browser, offline: rows, graphs, findings.
    Report(report::Args),
    /// Write the page without a trace: drop traces onto it, or open a board from the browser.
    Page(page::Args),
    /// Show a device or a trace in a browser on this machine: live, with recording and sending.
    Ui(Box<ui::Args>),
    /// Measure a trace or a bus: load, rates, periods, losses, errors.
    Stats(stats::Args),
    /// Convert a trace from any format to any other: filtered, cut out, split.
    Convert(convert::Args),
    /// Compare two traces: IDs, periods, lengths, bits.
    Diff(diff::Args),
    /// Measure how long a gateway takes, from a trace of both its buses: delays, missing and extra frames.
    Delay(Box<delay::Args>),
    /// Pass frames on between a device's two buses, as rules say; or try the rules on a trace.
    Gateway(Box<gateway::Args>),
    /// Destroy frames on purpose, on a test bench, with a board that was built for it.
    Disturb(Box<disturb::Args>),
    /// Put traces of several recorders on one clock, using the frames that they have in common.
    Align(align::Args),
    /// Find frames in a trace by ID, data or a condition on signals.
    Search(search::Args),
    /// List every bit timing for a bit rate, with the properties of each, and the recommended one.
    Timing(timing::Args),
    /// Capture what a device receives into a file.
    Capture(capture::Args),
    /// Show what the frames mean: requests and responses, transfers, by protocol.
    Conversations(conversations::Args),
    /// Query a vehicle by OBD-II: what it supports, live values, trouble codes, its VIN.
    Obd(Box<obd::Args>),
    /// Query an ECU by UDS: identifiers, sessions, routines, trouble codes, any request.
    Uds(Box<uds::Args>),
    /// Talk to CANopen nodes: find them, read and write objects, start and stop them, give them numbers.
    Canopen(Box<canopen::Args>),
    /// Measure and calibrate an ECU by XCP or CCP: read, write, poll, record its values, by an A2L file.
    Xcp(Box<xcp::Args>),
    /// Talk to J1939 nodes: claim an address, request parameter groups and trouble codes, send messages.
    J1939(Box<j1939::Args>),
    /// Explain a command, or a topic: wiring, filters, conditions, times.
    Help(help::Args),
    /// Print the completion script of a shell.
    Completions(completions::Args),
    /// Write the manual pages.
    #[command(hide = true)]
    Man(man::Args),
    /// Show the content of databases, and how they match a trace.
    Db(db::Args),
    /// Show a trace as signals, using a database.
    Decode(decode::Args),
    /// Capture the worst possible traffic, without a board, and check that nothing is lost silently.
    Demo(cantap_demo::Args),
    /// Describe a device.
    Info(info::Args),
    /// Find out what is the matter with a port, a device or a bus, and what to do next.
    Doctor(doctor::Args),
    /// List connected boards.
    List(list::Args),
    /// Run a virtual device behind a pseudo-terminal.
    #[cfg(unix)]
    Virtual(virtual_device::Args),
    /// Connect a device's channels with Linux CAN interfaces: SocketCAN.
    #[cfg(target_os = "linux")]
    Bridge(bridge::Args),
    /// Show a CAN interface of Linux, or set its bit rate and mode.
    #[cfg(target_os = "linux")]
    Interface(interface::Args),
    /// Share a device: many programs at once, on this machine or on others.
    Serve(serve::Args),
    /// Provide interfaces for Wireshark: `cantap extcap install`.
    Extcap(Box<extcap::Args>),
    /// Show a device's state: counters, errors, queue, temperature, registers.
    Status(status::Args),
    /// Compare two devices on one bus: what each missed, and how far apart their stamps are.
    CompareAdapters(compare_adapters::Args),
    /// Test a board: everything that it can show on its own, with a report to send in.
    Selftest(selftest::Args),
    /// Find a bus's bit rate by listening only.
    Autobaud(autobaud::Args),
    /// Send frames: now, periodically, or in reply.
    Send(Box<send::Args>),
    /// Send made-up frames, with cangen's options.
    Gen(r#gen::Args),
    /// Play a trace on a bus with its original timing.
    Replay(Box<replay::Args>),
    /// Run nodes and tests as scripts: on simulated buses, or on a device.
    Run(Box<run::Args>),
    /// Learn a bus from a trace, and write scripts that play it.
    Twin(Box<twin::Args>),
    /// Blink a device's LEDs, to find it among others.
    Identify(care::Identify),
    /// Restart a device's firmware.
    Reset(care::Reset),
    /// Put a device into its USB bootloader and write a firmware.
    Update(update::Args),
    /// Keep a configuration on the device across power cycles, or erase it.
    Defaults(Box<defaults::Args>),
}

impl Command {
    /// Whether it is not done when Ctrl-C makes it fail. Others run until then.
    pub const fn ends_by_itself(&self) -> bool {
        matches!(
            self,
            Self::Autobaud(_)
                | Self::Run(_)
                | Self::Obd(_)
                | Self::Uds(_)
                | Self::Xcp(_)
                | Self::Canopen(_)
                | Self::J1939(_)
        )
    }

    /// Runs it. `line` describes the whole command.
    pub fn run(self, line: clap::Command) -> anyhow::Result<ExitCode> {
        match self {
            Self::Bits(args) => bits::run(&args),
            Self::Monitor(args) => monitor::run(&args),
            Self::Plot(args) => plot::run(&args),
            Self::Report(args) => report::run(&args),
            Self::Page(args) => page::run(&args),
            Self::Ui(args) => ui::run(&args),
            Self::Stats(args) => stats::run(&args),
            Self::Convert(args) => convert::run(&args),
            Self::Diff(args) => diff::run(&args),
            Self::Delay(args) => delay::run(*args),
            Self::Gateway(args) => gateway::run(&args),
            Self::Disturb(args) => disturb::run(&args),
            Self::Align(args) => align::run(&args),
            Self::Search(args) => search::run(&args),
            Self::Timing(args) => timing::run(&args),
            Self::Capture(args) => capture::run(&args),
            Self::Conversations(args) => conversations::run(&args),
            Self::Obd(args) => obd::run(&args),
            Self::Uds(args) => uds::run(&args),
            Self::Xcp(args) => xcp::run(&args),
            Self::Canopen(args) => canopen::run(&args),
            Self::J1939(args) => j1939::run(&args),
            Self::Help(args) => help::run(&args, &line),
            Self::Completions(args) => completions::run(&args),
            Self::Man(args) => man::run(&args, line),
            Self::Db(args) => db::run(&args),
            Self::Decode(args) => decode::run(&args),
            Self::Demo(args) => cantap_demo::run(&args, &crate::trace_output::of_demo),
            Self::Info(args) => info::run(&args),
            Self::Doctor(args) => doctor::run(&args),
            Self::List(args) => list::run(&args),
            #[cfg(unix)]
            Self::Virtual(args) => virtual_device::run(&args),
            Self::Status(args) => status::run(&args),
            Self::Selftest(args) => selftest::run(&args),
            Self::CompareAdapters(args) => compare_adapters::run(&args),
            Self::Autobaud(args) => autobaud::run(&args),
            #[cfg(target_os = "linux")]
            Self::Bridge(args) => bridge::run(&args),
            #[cfg(target_os = "linux")]
            Self::Interface(args) => interface::run(&args),
            Self::Extcap(args) => extcap::run(*args),
            Self::Serve(args) => serve::run(&args),
            Self::Send(args) => send::run(&args),
            Self::Gen(args) => r#gen::run(&args),
            Self::Replay(args) => replay::run(&args),
            Self::Run(args) => run::run(&args),
            Self::Twin(args) => twin::run(&args),
            Self::Identify(args) => care::identify(&args),
            Self::Reset(args) => care::reset(&args),
            Self::Update(args) => update::run(&args),
            Self::Defaults(args) => defaults::run(&args),
        }
    }
}
