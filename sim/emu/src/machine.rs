//! The machine: core, chip and buses on one timeline.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::bus::Wire;
use crate::can::{MasterReset, ZeroSplit};
use crate::cpu::{Bus, Cpu, Memories, State};
use crate::elf::Image;
use crate::memory_map as map;
use crate::probe::{Change, Probe, Task};
use crate::profile::Profile;
use crate::recording::Recording;
use crate::rom::{self, Start};
use crate::soc::access::SharedBoard;
use crate::soc::rcc::{CRYSTAL_START_US, Crystal, ResetCause};
use crate::soc::{Board, RECEIVE_PINS, bootloader};
use crate::stop::{Reason, Stopped};
use crate::timing::Bound;
use crate::trace::Trace;
use crate::{Clock, Hostile, Peripheral};

/// How often, in steps, to check for what the core does not report: a reset request, a lock-up.
const LOOK_EVERY: u32 = 1024;
const HARD_FAULT: u16 = 3;
/// Functions whose entry marks the start of a panic.
const PANIC_FUNCTIONS: [&str; 4] =
    ["rust_begin_unwind", "__rustc::rust_begin_unwind", "core::panicking::panic_fmt", "panic_handler"];

/// How a machine is set up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Setup {
    /// The core's clock, once the firmware has set it up.
    pub clock: Clock,
    /// The board's crystal.
    pub crystal: Crystal,
    /// How the chip was started.
    pub start: Start,
    /// The interrupts whose masking is measured: bit n is interrupt n.
    pub watched: u128,
    /// The receive pin of each bus: port (0 for A) and pin.
    pub receive_pins: [(usize, u32); 2],
    /// Both controllers on one bus.
    pub joined: bool,
    /// A reset requested by the firmware ends the run, rather than restarting the firmware.
    pub stop_on_reset: bool,
    /// A watchdog reset restarts the firmware, rather than ending the run.
    pub survive_watchdog: bool,
    /// The firmware's own handlers deal with panics and faults, rather than these ending the run.
    pub survive_failures: bool,
    /// How long memories and buses keep the core waiting.
    pub bound: Bound,
    /// What a CAN controller's master reset clears.
    pub master_reset: MasterReset,
    /// What it means that CAN2's banks begin at 0.
    pub zero_split: ZeroSplit,
    /// What the chip does late, wrongly or never. What is attached from outside is its owner's.
    pub hostile: Option<Hostile>,
}

impl Setup {
    /// The defaults: a good crystal of this frequency, no interrupt watched, two buses, restart on request, end on a watchdog
    /// reset, a core that never waits.
    pub fn new(clock: Clock, crystal_hz: u64) -> Self {
        Self {
            clock,
            crystal: Crystal { hz: crystal_hz, start_us: Some(CRYSTAL_START_US) },
            start: Start::PowerOn,
            watched: 0,
            receive_pins: RECEIVE_PINS,
            joined: false,
            stop_on_reset: false,
            survive_watchdog: false,
            survive_failures: false,
            bound: Bound::Best,
            master_reset: MasterReset::default(),
            zero_split: ZeroSplit::default(),
            hostile: None,
        }
    }
}

/// An emulated board with its firmware.
pub struct Machine {
    cpu: Cpu,
    board: Arc<Mutex<Board>>,
    image: Image,
    setup: Setup,
    probe: Probe,
    trace: Option<Trace>,
    profile: Option<Profile>,
    recording: Option<Recording>,
    panics: Vec<u32>,
    held_lines: u128,
    lines: u128,
    next_event: u64,
    stalled_until: u64,
    look_in: u32,
    resets: u64,
    /// Whether it matters if the core executes a barrier.
    awaits_barrier: bool,
    /// Whether the chip has run at all.
    started: bool,
    /// Which exceptions have accessed each attached device, by the device's interrupt.
    accessors: BTreeMap<u16, BTreeSet<u16>>,
    /// The priority of the least urgent watched interrupt, looked up when BASEPRI is first seen set.
    watched_priority: Option<u8>,
}

impl Machine {
    /// A machine at power-on, with `image` in flash.
    pub fn new(image: Image, setup: Setup) -> Self {
        Self::with_recording(image, setup, None)
    }

