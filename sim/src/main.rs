//! The `cantap-sim` command: runs a firmware ELF on the emulated board.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use cantap_emu::Image;
use cantap_emu::probe::Task;
use cantap_emu::timing::Bound;
use cantap_emu::traffic::{Kind, parse_log};
use cantap_emu::usb_host::Timing;
use cantap_sim::CYCLES_PER_SECOND;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::firmware::{self, FirmwareError};
use cantap_sim::hostile;
use cantap_sim::run::{self, Load, Options, Report};
use cantap_sim::soak;
use cantap_wire::Channel;
use clap::{Parser, Subcommand};

mod serve;

/// The check of a run failed.
const CHECK_FAILED: u8 = 3;

/// Runs cantap's firmware on an emulated STM32F405 board.
#[derive(Parser)]
#[command(
    name = "cantap-sim",
    version,
    after_help = "Exit codes: 0 success, 1 failure, 2 wrong command line, 3 a check did not hold."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Put traffic on the buses, capture it over USB and check every frame.
    Run(Args),
    /// Capture for hours: both channels full, with stalls, requests and replays in turn; reports memory, stamps and the device's clock.
    Soak(SoakArgs),
    /// Serve the board to a kernel as a USB device, by USB/IP or usbredir.
    Usbip(UsbipArgs),
}

/// The command line of `soak`.
#[derive(clap::Args)]
struct SoakArgs {
    /// The firmware's ELF, as `cargo xtask firmware` makes it.
    firmware: PathBuf,
    /// Emulated time; the round of turns under way is finished.
    #[arg(long, default_value = "3600s", value_parser = some_seconds)]
    seconds: Duration,
    /// Seed of the traffic.
    #[arg(long, default_value = "1")]
    seed: u64,
}

/// The command line of `usbip`.
#[derive(clap::Args)]
#[command(
    after_help = "Listens on free ports of 127.0.0.1 and writes them to FOLDER/ports as variables of a shell: USBIP for\n\
                  `usbip --tcp-port PORT attach -r HOST -b 1-1`, REDIR for QEMU's usb-redir, CONTROL for lines that change buses and cable (docs/emulator.md)."
)]
struct UsbipArgs {
    /// The firmware's ELF, as `cargo xtask firmware` makes it.
    firmware: PathBuf,
    /// Take any program for the chip, such as other firmware for a USB adapter.
    #[arg(long)]
    any: bool,
    /// Where the ports are written, and whatever a line asks to be written.
    folder: PathBuf,
}

/// The command line of `run`.
#[derive(clap::Args)]
#[command(
    after_help = "The host that captures is the emulator's own. Both channels only listen, at 1 Mbit/s unless set \
                        otherwise.\nExit code 0 means that every frame on the buses was delivered in order and bit for \
                        bit, or counted lost.\n\n\
                        Examples:\n  cantap-sim run target/firmware/cantap-olimex-p405.elf\n  \
                        cantap-sim run FIRMWARE.elf --seconds 3 --channels 1 --stall 300ms --json\n  \
                        cantap-sim run FIRMWARE.elf --seconds 0.05 --trace run.json    open it at ui.perfetto.dev\n  \
                        cantap-sim run FIRMWARE.elf --pty --load 20                    then: cantap capture -d THE_NAME -b 1M"
)]
pub struct Args {
    /// The firmware's ELF, as `cargo xtask firmware` makes it.
    firmware: PathBuf,
    /// Emulated seconds of traffic. By default 1, or the length of the replay; a PTY is served without end.
    #[arg(long, value_parser = some_seconds)]
    seconds: Option<Duration>,
    /// Bus load in per cent.
    #[arg(long, value_name = "PCT", default_value = "100", value_parser = percent)]
    load: f64,
    /// Which frames: std0, std8, ext0, ext8, rtr or mix.
    #[arg(long, default_value = "std0")]
    frames: Kind,
    /// Channels that carry traffic and are captured: 1, 2 or both.
    #[arg(long, default_value = "both", value_parser = channels)]
    channels: Channels,
    /// Bit rate of both buses, in bit/s. By default 1000000; with --pty, the rate at which the channel is opened.
    #[arg(long, value_name = "BPS")]
    bitrate: Option<u32>,
    /// The host stops reading for this time, in the middle of the run.
    #[arg(long, value_name = "TIME", value_parser = seconds)]
    stall: Option<Duration>,
    /// Put the host behind a high-speed hub, with this many microframes from one packet to the next: 2 gives 0.26 MB/s.
    #[arg(long, value_name = "MICROFRAMES", default_value = "0")]
    hub: u32,
    /// Replay this candump log at its own times, in place of generated frames.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["load", "frames"])]
    replay: Option<PathBuf>,
    /// Seed of the traffic. The same seed gives the same run.
    #[arg(long, default_value = "1")]
    seed: u64,
    /// How long memories and buses keep the core waiting: best (not at all) or worst (as long as the manuals allow).
    #[arg(long, value_name = "BOUND", default_value = "best")]
    timing: Bound,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Write a picture of interrupts, masked windows, sleep, FIFO fill levels and frames (Chrome trace, Perfetto).
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Print where the core's cycles go, by interrupt and function.
    #[arg(long, conflicts_with = "json")]
    profile: bool,
    /// Make the silicon late, wrong or silent and the host misbehave, as this seed says, in place of a capture; then check that the
    /// device is back, silent unless asked, and has delivered or counted every frame.
    #[arg(long, value_name = "SEED", conflicts_with_all = ["stall", "replay", "trace", "profile", "pty"])]
    hostile: Option<u64>,
    /// With --hostile: try this many seeds, one after the other.
    #[arg(long, value_name = "COUNT", default_value = "1", requires = "hostile")]
    trials: u64,
    /// Serve the device on a pseudo-terminal, whose name is printed, rather than capture from it. Time stands
    /// still while the client does not read.
    #[arg(long, conflicts_with_all = ["stall", "json", "trace", "profile"])]
    pty: bool,
    /// With --pty: time continues while the client does not read.
    #[arg(long, requires = "pty")]
    real_time: bool,
}

