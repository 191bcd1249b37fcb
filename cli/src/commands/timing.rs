//! `cantap timing`: every timing for a bit rate, and its properties. It needs no device.

use std::io::Write;
use std::process::ExitCode;

use cantap::bit_timing::{self, Assessment, LINE_DELAY_NS_PER_M, NODE_DELAY_NS, TimingRequest};

use crate::args;
use crate::completion;
use crate::timing_args::Preferences;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "PROP+PS1 and PS2 are in quanta; the prescaler counts clocks of the CAN controller. SJW is the range \
                  that the segments allow; tolerance and cable are for the jump width in brackets, with PS1 as long \
                  as it.\n\nExamples:\n  cantap timing -b 500k\n  \
                  cantap timing -b 1M --clock 42M --sample-point 80\n  cantap timing -b 83.333k --json"
)]
pub struct Args {
    /// Bit rate in bit/s: 500000, 500k, 1M.
    #[arg(short, long, value_name = "RATE", value_parser = args::bitrate, add = completion::bit_rates())]
    bitrate: u32,
    /// Clock of the CAN controller in Hz: 36000000, 36M. cantap's boards have 36 MHz.
    #[arg(long, value_name = "HZ", default_value = "36M", value_parser = clock)]
    clock: u32,
    #[command(flatten)]
    preferences: Preferences,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// No CAN controller has a faster clock.
const MAX_CLOCK_HZ: u32 = 1_000_000_000;

fn clock(text: &str) -> Result<u32, String> {
    let clock = args::per_second(text).filter(|clock| *clock <= MAX_CLOCK_HZ);
    clock.ok_or_else(|| {
        "write the clock of the CAN controller in Hz, such as 36000000 or 36M, up to 1000M".to_owned()
    })
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    args.preferences.check()?;
    let (bitrate_bps, sjw) = (args.bitrate, args.preferences.sjw);
    let request =
        TimingRequest::Rate { bitrate_bps, sample_point_percent: args.preferences.sample_point, sjw };
    let chosen = Assessment::of(&request.resolve(args.clock)?, args.clock);
    let all = bit_timing::all(args.clock, bitrate_bps, sjw);
    let mut out = std::io::stdout().lock();
    if args.json {
        let object = |assessment: &Assessment| object(assessment, bitrate_bps, assessment == &chosen);
        let timings: Vec<_> = all.iter().map(object).collect();
        let object = serde_json::json!({
            "bitrate_bps": bitrate_bps,
            "clock_hz": args.clock,
            "chosen": object(&chosen),
            "timings": timings,
        });
        writeln!(out, "{object}")?;
        return Ok(ExitCode::SUCCESS);
    }
    writeln!(out, "  BRP PROP+PS1 PS2  sample  quanta  quantum ns  SJW      error ppm  tolerance  cable")?;
    for assessment in &all {
        let timing = &assessment.timing;
        writeln!(
            out,
            "{} {:>3} {:>8} {:>3} {:>5.1} % {:>7} {:>11.1}  1..{} ({}) {:>8.1} {:>8.3} % {:>4.0} m",
            if assessment == &chosen { '*' } else { ' ' },
            timing.prescaler,
            timing.segment1,
            timing.segment2,
            assessment.sample_point_percent,
            timing.quanta(),
            assessment.quantum_ns,
            assessment.max_jump_width,
            timing.jump_width,
            assessment.error_ppm(bitrate_bps),
            assessment.oscillator_tolerance_percent,
            assessment.cable_m,
        )?;
    }
    let timing = &chosen.timing;
    writeln!(
        out,
        "\n* chosen: --segments {},{},{},{} or --btr 0x{:08X}, {} quanta of {:.1} ns at {} Hz\n",
        timing.prescaler,
        timing.segment1,
        timing.segment2,
        timing.jump_width,
        bit_timing::to_register(timing),
        timing.quanta(),
        chosen.quantum_ns,
        args.clock,
    )?;
    writeln!(out, "{}", chosen.drawing())?;
    writeln!(out, "SY synchronisation, PR propagation, P1 P2 phase segments\n")?;
    writeln!(
        out,
        "tolerance: of each node's clock, the smaller of min(PS1,PS2)/(2(13 tbit - PS2)) and SJW/(20 tbit)\n\
         cable: (PROP/2 - {NODE_DELAY_NS} ns for a node, in and out) / {LINE_DELAY_NS_PER_M} ns/m"
    )?;
    Ok(ExitCode::SUCCESS)
}

fn object(assessment: &Assessment, bitrate_bps: u32, chosen: bool) -> serde_json::Value {
    let timing = &assessment.timing;
    serde_json::json!({
        "prescaler": timing.prescaler,
        "segment1": timing.segment1,
        "segment2": timing.segment2,
        "sjw": timing.jump_width,
        "sjw_max": assessment.max_jump_width,
        "prop": assessment.propagation,
        "ps1": assessment.phase1,
        "quanta": timing.quanta(),
        "quantum_ns": assessment.quantum_ns,
        "sample_point_pct": assessment.sample_point_percent,
        "bitrate_bps": assessment.bitrate_bps,
        "error_ppm": assessment.error_ppm(bitrate_bps),
        "oscillator_tolerance_pct": assessment.oscillator_tolerance_percent,
        "cable_m": assessment.cable_m,
        "btr": format!("0x{:08X}", bit_timing::to_register(timing)),
        "chosen": chosen,
    })
}