    /// The same, with everything that the core executes recorded to `out`, if it is given; see [`crate::recording`].
    pub fn with_recording(image: Image, setup: Setup, out: Option<Box<dyn Write + Send>>) -> Self {
        let memories = Memories::new();
        for (address, bytes) in image.segments() {
            memories.flash.write(address, bytes);
        }
        let mut board = Board::new(&memories, setup.clock, setup.crystal);
        board.can.set_master_reset(setup.master_reset);
        board.can.set_zero_split(setup.zero_split);
        board.receive_at(setup.receive_pins);
        if let Some(hostile) = &setup.hostile {
            board.set_hostile(hostile);
        }
        if setup.joined {
            board.wires = [Wire::new(&[0, 1]), Wire::new(&[])];
        }
        let board = Arc::new(Mutex::new(board));
        let bus: Arc<dyn Bus> = Arc::new(SharedBoard(Arc::clone(&board)));
        let (recording, bus) = match out.map(|out| Recording::new(out, Arc::clone(&bus))) {
            Some((recording, recorded)) => (Some(recording), recorded),
            None => (None, bus),
        };
        let cpu = Cpu::new(memories, &bus, setup.bound);
        let panics = PANIC_FUNCTIONS.iter().filter_map(|name| image.address_of(name)).collect();
        Self {
            cpu,
            board,
            image,
            setup,
            probe: Probe::default(),
            trace: None,
            profile: None,
            recording,
            panics,
            held_lines: 0,
            lines: 0,
            next_event: 0,
            stalled_until: 0,
            look_in: LOOK_EVERY,
            resets: 0,
            awaits_barrier: false,
            started: false,
            accessors: BTreeMap::new(),
            watched_priority: None,
        }
    }