#[derive(Clone, Debug)]
struct Channels(Vec<Channel>);

fn channels(text: &str) -> Result<Channels, String> {
    match text {
        "1" => Ok(Channels(vec![Channel::Can1])),
        "2" => Ok(Channels(vec![Channel::Can2])),
        "both" => Ok(Channels(Channel::ALL.to_vec())),
        _ => Err("give 1, 2 or both".to_owned()),
    }
}

/// A time: a number of seconds, or a number with a unit: `400ms`, `3s`, `250us`.
fn seconds(text: &str) -> Result<Duration, String> {
    let unit_at = text.find(|symbol: char| symbol.is_ascii_alphabetic()).unwrap_or(text.len());
    let (number, unit) = text.split_at(unit_at);
    let factor = match unit {
        "us" => 1e-6,
        "ms" => 1e-3,
        "" | "s" => 1.0,
        _ => return Err("give a time in s, ms or us, such as 400ms".to_owned()),
    };
    let value = number.parse::<f64>().ok().and_then(|value| Duration::try_from_secs_f64(value * factor).ok());
    value.ok_or_else(|| "give a time as a number and a unit, such as 400ms".to_owned())
}

/// A time that is not zero.
fn some_seconds(text: &str) -> Result<Duration, String> {
    seconds(text).and_then(|time| if time.is_zero() { Err("give more than 0".to_owned()) } else { Ok(time) })
}

fn percent(text: &str) -> Result<f64, String> {
    let number = text.trim_end_matches('%').parse::<f64>().ok();
    number.filter(|number| (0.0..=100.0).contains(number)).ok_or_else(|| "give per cent, 0 to 100".to_owned())
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Run(args) => run(&args),
        Command::Soak(args) => soak(&args),
        Command::Usbip(args) => usbip(&args),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            eprintln!("cantap-sim: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn open(firmware: &Path) -> anyhow::Result<Image> {
    firmware::open(firmware).map_err(|error| match error {
        FirmwareError::Unreadable { .. } => anyhow::anyhow!("{error}"),
        _ => anyhow::anyhow!("{}: {error}", firmware.display()),
    })
}

fn usbip(args: &UsbipArgs) -> anyhow::Result<ExitCode> {
    let (image, setup) = if args.any {
        let name = args.firmware.display();
        let bytes = std::fs::read(&args.firmware).with_context(|| format!("{name} cannot be read"))?;
        let image = Image::program(&bytes).with_context(|| name.to_string())?;
        let setup = board::setup_for_any(&image);
        let setup = setup.with_context(|| format!("{name} sets up no clock that is a multiple of 12 MHz"))?;
        (image, setup)
    } else {
        let image = open(&args.firmware)?;
        let setup = board::setup_for(&image);
        (image, setup)
    };
    cantap_sim::usbip::serve(image, setup, &args.folder)?;
    Ok(ExitCode::SUCCESS)
}

fn soak(args: &SoakArgs) -> anyhow::Result<ExitCode> {
    let image = open(&args.firmware)?;
    let soak = soak::run(image, args.seconds.as_secs_f64(), args.seed, |line| eprintln!("{line}"))?;
    println!("{}", soak.to_json());
    Ok(if soak.faults.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(CHECK_FAILED) })
}

fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let image = open(&args.firmware)?;
    let options = options(args)?;
    if args.pty {
        serve::pty(image, options, args.seconds, args.real_time)?;
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(seed) = args.hostile {
        return Ok(trials(&image, seed, args.trials, args.json));
    }
    // Before the run, so that a file that cannot be written does not waste it.
    let trace_file = args.trace.as_deref().map(create).transpose()?;
    let (report, picture) = run::run(image, &options)?;
    if let (Some(mut file), Some((machine, trace))) = (trace_file, picture) {
        trace
            .write(&mut file, |exception| machine.exception_name(exception))
            .and_then(|()| file.flush())
            .context("the trace cannot be written; make room on the disk")?;
    }
    let mut out = io::stdout().lock();
    let printed = if args.json { writeln!(out, "{}", report.to_json()) } else { print(&mut out, &report) };
    // If the pipe is closed, its reader has seen enough.
    printed.or_else(|error| if error.kind() == io::ErrorKind::BrokenPipe { Ok(()) } else { Err(error) })?;
    Ok(if report.ok { ExitCode::SUCCESS } else { ExitCode::from(CHECK_FAILED) })
}

