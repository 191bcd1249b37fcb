//! Where the processor's time goes while the emulated board does something: by interrupt, and by function; and the longest locks.

use anyhow::{Context, Result};
use cantap_emu::elf::Image;
use cantap_emu::probe::Task;
use cantap_emu::profile::Table;
use cantap_emu::timing::Bound;
use cantap_sim::locks::{self, Lock};
use cantap_sim::rig::Rig;

/// Functions with a smaller share of the processor's time are not listed.
const LEAST_PERCENT: f64 = 0.2;

/// Prints the shares while `act` runs on what `prepare` made: by interrupt for the best and the worst bound, by
/// function for the worst.
pub fn print(
    what: &str,
    prepare: impl Fn(Bound) -> Result<Rig>,
    act: impl Fn(&mut Rig) -> Result<()>,
) -> Result<()> {
    println!("processor by interrupt, {what}, % of the time: at best / at worst");
    let mut shares = Vec::new();
    let mut functions = String::new();
    for bound in Bound::ALL {
        let mut rig = prepare(bound)?;
        rig.machine.reset_probe();
        rig.machine.start_profile();
        act(&mut rig)?;
        let machine = &mut rig.machine;
        let profile = machine.take_profile().context("it was started")?;
        let span = machine.now() - machine.probe().since();
        shares.push(machine.tasks(span));
        let rows = profile.by_function(machine.image());
        let name_of = &|number| machine.task_name(number);
        functions = Table { rows: &rows, name_of, span, least_percent: LEAST_PERCENT }.to_string();
    }
    let [best, worst] = &shares[..] else { unreachable!("two bounds") };
    for Task { name, entries, percent, longest_us } in best {
        let slow = worst.iter().find(|task| task.name == *name);
        let [slow_percent, slow_longest] = slow.map_or([0.0; 2], |task| [task.percent, task.longest_us]);
        println!(
            "  {name:<24} {percent:>6.2} / {slow_percent:>5.2}  ({entries} times, at most {longest_us:.1} / {slow_longest:.1} us)"
        );
    }
    println!("at worst by function: its own, and waiting for instructions, data in flash, buses, branches");
    print!("{functions}");
    Ok(())
}

/// Prints how long commands and the tick hold up what sends and drains, in each situation: at best and at worst.
pub fn print_locks(image: &Image) -> Result<()> {
    println!("longest lock over the tasks of priority 4, at best / at worst, us");
    let [best, worst] = Bound::ALL.map(|bound| locks::longest(image, bound));
    for (Lock { during, longest_us: best, .. }, Lock { longest_us: worst, pc, .. }) in
        best?.into_iter().zip(worst?)
    {
        println!("  {during:<24} {best:>6.2} / {worst:>5.2}  (until {pc:08X})");
    }
    Ok(())
}
