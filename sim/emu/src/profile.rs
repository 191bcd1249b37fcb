//! Where the core's cycles go: by interrupt and function, what the code itself takes and what it waits for.

use std::collections::HashMap;
use std::fmt;

use crate::cpu::State;
use crate::elf::Image;
use crate::timing::Waits;

/// Cycles of a piece of code.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cost {
    /// Steps of the core: instructions and exception entries.
    pub steps: u64,
    /// Cycles of the code itself.
    pub own: u64,
    /// Cycles spent waiting.
    pub waits: Waits,
}

impl Cost {
    /// All cycles.
    pub fn total(&self) -> u64 {
        self.own + self.waits.total()
    }

    fn add(&mut self, other: &Self) {
        self.steps += other.steps;
        self.own += other.own;
        self.waits.fetch += other.waits.fetch;
        self.waits.data += other.waits.data;
        self.waits.bus += other.waits.bus;
        self.waits.refill += other.waits.refill;
    }
}

/// What was recorded, by exception (0 for thread mode) and instruction.
#[derive(Clone, Debug, Default)]
pub struct Profile {
    costs: HashMap<(u16, u32), Cost>,
}

/// A function's cost in one exception.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// The exception's number; 0 is thread mode.
    pub exception: u16,
    /// The function, as far as the symbols tell. Code that was inlined counts for the function it was
    /// inlined into.
    pub function: String,
    /// Its cost.
    pub cost: Cost,
}

impl Profile {
    /// Accounts one step from `before` to `after`. An exception's entry is its own.
    pub(crate) fn step(&mut self, before: &State, after: &State, cycles: u64, waits: Waits) {
        let entered = after.exception() != before.exception() && after.sp.wrapping_add(0x20) <= before.sp;
        let of = if entered { after } else { before };
        let cost = Cost { steps: 1, own: cycles - waits.total(), waits };
        self.costs.entry((of.exception(), of.pc)).or_default().add(&cost);
    }

    /// Each instruction's cost: exception, address, cost; in no particular order.
    pub fn instructions(&self) -> impl Iterator<Item = (u16, u32, &Cost)> {
        self.costs.iter().map(|((exception, pc), cost)| (*exception, *pc, cost))
    }

    /// The functions of `image` that cost anything, the most expensive first.
    pub fn by_function(&self, image: &Image) -> Vec<Row> {
        let mut functions: HashMap<(u16, &str), Cost> = HashMap::new();
        for ((exception, pc), cost) in &self.costs {
            let name = image.function_at(*pc).map_or("(no symbol)", |(name, _)| name);
            functions.entry((*exception, name)).or_default().add(cost);
        }
        let row = |((exception, name), cost): ((u16, &str), Cost)| Row {
            exception,
            function: without_generics(name),
            cost,
        };
        let mut rows: Vec<Row> = functions.into_iter().map(row).collect();
        rows.sort_by(|a, b| (b.cost.total(), &a.function).cmp(&(a.cost.total(), &b.function)));
        rows
    }
}

/// A function's path without the generic arguments of its type and itself: `<a::B<7>>::c::<d::E>` is
/// `a::B::c`.
fn without_generics(name: &str) -> String {
    let mut depth = 0u32;
    let mut short = String::new();
    for symbol in name.strip_prefix('<').unwrap_or(name).chars() {
        match symbol {
            '<' => depth += 1,
            // The bracket that closes a leading type has lost its partner.
            '>' => depth = depth.saturating_sub(1),
            _ if depth == 0 => short.push(symbol),
            _ => {}
        }
    }
    short.trim_end_matches("::").to_owned()
}

/// Rows as a table, as shares of a span of time.
pub struct Table<'a> {
    /// The rows.
    pub rows: &'a [Row],
    /// Names of the exceptions.
    pub name_of: &'a dyn Fn(u16) -> String,
    /// The number of cycles that is 100 %.
    pub span: u64,
    /// Rows below this are left out.
    pub least_percent: f64,
}

impl fmt::Display for Table<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |cycles: u64| 100.0 * cycles as f64 / self.span.max(1) as f64;
        writeln!(
            f,
            "{:>7} {:>7} {:>7} {:>7} {:>7} {:>7}  in, function",
            "all, %", "own", "fetch", "data", "bus", "refill"
        )?;
        for row in self.rows.iter().filter(|row| percent(row.cost.total()) >= self.least_percent) {
            let Cost { own, waits, .. } = row.cost;
            for cycles in [row.cost.total(), own, waits.fetch, waits.data, waits.bus, waits.refill] {
                write!(f, "{:>7.2} ", percent(cycles))?;
            }
            writeln!(f, " {}, {}", (self.name_of)(row.exception), row.function)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(exception: u32, pc: u32, sp: u32) -> State {
        State { pc, lr: 0, sp, xpsr: exception, primask: false, basepri: 0, faultmask: false }
    }

    #[test]
    fn names_lose_what_they_are_generic_over() {
        let short = ["<a::B<7>>::c::<d::E<f>>", "a::b", "<a::B as c::D<e>>::f"].map(without_generics);
        assert_eq!(short, ["a::B::c", "a::b", "a::B as c::D::f"]);
    }

    /// Thread mode, an interrupt's entry, its instruction, its return.
    #[test]
    fn steps_belong_to_the_instruction_and_an_entry_to_the_handler() {
        let mut profile = Profile::default();
        let waits = Waits { fetch: 3, ..Waits::default() };
        let (thread, handler) = (state(0, 0x100, 0x1000), state(20, 0x200, 0xFE0));
        profile.step(&thread, &thread, 1, Waits::default());
        profile.step(&thread, &handler, 15, waits);
        profile.step(&handler, &thread, 11, Waits::default());
        let mut costs: Vec<(u16, u32, Cost)> =
            profile.instructions().map(|(e, pc, cost)| (e, pc, *cost)).collect();
        costs.sort_by_key(|(exception, ..)| *exception);
        let once = Cost { steps: 1, own: 1, waits: Waits::default() };
        assert_eq!(costs, [(0, 0x100, once), (20, 0x200, Cost { steps: 2, own: 12 + 11, waits })]);
    }
}
