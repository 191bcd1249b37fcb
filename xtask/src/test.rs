//! `cargo xtask test`: what a change needs before it is sent in. `cargo xtask ci`: everything that must hold before it lands. Both start
//! from a fresh clone.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use clap::ValueEnum;

use crate::board::Board;
use crate::machine::Machine;
use crate::meanwhile::{Meanwhile, Priority};
use crate::outcome::Outcome;
use crate::processor_time;
use crate::steps::Step;

/// The arguments of `cargo xtask test` and `cargo xtask ci`.
#[derive(clap::Args)]
pub struct Args {
    /// Only this step; may be given again. Later steps use the firmware that earlier ones built.
    #[arg(long, value_name = "STEP")]
    only: Vec<Step>,
    /// Print the times as a table for a page, with the machine that they were measured on.
    #[arg(long)]
    timings: bool,
}

/// What a change needs: the first steps, with the default board's firmware.
pub fn run(args: &Args) -> Result<()> {
    let steps = if args.only.is_empty() { &Step::TEST } else { &args.only[..] };
    run_steps(args, steps, false, &Board::ALL[..1])
}

/// Every step, with every board's firmware.
pub fn ci(args: &Args) -> Result<()> {
    if !args.only.is_empty() {
        return run_steps(args, &args.only, false, &Board::ALL);
    }
    let others = [&Step::MEANWHILE[..], &Step::BESIDE_TESTS, &Step::WEEKLY].concat();
    let is_now = |step: &Step| !others.contains(step);
    let steps: Vec<Step> = Step::value_variants().iter().copied().filter(is_now).collect();
    run_steps(args, &steps, true, &Board::ALL)
}

/// A step that has run.
struct Done {
    name: String,
    outcome: Outcome,
    /// By the clock.
    time: Duration,
    /// Of the processors, if the system tells.
    processor: Option<Duration>,
}

/// Runs the steps one after the other, if in parallel with [`Step::MEANWHILE`] from the beginning and with [`Step::BESIDE_TESTS`] from the
/// tests on; stops at the first that fails.
fn run_steps(args: &Args, steps: &[Step], in_parallel: bool, boards: &[Board]) -> Result<()> {
    let machine = Machine::new()?;
    let mut done: Vec<Done> = Vec::new();
    let whole = Instant::now();
    let begin = |steps: &[Step], priority| in_parallel.then(|| Meanwhile::begin(steps, priority)).transpose();
    let mut meanwhile = begin(&Step::MEANWHILE, Priority::Lowest)?;
    let mut beside_tests = None;
    'steps: for step in steps {
        match step {
            Step::Tests => beside_tests = begin(&Step::BESIDE_TESTS, Priority::Normal)?,
            Step::Kernel => end(beside_tests.take())?,
            _ => {}
        }
        let name = step.name();
        println!("\n--- {name}");
        let (since, processor) = (Instant::now(), processor_time::of_children());
        match step.run(&machine, boards) {
            Ok(outcome) => {
                let processor =
                    processor_time::of_children().zip(processor).map(|(now, then)| now.saturating_sub(then));
                done.push(Done { name, outcome, time: since.elapsed(), processor });
            }
            Err(error) => {
                report(&done);
                eprintln!("{name:<16} failed; to repeat it: cargo xtask ci --only {name}");
                return Err(error);
            }
        }
        for lane in [&mut meanwhile, &mut beside_tests].into_iter().flatten() {
            if lane.has_failed()? {
                break 'steps;
            }
        }
    }
    println!();
    end(beside_tests)?;
    end(meanwhile)?;
    println!("--- beside them");
    report(&done);
    println!("{:<16}    {:>6.1} s by the clock", "all", whole.elapsed().as_secs_f64());
    if args.timings {
        table(&machine, &done);
    }
    Ok(())
}

/// Waits for a lane's end.
fn end(lane: Option<Meanwhile>) -> Result<()> {
    let Some(lane) = lane else { return Ok(()) };
    println!("--- meanwhile");
    ensure!(lane.end()?.success(), "a step that ran meanwhile failed; see above");
    Ok(())
}

fn report(done: &[Done]) {
    for Done { name, outcome, time, processor } in done {
        match outcome {
            Outcome::Passed => {
                println!("{name:<16} ok {:>6.1} s{}", time.as_secs_f64(), of_processor(*processor));
            }
            Outcome::Flaky(tests) => {
                println!("{name:<16} ok {:>6.1} s{}", time.as_secs_f64(), of_processor(*processor));
                println!("{:<16} FLAKY, failed beside others and passed alone: {}", "", tests.join(", "));
            }
            Outcome::Skipped(reason) => println!("{name:<16} NOT RUN: {reason}"),
        }
    }
    let time: Duration = done.iter().map(|step| step.time).sum();
    let processor: Option<Duration> = done.iter().map(|step| step.processor).sum();
    println!("{:<16}    {:>6.1} s{}", "together", time.as_secs_f64(), of_processor(processor));
}

fn of_processor(time: Option<Duration>) -> String {
    time.map_or_else(String::new, |time| format!(", {:.1} s of processor", time.as_secs_f64()))
}

/// The same for `docs/testing.md`.
fn table(machine: &Machine, done: &[Done]) {
    println!("\n{}\n\n| step | s | of processor |\n|---|---:|---:|", machine.description());
    for Done { name, outcome, time, processor } in done {
        match outcome {
            Outcome::Passed | Outcome::Flaky(_) => {
                let processor =
                    processor.map_or("–".to_owned(), |time| format!("{:.0}", time.as_secs_f64()));
                println!("| `{name}` | {:.0} | {processor} |", time.as_secs_f64());
            }
            Outcome::Skipped(_) => println!("| `{name}` | not run | – |"),
        }
    }
}
