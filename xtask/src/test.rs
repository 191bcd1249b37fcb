//! `cargo xtask test`: what a change needs before it is sent in. `cargo xtask ci`: everything that must hold before it lands. Both start
//! from a fresh clone.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use clap::ValueEnum;

use crate::board::Board;
use crate::machine::Machine;
use crate::meanwhile::Meanwhile;
use crate::outcome::Outcome;
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
    run_steps(args, steps, &[], &Board::ALL[..1])
}

/// Every step, with every board's firmware.
pub fn ci(args: &Args) -> Result<()> {
    if !args.only.is_empty() {
        return run_steps(args, &args.only, &[], &Board::ALL);
    }
    let steps: Vec<Step> =
        Step::value_variants().iter().copied().filter(|step| !Step::MEANWHILE.contains(step)).collect();
    run_steps(args, &steps, &Step::MEANWHILE, &Board::ALL)
}

/// Runs the steps one after the other, and others meanwhile; stops at the first that fails.
fn run_steps(args: &Args, steps: &[Step], others: &[Step], boards: &[Board]) -> Result<()> {
    let machine = Machine::new()?;
    let mut done: Vec<(String, Outcome, Duration)> = Vec::new();
    let whole = Instant::now();
    let mut meanwhile = if others.is_empty() { None } else { Some(Meanwhile::begin(others)?) };
    for step in steps {
        let name = step.name();
        println!("\n--- {name}");
        let begin = Instant::now();
        match step.run(&machine, boards) {
            Ok(outcome) => done.push((name, outcome, begin.elapsed())),
            Err(error) => {
                report(&done);
                eprintln!("{name:<16} failed; to repeat it: cargo xtask ci --only {name}");
                return Err(error);
            }
        }
        if let Some(meanwhile) = &mut meanwhile
            && meanwhile.has_failed()?
        {
            break;
        }
    }
    println!();
    if let Some(meanwhile) = meanwhile {
        println!("--- meanwhile");
        let status = meanwhile.end()?;
        println!("\n--- beside them");
        report(&done);
        ensure!(status.success(), "a step that ran meanwhile failed; see above");
    } else {
        report(&done);
    }
    println!("{:<16}    {:>6.1} s by the clock", "all", whole.elapsed().as_secs_f64());
    if args.timings {
        table(&machine, &done);
    }
    Ok(())
}

fn report(done: &[(String, Outcome, Duration)]) {
    for (name, outcome, time) in done {
        match outcome {
            Outcome::Passed => println!("{name:<16} ok {:>6.1} s", time.as_secs_f64()),
            Outcome::Skipped(reason) => println!("{name:<16} NOT RUN: {reason}"),
        }
    }
    let total: Duration = done.iter().map(|(_, _, time)| *time).sum();
    println!("{:<16}    {:>6.1} s", "together", total.as_secs_f64());
}

/// The same for `docs/testing.md`.
fn table(machine: &Machine, done: &[(String, Outcome, Duration)]) {
    println!("\n{}\n\n| step | s |\n|---|---:|", machine.description());
    for (name, outcome, time) in done {
        match outcome {
            Outcome::Passed => println!("| `{name}` | {:.0} |", time.as_secs_f64()),
            Outcome::Skipped(_) => println!("| `{name}` | not run |"),
        }
    }
}
