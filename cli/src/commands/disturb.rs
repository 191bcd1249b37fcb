//! `cantap disturb`: error frames on purpose, by a board that was built for it.

use std::io::Write as _;
use std::process::ExitCode;
use std::time::Duration;

use cantap::device::Records;
use cantap::wire::message::{MAX_DISTURBANCE_BITS, Mode};
use cantap::{Channel, Id, TraceEvent, TraceRecord};
use cantap_trace::counted;
use cantap_trace::grammar;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::disturbance::{self, Disturbance, Plan, When};
use cantap_work::interrupt;

use crate::one_board::OneBoard;
use crate::timing_args::TimingArgs;
use crate::{args, completion, exit, stderr};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "For a test bench only: each disturbance destroys what is on the bus, and raises the error counters of every node on it. The \
                  device drives its TX pin dominant for so many bits; a timer ends that even if the firmware hangs. It takes part in the bus \
                  meanwhile. Only a board built with the feature `disturb` can do this, and only where the TX pin has a timer (docs/disturb.md).\n\n\
                  bxCAN knows a frame only at its end. --id therefore hits a periodic frame at its predicted time, in its middle, from the \
                  intervals of the last ones; how far off that was, the output says.\n\nExamples:\n  \
                  cantap disturb -d /dev/ttyACM0 -b 500k --at 100ms --yes-on-a-test-bench\n  \
                  cantap disturb -b 500k --id 123 --nth 20 --yes-on-a-test-bench\n  \
                  cantap disturb -b 500k --id 123 --count 16 --length 1 \\\n      \
                  --yes-on-a-test-bench\n\n\
                  Exit code: 1 if a disturbance came to nothing."
)]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// The channel: 1 or 2.
    #[arg(short, long, default_value = "1", value_parser = args::channel, add = completion::channels())]
    channel: Channel,
    #[command(flatten)]
    timing: TimingArgs,
    /// When, from the channel's opening on, in the device's time: 100ms, 2s.
    #[arg(long, value_name = "TIME", value_parser = args::duration, required_unless_present = "id")]
    at: Option<Duration>,
    /// Onto a periodic frame with this identifier.
    #[arg(long, value_name = "ID", value_parser = grammar::identifier, conflicts_with_all = ["at", "every"])]
    id: Option<Id>,
    /// Onto which of them, counted from 1 since the channel's opening; without it, the first whose time can be predicted.
    #[arg(long, value_name = "N", requires = "id", value_parser = clap::value_parser!(u64).range(1..))]
    nth: Option<u64>,
    /// For how many bits, 1 to 12. Six are an error frame anywhere.
    #[arg(long, value_name = "BITS", default_value = "6",
          value_parser = clap::value_parser!(u8).range(1..=i64::from(MAX_DISTURBANCE_BITS)))]
    length: u8,
    /// How many disturbances.
    #[arg(short = 'n', long, value_name = "N", default_value = "1", value_parser = clap::value_parser!(u32).range(1..))]
    count: u32,
    /// The time from one to the next: 20ms or more.
    #[arg(long, value_name = "TIME", default_value = "100ms", value_parser = args::duration)]
    every: Duration,
    /// Nothing depends on this bus. Without it nothing is done.
    #[arg(long, required = true)]
    yes_on_a_test_bench: bool,
    /// Print one JSON object per disturbance.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let device = args.device.open()?;
    let mut records = Source(device.records());
    let options = ChannelOptions { timing: args.timing.options(), ..ChannelOptions::default() };
    disturbance::unlock(&device, device.name())?;
    let opened =
        options.open(&device, [args.channel].into_iter(), Mode::Normal, None, &stderr::reporter())?;
    let clock_hz = device.hello().can_clock_hz;
    let plan = Plan {
        channel: args.channel,
        bitrate_bps: opened.first().map_or(500_000, |(_, config)| config.timing.bitrate_bps(clock_hz)),
        when: match args.id {
            Some(id) => When::Onto { id, nth: args.nth },
            None => When::At { first: args.at.unwrap_or_default(), every: args.every },
        },
        bits: args.length,
        count: args.count,
    };
    let mut to_nothing = 0;
    let done = disturbance::disturb(&device, &plan, &mut records, |outcome| {
        to_nothing += u32::from(outcome.length_ns == 0);
        print(args, outcome)
    });
    let stopped = device.stop();
    done?;
    stopped?;
    Ok(if to_nothing == 0 { ExitCode::SUCCESS } else { ExitCode::from(exit::FAILURE) })
}

/// The device's records until Ctrl-C.
struct Source(Records);

impl disturbance::Records for Source {
    fn next(&mut self, wait: Duration) -> anyhow::Result<Option<Vec<TraceRecord>>> {
        if interrupt::requested() {
            return Ok(None);
        }
        Ok(self.0.next_batch(wait)?)
    }
}

fn print(args: &Args, outcome: &Disturbance) -> anyhow::Result<()> {
    let Disturbance { time_ns, length_ns, errors, late_ns, .. } = outcome;
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(out, "{}", outcome.json(args.channel))?;
    } else {
        let event = TraceEvent::Disturbed { length_ns: *length_ns };
        let (seconds, us) = (time_ns / 1_000_000_000, time_ns / 1000 % 1_000_000);
        let errors = match errors {
            0 => "no bus error".to_owned(),
            errors => counted(*errors as usize, "bus error"),
        };
        write!(out, "({seconds}.{us:06}) can{} {event}; {errors}", args.channel.index())?;
        if let Some(late_ns) = late_ns {
            write!(out, "; the next frame ended {:.1} us later than predicted", *late_ns as f64 / 1000.0)?;
        }
        writeln!(out)?;
    }
    out.flush()?;
    Ok(())
}