    /// The chip and what is wired to it. It stays locked while the guard lives: hold only one at a time, and
    /// none across [`Self::run_until`].
    pub fn board(&self) -> MutexGuard<'_, Board> {
        lock(&self.board)
    }

    /// Puts a device at a range of addresses (`memory_map::OTG_FS`, for example), with its interrupt.
    pub fn attach(
        &mut self,
        range: std::ops::Range<u32>,
        irq: u16,
        device: Arc<Mutex<dyn Peripheral + Send>>,
    ) {
        self.board().attach(range, irq, device);
    }

    /// Core cycles since power-on.
    pub fn now(&self) -> u64 {
        self.cpu.now()
    }

    /// The core and its memories.
    pub fn cpu(&self) -> &Cpu {
        &self.cpu
    }

    /// The firmware.
    pub fn image(&self) -> &Image {
        &self.image
    }

    /// What the run cost so far.
    pub fn probe(&self) -> &Probe {
        &self.probe
    }

    /// Starts counting from zero.
    pub fn reset_probe(&mut self) {
        self.probe.reset(self.cpu.now());
        self.watched_priority = None;
    }

    /// System resets so far, not counting power-on.
    pub fn resets(&self) -> u64 {
        self.resets
    }

    /// Keeps interrupt lines (bit n is interrupt n) from reaching the core, as firmware that masks them
    /// for too long would. 0 lets all of them through again.
    pub fn hold_lines(&mut self, lines: u128) {
        self.held_lines = lines;
    }

    /// Records what happens from now on.
    pub fn start_trace(&mut self) {
        let mut trace = Trace::new(self.setup.clock);
        for (n, wire) in self.board().wires.iter().enumerate() {
            trace.skip(n, wire.history());
        }
        self.trace = Some(trace);
    }

    /// Ends recording and returns it.
    pub fn take_trace(&mut self) -> Option<Trace> {
        self.trace.take()
    }

    /// Starts recording where the cycles go.
    pub fn start_profile(&mut self) {
        self.profile = Some(Profile::default());
    }

    /// Ends recording and returns the profile.
    pub fn take_profile(&mut self) -> Option<Profile> {
        self.profile.take()
    }

    /// The recording under way.
    pub fn recording(&self) -> Option<&Recording> {
        self.recording.as_ref()
    }

    /// Ends recording and returns it.
    pub fn take_recording(&mut self) -> Option<Recording> {
        self.recording.take()
    }

    /// The exceptions that ran since the probe was reset, `span` cycles ago.
    pub fn tasks(&self, span: u64) -> Vec<Task> {
        let probe = self.probe();
        (0..crate::probe::EXCEPTIONS as u16)
            .filter(|number| probe.entries(*number) > 0)
            .map(|number| Task {
                name: self.exception_name(number),
                entries: probe.entries(number),
                percent: 100.0 * probe.cycles(number) as f64 / span.max(1) as f64,
                longest_us: self.setup.clock.to_us(probe.longest_run(number)),
            })
            .collect()
    }

    /// What runs as exception `number`: its name, or thread mode.
    pub fn task_name(&self, number: u16) -> String {
        if number == 0 { "thread mode".to_owned() } else { self.exception_name(number) }
    }

    /// The exceptions that have accessed an attached device's registers, by the device's interrupt; 0 is thread mode.
    pub fn accessors(&self, irq: u16) -> impl Iterator<Item = u16> {
        self.accessors.get(&irq).into_iter().flatten().copied()
    }

    /// An exception's name: its handler's, if the vector table and the symbols give it.
    pub fn exception_name(&self, number: u16) -> String {
        let handler = self.cpu.word(map::FLASH.start + 4 * u32::from(number)).unwrap_or(0) & !1;
        match self.image.function_at(handler) {
            Some((name, 0)) if !name.contains("DefaultHandler") => name.to_owned(),
            _ if number >= 16 => format!("interrupt {}", number - 16),
            _ => format!("exception {number}"),
        }
    }

    /// Runs until core cycle `until`, or a few cycles beyond: instructions are not interrupted.
    pub fn run_until(&mut self, until: u64) -> Result<(), Stopped> {
        if !self.started {
            self.started = true;
            if self.setup.start == Start::Bootloader {
                bootloader::leave(&mut lock(&self.board), &mut self.cpu);
            }
        }
        self.refresh();
        while self.cpu.now() < until {
            if self.cpu.now() >= self.next_event {
                self.service()?;
            }
            if self.cpu.now() < self.stalled_until {
                let from = self.cpu.now();
                self.cpu.advance_idle(self.next_event.min(self.stalled_until).min(until));
                self.probe.stood_still(self.cpu.now() - from);
                if let Some(trace) = &mut self.trace {
                    trace.stalled(from, self.cpu.now());
                }
            } else if self.cpu.asleep() {
                let from = self.cpu.now();
                self.cpu.advance_idle(self.next_event.min(until));
                self.probe.slept(self.cpu.now() - from);
                if let Some(trace) = &mut self.trace {
                    trace.slept(from, self.cpu.now());
                }
            } else {
                self.step()?;
            }
        }
        self.refresh();
        Ok(())
    }

    fn step(&mut self) -> Result<(), Stopped> {
        let before = *self.cpu.state();
        if self.awaits_barrier && self.cpu.at_barrier() {
            lock(&self.board).barrier();
        }
        let cycles = self.cpu.step();
        let after = *self.cpu.state();
        if let Some(recording) = &mut self.recording {
            recording.step(&self.cpu);
        }
        let change = self.probe.step(&before, &after, cycles);
        if let Some(profile) = &mut self.profile {
            profile.step(&before, &after, cycles, self.cpu.waits());
        }
        if let Some(change) = change {
            self.exception_changed(change)?;
        }
        self.follow_masks(&after);
        if self.cpu.take_touched() {
            if let Some(irq) = lock(&self.board).take_reached() {
                self.accessors.entry(irq).or_default().insert(before.exception());
            }
            self.refresh();
        }
        if !self.setup.survive_failures && self.panics.contains(&after.pc) {
            return Err(self.stopped(Reason::Panic));
        }
        self.look_in -= 1;
        if self.look_in == 0 {
            self.look()?;
        }
        Ok(())
    }

    fn exception_changed(&mut self, change: Change) -> Result<(), Stopped> {
        let now = self.cpu.now();
        if let Some(trace) = &mut self.trace {
            match change {
                Change::Enter(exception) => trace.enter(exception, now),
                Change::Leave(exception) => trace.leave(exception, now),
                Change::Chain(ended, entered) => {
                    trace.leave(ended, now);
                    trace.enter(entered, now);
                }
            }
        }
        match change {
            Change::Enter(HARD_FAULT) | Change::Chain(_, HARD_FAULT) => {
                let mut stopped = self.stopped(Reason::HardFault(self.cpu.fault_status()));
                if stopped.pc == rom::ENTRY & !1 {
                    stopped.reason = Reason::Bootloader;
                } else if self.setup.survive_failures {
                    return Ok(());
                }
                Err(stopped)
            }
            _ => Ok(()),
        }
    }

    /// Measures how long the watched interrupts are kept waiting by PRIMASK, FAULTMASK or BASEPRI.
    fn follow_masks(&mut self, state: &State) {
        let masked = state.primask
            || state.faultmask
            || state.basepri != 0 && state.basepri <= self.watched_priority();
        if masked == self.probe.in_window() {
            return;
        }
        let waits = self.lines & self.setup.watched != 0;
        let window = self.probe.masked(masked, waits, self.cpu.now(), state.pc);
        if let (Some(window), Some(trace)) = (window, &mut self.trace) {
            trace.masked(window.start, window.start + window.cycles);
        }
    }

    fn watched_priority(&mut self) -> u8 {
        let (cpu, watched) = (&self.cpu, self.setup.watched);
        *self.watched_priority.get_or_insert_with(|| {
            let lines = (0..u128::BITS as u16).filter(|line| watched >> line & 1 != 0);
            lines.map(|line| cpu.priority_of(line)).max().unwrap_or(0)
        })
    }

    /// Checks for what the core does not report.
    fn look(&mut self) -> Result<(), Stopped> {
        self.look_in = LOOK_EVERY;
        if self.cpu.locked_up() {
            return Err(self.stopped(Reason::LockUp));
        }
        if self.cpu.reset_requested() {
            if self.setup.stop_on_reset {
                return Err(self.stopped(Reason::Reset));
            }
            self.restart(ResetCause::Software);
        }
        Ok(())
    }

    fn service(&mut self) -> Result<(), Stopped> {
        let now = self.cpu.now();
        let deadline = {
            let mut board = lock(&self.board);
            board.advance(now);
            board.watchdog_deadline()
        };
        if deadline.is_some_and(|deadline| deadline <= now) {
            if !self.setup.survive_watchdog {
                return Err(self.stopped(Reason::Watchdog));
            }
            self.restart(ResetCause::Watchdog);
        }
        self.look()?;
        self.refresh();
        Ok(())
    }

    fn restart(&mut self, cause: ResetCause) {
        self.stalled_until = 0;
        lock(&self.board).reset(cause, self.cpu.now());
        self.cpu.reset();
        if let Some(recording) = &mut self.recording {
            recording.reset();
        }
        self.watched_priority = None;
        self.resets += 1;
        self.refresh();
    }

    /// Exchanges the board's crystal: for one that has stopped, or one that starts again. A chip that runs from it stands still until the
    /// watchdog, which has its own oscillator, resets it. Returns whether it does.
    pub fn set_crystal(&mut self, crystal: Crystal) -> bool {
        let stands_still = lock(&self.board).set_crystal(crystal, self.cpu.now());
        if stands_still {
            self.stalled_until = u64::MAX;
        }
        stands_still
    }

    /// The supply fails for a moment: a power-on reset at whatever instruction this is. What `seed` decides of the memories is lost, and
    /// an operation of the flash is left half done.
    pub fn brown_out(&mut self, seed: u64) {
        /// Memory is lost in pieces.
        const PIECE: usize = 64;
        let mut random = fastrand::Rng::with_seed(seed);
        if self.cpu.now() < self.stalled_until {
            lock(&self.board).cut_flash_short(|| random.u32(..));
        }
        let lost_percent = [0, 10, 100][random.usize(..3)];
        for range in [map::SRAM, map::CCM] {
            let Some(memory) = self.cpu.memory(range.start) else { continue };
            for piece in range.step_by(PIECE) {
                if random.u32(..100) < lost_percent {
                    let mut bytes = [0; PIECE];
                    random.fill(&mut bytes);
                    memory.write(piece, &bytes);
                }
            }
        }
        self.restart(ResetCause::PowerOn);
    }

    /// Queries everything for its interrupt line and next event.
    fn refresh(&mut self) {
        let mut board = lock(&self.board);
        self.lines = board.lines() & !self.held_lines;
        self.next_event = board.next_event().unwrap_or(u64::MAX);
        self.awaits_barrier = board.awaits_barrier();
        self.cpu.show_at_zero(board.memory_at_zero() == rom::SYSTEM_MEMORY);
        let stall = board.take_stall();
        if stall > 0 {
            self.stalled_until = self.cpu.now() + stall;
        }
        for n in 0..2 {
            let fill = board.can.controllers[n].fifo_fill(0).max(board.can.controllers[n].fifo_fill(1));
            self.probe.fifo(n, fill);
            if let Some(trace) = &mut self.trace {
                trace.fifo(n, fill, self.cpu.now());
                trace.frames(n, board.wires[n].history());
            }
        }
        drop(board);
        self.cpu.set_lines(self.lines);
    }

    fn stopped(&self, reason: Reason) -> Stopped {
        Stopped::here(reason, self.setup.clock, &self.cpu, &self.image)
    }
}

/// If another holder of the lock panicked, the state it left is as good as any other.
fn lock(board: &Mutex<Board>) -> MutexGuard<'_, Board> {
    board.lock().unwrap_or_else(PoisonError::into_inner)
}