/// Runs hostile trials and prints those that failed; of a single one, everything that happened.
fn trials(image: &Image, first: u64, count: u64, json: bool) -> ExitCode {
    let (mut failed, mut delivered, mut lost) = (0, 0, 0);
    for seed in first..first.saturating_add(count) {
        let trial = hostile::try_seed(image.clone(), seed);
        delivered += trial.delivered;
        lost += trial.lost;
        failed += u64::from(!trial.faults.is_empty());
        if json || count > 1 && trial.faults.is_empty() {
            continue;
        }
        println!("seed {seed}: {}", if trial.faults.is_empty() { "every check held" } else { "FAILED" });
        if count == 1 {
            for event in &trial.story {
                println!("  {event}");
            }
        }
        for fault in &trial.faults {
            println!("  FAULT: {fault}");
        }
    }
    if json {
        let sum = serde_json::json!({ "seed": first, "trials": count, "failed": failed, "delivered": delivered, "lost": lost });
        println!("{sum}");
    } else {
        println!(
            "{count} trials from seed {first}: {failed} failed; {delivered} frames delivered, {lost} counted lost"
        );
    }
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::from(CHECK_FAILED) }
}

fn create(path: &Path) -> anyhow::Result<BufWriter<File>> {
    let file = File::create(path).with_context(|| format!("{} cannot be created", path.display()))?;
    Ok(BufWriter::new(file))
}

fn options(args: &Args) -> anyhow::Result<Options> {
    let mut options = Options {
        load: Load::Frames { kind: args.frames, percent: args.load },
        channels: args.channels.0.clone(),
        bitrate_bps: args.bitrate,
        stall: args.stall,
        seed: args.seed,
        bound: args.timing,
        timing: Timing::new(CLOCK).behind_hub(args.hub),
        trace: args.trace.is_some(),
        profile: args.profile,
        ..Options::default()
    };
    let bitrate_bps = args.bitrate.unwrap_or(run::DEFAULT_BITRATE_BPS);
    cantap_sim::rig::timing(bitrate_bps)?;
    if let Some(path) = &args.replay {
        let name = path.display();
        let text = std::fs::read_to_string(path).with_context(|| format!("{name} cannot be read"))?;
        let lines = parse_log(&text, 0, CLOCK).with_context(|| name.to_string())?;
        let (load, cycles) = run::replay(lines, bitrate_bps);
        options.load = load;
        options.seconds = cycles as f64 / CYCLES_PER_SECOND as f64;
    }
    if let Some(seconds) = args.seconds {
        options.seconds = seconds.as_secs_f64();
    } else if let Some(stall) = args.stall {
        // A stall has traffic before and after it.
        options.seconds = options.seconds.max(stall.as_secs_f64() + 1.0);
    }
    Ok(options)
}

fn print(out: &mut impl Write, report: &Report) -> io::Result<()> {
    writeln!(out, "{:.3} emulated seconds", report.seconds)?;
    for one in &report.channels {
        writeln!(
            out,
            "channel {}: {} on the bus, {} delivered, {} lost (controller {}, queue {}, link {}); \
             {:.1} frames/s, {:.2} % bus load",
            one.channel.number(),
            one.sent,
            one.delivered,
            one.lost.total(),
            one.lost.controller,
            one.lost.queue,
            one.lost.link,
            one.frames_per_s,
            one.bus_load_pct
        )?;
    }
    writeln!(out, "USB: {:.3} bytes per frame", report.wire_bytes_per_frame)?;
    writeln!(out, "queue: at most {} of {} bytes", report.queue_high_water_bytes, report.queue_bytes)?;
    let stamps = &report.stamps;
    writeln!(
        out,
        "stamps: {} / {} / {} ns after the frame was valid (earliest, median, latest of {}); {} upper bounds",
        stamps.min, stamps.median, stamps.max, stamps.exact, stamps.bounds
    )?;
    writeln!(out, "stamping interrupt masked for {:.0} ns at most", report.masked_ns_max)?;
    writeln!(
        out,
        "core: {:.1} % awake, {:.1} cycles per frame in the receive interrupts ({} timing)",
        report.cpu_load_pct, report.isr_cycles_per_frame, report.bound
    )?;
    for Task { name, entries, percent: share, .. } in &report.tasks {
        writeln!(out, "  {name}: {entries} times, {share:.2} %")?;
    }
    if let Some(profile) = &report.profile {
        write!(out, "{profile}")?;
    }
    writeln!(out, "emulation: {:.2} s per emulated second", report.host_s_per_emulated_s)?;
    for odd in &report.odd_accesses {
        writeln!(out, "odd register access: {odd}")?;
    }
    for fault in &report.faults {
        writeln!(out, "FAULT: {fault}")?;
    }
    writeln!(
        out,
        "{}",
        if report.ok { "the law of counting holds" } else { "THE LAW OF COUNTING DOES NOT HOLD" }
    )
}
