//! General-purpose and basic timers, counting up (RM0090 Rev 21 §18, §20): prescaler, auto-reload,
//! four compare channels, their flags and interrupt; capture of the count by an internal trigger (TRC); PWM outputs; OC2REF as the trigger
//! output, and the start of the count by an internal trigger. Capture by pins, the other output modes (except those that channel 2's reference
//! needs) and the other slave modes are not modelled.

const CEN: u32 = 1;
const UDIS: u32 = 1 << 1;
const URS: u32 = 1 << 2;
const OPM: u32 = 1 << 3;
const ARPE: u32 = 1 << 7;
/// SMCR.TS: which internal trigger is selected, with all others 0 to 3.
const TS_SHIFT: u32 = 4;
/// CCxS: the channel's input is the selected trigger.
const TRC: u32 = 3;
/// SMCR.SMS: a trigger starts the count.
const STARTED_BY_TRIGGER: u32 = 6;
/// CR2.MMS: the trigger output is OC2REF.
const OC2REF_IS_TRGO: u32 = 5;
/// OCxM: active on match, forced active, PWM modes 1 and 2.
const ACTIVE_ON_MATCH: u32 = 1;
const FORCED_ACTIVE: u32 = 5;
const PWM_1: u32 = 6;
const PWM_2: u32 = 7;
/// OCxPE: the compare value is taken at the next update.
const PRELOADED: u32 = 1 << 3;
/// UIF, and the flags of compare channels 1 to 4 above it.
const UIF: u32 = 1;

/// One timer.
#[derive(Clone, Debug)]
pub struct Timer {
    /// 0xFFFF or 0xFFFF_FFFF.
    max: u32,
    cycles_per_clock: u64,
    control: u32,
    control2: u32,
    slave: u32,
    interrupts: u32,
    flags: u32,
    modes: [u32; 3],
    count: u32,
    /// Ticks up to the last overflow, from when the count was last set.
    overflown: u64,
    /// When `count` was last a whole number of ticks.
    since: u64,
    prescaler: u32,
    next_prescaler: u32,
    reload: u32,
    next_reload: u32,
    compare: [u32; 4],
    next_compare: [u32; 4],
    /// Channel 2's reference, as long as its mode is to become active on a match.
    reference_2: bool,
    /// When that rose, until it is taken.
    rose_at: Option<u64>,
    /// TIMx_OR: the sources of the internal triggers and inputs.
    options: u32,
}

impl Timer {
    /// A timer of 16 or 32 bits after reset.
    pub fn new(bits: u32) -> Self {
        let max = if bits == 32 { u32::MAX } else { 0xFFFF };
        Self {
            max,
            cycles_per_clock: 1,
            control: 0,
            control2: 0,
            slave: 0,
            interrupts: 0,
            flags: 0,
            modes: [0; 3],
            count: 0,
            overflown: 0,
            since: 0,
            prescaler: 0,
            next_prescaler: 0,
            reload: max,
            next_reload: max,
            compare: [0; 4],
            next_compare: [0; 4],
            reference_2: false,
            rose_at: None,
            options: 0,
        }
    }

    /// Sets the core cycles per clock of the timer; the count continues from where it is.
    pub fn set_cycles_per_clock(&mut self, cycles: u64, now: u64) {
        if cycles != self.cycles_per_clock {
            self.advance(now);
            self.cycles_per_clock = cycles;
        }
    }

    /// A timer of the same width and clock after reset.
    #[must_use]
    pub fn after_reset(&self) -> Self {
        let bits = if self.max == u32::MAX { 32 } else { 16 };
        Self { cycles_per_clock: self.cycles_per_clock, ..Self::new(bits) }
    }

    /// Reads a register; `None` where there is none.
    pub fn read(&mut self, offset: u32, now: u64) -> Option<u32> {
        self.advance(now);
        Some(match offset {
            0x00 => self.control,
            0x04 => self.control2,
            0x08 => self.slave,
            0x0C => self.interrupts,
            0x10 => self.flags,
            0x14 => 0,
            0x18..=0x20 => self.modes[(offset - 0x18) as usize / 4],
            0x24 => self.count,
            0x28 => self.next_prescaler,
            0x2C => self.next_reload,
            0x34..=0x40 => {
                let channel = (offset - 0x34) as usize / 4;
                if self.input(channel) != 0 {
                    // Reading what was captured clears the flag that says so.
                    self.flags &= !(UIF << (1 + channel));
                }
                if self.input(channel) == 0 { self.next_compare[channel] } else { self.compare[channel] }
            }
            0x50 if self.max == u32::MAX => self.options,
            _ => return None,
        })
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32, now: u64) -> Option<()> {
        self.advance(now);
        match offset {
            0x00 => {
                if value & CEN != 0 && self.control & CEN == 0 {
                    self.since = now;
                }
                self.control = value & 0x3FF;
            }
            0x04 => self.control2 = value,
            0x08 => self.slave = value,
            0x0C => self.interrupts = value,
            // Flags are cleared by writing 0.
            0x10 => self.flags &= value,
            0x14 => {
                if value & 1 != 0 {
                    (self.count, self.overflown) = (0, 0);
                    self.since = now;
                    if self.control & UDIS == 0 {
                        self.take_preloads();
                        self.flags |= if self.control & URS == 0 { UIF } else { 0 };
                    }
                }
                self.flags |= value & 0x1E;
            }
            0x18..=0x20 => {
                self.modes[(offset - 0x18) as usize / 4] = value;
                match self.output_mode(1) {
                    ACTIVE_ON_MATCH => {}
                    FORCED_ACTIVE if !self.reference_2 => self.rise(now),
                    mode => self.reference_2 = mode == FORCED_ACTIVE,
                }
            }
            0x24 => (self.count, self.overflown, self.since) = (value & self.max, 0, now),
            0x28 => self.next_prescaler = value & 0xFFFF,
            0x2C => {
                self.next_reload = value & self.max;
                if self.control & ARPE == 0 {
                    self.reload = self.next_reload;
                }
            }
            0x34..=0x40 => {
                let channel = (offset - 0x34) as usize / 4;
                // A captured value is read-only.
                if self.input(channel) == 0 {
                    self.next_compare[channel] = value & self.max;
                    if self.output(channel) & PRELOADED == 0 {
                        self.compare[channel] = value & self.max;
                    }
                }
            }
            0x50 if self.max == u32::MAX => self.options = value & 0xCC0,
            _ => return None,
        }
        Some(())
    }

    /// A pulse from the peripheral with number `source` in ITR1_RMP, at core cycle `at`, which may be slightly in the past.
    pub fn remapped_trigger(&mut self, source: u32, at: u64, now: u64) {
        if self.options >> 10 & 3 != source || self.slave >> TS_SHIFT & 7 != 1 {
            return;
        }
        self.advance(now);
        // The count may have moved on since.
        let back = self.since.saturating_sub(at).div_ceil(self.tick());
        let count = self.count.wrapping_sub(back as u32) & self.max;
        for channel in 0..4 {
            if self.input(channel) == TRC && self.modes[2] >> (4 * channel) & 1 != 0 {
                let flag = UIF << (1 + channel);
                // Overwrites a value that nobody has read: CCxOF.
                self.flags |= if self.flags & flag == 0 { flag } else { flag << 8 };
                self.compare[channel] = count;
            }
        }
    }

    /// A rising edge of another timer's trigger output, which is internal trigger `number`, at core cycle `at`, which may be slightly in
    /// the past.
    pub fn internal_trigger(&mut self, number: u32, at: u64) {
        let selected = self.slave >> TS_SHIFT & 7 == number && self.slave & 7 == STARTED_BY_TRIGGER;
        if selected && self.control & CEN == 0 {
            self.control |= CEN;
            self.since = at;
        }
    }

    /// When the trigger output last rose, if it has since the last call.
    pub fn take_trigger(&mut self) -> Option<u64> {
        self.rose_at.take()
    }

    /// The level of a channel's output (0 for channel 1), if it is enabled.
    pub fn output_level(&self, channel: usize) -> Option<bool> {
        let enabled = self.modes[2] >> (4 * channel) & 3;
        let active = match self.output_mode(channel) {
            PWM_1 => self.count < self.compare[channel],
            PWM_2 => self.count >= self.compare[channel],
            ACTIVE_ON_MATCH if channel == 1 => self.reference_2,
            mode => mode == FORCED_ACTIVE,
        };
        // CCxP: active is low.
        (self.input(channel) == 0 && enabled & 1 != 0).then_some(active != (enabled & 2 != 0))
    }

    /// Whether it counts.
    pub const fn is_counting(&self) -> bool {
        self.control & CEN != 0
    }

    /// When an enabled output of PWM, or the trigger output, changes next by itself.
    fn next_change(&self) -> Option<u64> {
        const ANY_OUTPUT: u32 = 0x1111;
        if !self.is_counting() || self.modes[2] & ANY_OUTPUT == 0 && !self.awaits_rise() {
            return None;
        }
        let is_pwm = |channel: &usize| {
            self.input(*channel) == 0
                && self.modes[2] >> (4 * channel) & 1 != 0
                && matches!(self.output_mode(*channel), PWM_1 | PWM_2)
        };
        let pulses = (0..4).filter(is_pwm);
        let edges =
            pulses.flat_map(|channel| [self.ticks_to(self.compare[channel]), Some(self.ticks_to_update())]);
        let rises = self.awaits_rise().then(|| self.ticks_to(self.compare[1]));
        let ticks = edges.chain(rises).flatten().min()?;
        Some(self.since + ticks * self.tick())
    }

    fn awaits_rise(&self) -> bool {
        self.control2 >> 4 & 7 == OC2REF_IS_TRGO
            && self.output_mode(1) == ACTIVE_ON_MATCH
            && self.input(1) == 0
            && !self.reference_2
    }

    fn rise(&mut self, at: u64) {
        self.reference_2 = true;
        if self.control2 >> 4 & 7 == OC2REF_IS_TRGO {
            self.rose_at = Some(at);
        }
    }

    /// A channel's byte of CCMR.
    fn output(&self, channel: usize) -> u32 {
        self.modes[channel / 2] >> (8 * (channel % 2)) & 0xFF
    }

    /// OCxM.
    fn output_mode(&self, channel: usize) -> u32 {
        self.output(channel) >> 4 & 7
    }

    /// CCxS: 0 for an output, which compares; otherwise the source of the input.
    fn input(&self, channel: usize) -> u32 {
        self.modes[channel / 2] >> (8 * (channel % 2)) & 3
    }

    /// The core cycle at which the count would have been zero, had it always run at its present rate; however often it has overflown since
    /// then.
    pub fn origin(&mut self, now: u64) -> u64 {
        self.advance(now);
        self.since.saturating_sub((self.overflown + u64::from(self.count)) * self.tick())
    }

    /// Whether an enabled flag is set.
    pub fn irq(&self) -> bool {
        self.flags & self.interrupts & 0x1F != 0
    }

    /// When the next enabled flag that is not set yet will be set, or an output changes.
    pub fn next_event(&self) -> Option<u64> {
        self.rose_at.into_iter().chain(self.next_flag()).chain(self.next_change()).min()
    }

    fn next_flag(&self) -> Option<u64> {
        let wanted = self.interrupts & !self.flags & 0x1F;
        if self.control & CEN == 0 || wanted == 0 {
            return None;
        }
        let ticks = (0..5).filter(|flag| wanted >> flag & 1 != 0).filter_map(|flag| match flag {
            0 => Some(self.ticks_to_update()),
            channel => self.ticks_to(self.compare[channel - 1]),
        });
        Some(self.since + ticks.min()? * self.tick())
    }

    /// Counts up to `now`.
    pub fn advance(&mut self, now: u64) {
        if self.control & CEN == 0 {
            self.since = now;
            return;
        }
        loop {
            let ticks = now.saturating_sub(self.since) / self.tick();
            if ticks == 0 {
                return;
            }
            let to_update = self.ticks_to_update();
            let step = ticks.min(to_update);
            for channel in 0..4 {
                let compares = self.input(channel) == 0;
                let due = self.ticks_to(self.compare[channel]);
                if let Some(due) = due.filter(|due| compares && *due <= step) {
                    self.flags |= UIF << (1 + channel);
                    if channel == 1 && self.awaits_rise() {
                        self.rise(self.since + due * self.tick());
                    }
                }
            }
            self.since += step * self.tick();
            if step < to_update {
                self.count += step as u32;
                return;
            }
            self.overflown += u64::from(self.count) + to_update;
            self.count = 0;
            if self.control & UDIS == 0 {
                self.take_preloads();
                self.flags |= UIF;
            }
            if self.control & OPM != 0 {
                self.control &= !CEN;
                return;
            }
        }
    }

    fn take_preloads(&mut self) {
        self.prescaler = self.next_prescaler;
        self.reload = self.next_reload;
        for channel in 0..4 {
            if self.input(channel) == 0 {
                self.compare[channel] = self.next_compare[channel];
            }
        }
    }

    /// Core cycles of a count.
    fn tick(&self) -> u64 {
        self.cycles_per_clock * (u64::from(self.prescaler) + 1)
    }

    fn ticks_to_update(&self) -> u64 {
        // A count beyond the reload value continues to the maximum.
        let top = if self.count > self.reload { self.max } else { self.reload };
        u64::from(top - self.count) + 1
    }

    /// Ticks until the count becomes `value`, within this period or at its reload.
    fn ticks_to(&self, value: u32) -> Option<u64> {
        if value > self.count && (value <= self.reload || self.count > self.reload) {
            Some(u64::from(value - self.count))
        } else if value <= self.reload {
            Some(self.ticks_to_update() + u64::from(value))
        } else {
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The firmware's stamp timer: 72 MHz / 6.
    fn stamp_timer() -> Timer {
        let mut timer = Timer::new(32);
        timer.set_cycles_per_clock(2, 0);
        timer.write(0x28, 5, 0).unwrap();
        timer.write(0x14, 1, 0).unwrap();
        timer.write(0x10, 0, 0).unwrap();
        timer.write(0x00, CEN, 0).unwrap();
        timer
    }

    #[test]
    fn it_counts_twelve_million_a_second() {
        let mut timer = stamp_timer();
        assert_eq!(timer.read(0x24, 144_000_000).unwrap(), 12_000_000);
        assert_eq!(timer.read(0x24, 144_000_011).unwrap(), 12_000_000);
        assert_eq!(timer.read(0x24, 144_000_012).unwrap(), 12_000_001);
    }

    #[test]
    fn it_wraps_at_32_bits() {
        let mut timer = stamp_timer();
        timer.write(0x24, u32::MAX, 0).unwrap();
        timer.write(0x0C, UIF, 0).unwrap();
        assert_eq!(timer.next_event(), Some(12));
        assert_eq!(timer.read(0x24, 12).unwrap(), 0);
        assert!(timer.irq());
        assert_eq!(timer.read(0x10, 12).unwrap() & UIF, UIF);
    }

    #[test]
    fn its_zero_stays_where_it_was_when_it_wraps() {
        let mut timer = stamp_timer();
        timer.write(0x24, 10, 1000).unwrap();
        assert_eq!(timer.origin(5000), 880);
        assert_eq!(timer.origin(880 + 12 * (1 << 32)), 880);
        assert_eq!(timer.origin(900 + 36 * (1 << 32)), 880);
        timer.write(0x24, 0, 99_000).unwrap();
        assert_eq!(timer.origin(99_000), 99_000);
    }

    #[test]
    fn a_compare_interrupt_comes_at_its_tick() {
        let mut timer = stamp_timer();
        timer.write(0x34, 100, 0).unwrap();
        timer.write(0x0C, UIF << 1, 0).unwrap();
        assert_eq!(timer.next_event(), Some(1200));
        timer.advance(1199);
        assert!(!timer.irq());
        timer.advance(1200);
        assert!(timer.irq());
        timer.write(0x10, !(UIF << 1), 1300).unwrap();
        assert!(!timer.irq());
        // The same value recurs a whole turn later.
        assert_eq!(timer.next_event(), Some((100 + (1 << 32)) * 12));
    }

    /// The stamp timer's channel 2, and a timer that it starts for one pulse: low from its first tick to its end.
    fn pair(ticks: u32) -> (Timer, Timer) {
        let mut master = stamp_timer();
        master.write(0x04, OC2REF_IS_TRGO << 4, 0).unwrap();
        master.write(0x38, 100, 0).unwrap();
        master.write(0x18, 1 << 12, 0).unwrap();
        let mut pulse = Timer::new(16);
        pulse.set_cycles_per_clock(2, 0);
        let setup = [
            (0x08, 1 << TS_SHIFT | STARTED_BY_TRIGGER),
            (0x18, 0x78),
            (0x20, 3),
            (0x28, 5),
            (0x2C, ticks),
            (0x34, 1),
            (0x00, OPM | URS | ARPE),
            (0x14, 1),
        ];
        for (offset, value) in setup {
            pulse.write(offset, value, 0).unwrap();
        }
        (master, pulse)
    }

    #[test]
    fn a_match_starts_another_timer_s_pulse_which_ends_by_itself() {
        let (mut master, mut pulse) = pair(72);
        assert_eq!((master.next_event(), pulse.next_event()), (Some(1200), None));
        assert_eq!(pulse.output_level(0), Some(true));
        master.advance(1205);
        let at = master.take_trigger().unwrap();
        assert_eq!((at, master.take_trigger(), master.next_event()), (1200, None, None));
        pulse.internal_trigger(1, at);
        for (now, level) in [(1211, true), (1212, false), (1212 + 72 * 12 - 1, false), (1212 + 72 * 12, true)]
        {
            pulse.advance(now);
            assert_eq!(pulse.output_level(0), Some(level), "{now}");
        }
        assert_eq!(pulse.read(0x10, 3000).unwrap() & UIF, UIF);
        assert_eq!((pulse.read(0x00, 3000).unwrap() & CEN, pulse.next_event()), (0, None));
        assert_eq!(pulse.output_level(0), Some(true));
    }

    #[test]
    fn a_trigger_that_was_not_chosen_starts_nothing() {
        for (number, slave) in [(0, 1 << TS_SHIFT | STARTED_BY_TRIGGER), (1, 1 << TS_SHIFT), (1, 0)] {
            let (_, mut pulse) = pair(72);
            pulse.write(0x08, slave, 0).unwrap();
            pulse.internal_trigger(number, 100);
            assert_eq!((pulse.next_event(), pulse.output_level(0)), (None, Some(true)));
        }
    }

    /// The stamp timer, with channel 4 latching OTG_FS's start of frame.
    fn latching() -> Timer {
        let mut timer = stamp_timer();
        timer.write(0x50, 2 << 10, 0).unwrap();
        timer.write(0x08, 1 << TS_SHIFT, 0).unwrap();
        timer.write(0x1C, TRC << 8, 0).unwrap();
        timer.write(0x20, 1 << 12, 0).unwrap();
        timer
    }

    #[test]
    fn a_trigger_latches_the_count_and_leaves_it_running() {
        let mut timer = latching();
        timer.remapped_trigger(2, 1211, 1300);
        assert_eq!(timer.read(0x10, 1300).unwrap() & 0x1E1E, UIF << 4);
        assert_eq!(timer.read(0x24, 1300).unwrap(), 108);
        assert_eq!(timer.read(0x40, 1300).unwrap(), 100);
        assert_eq!(timer.read(0x10, 1300).unwrap() & 0x1E1E, 0, "reading clears the flag");
        for at in [2400, 3600] {
            timer.remapped_trigger(2, at, at);
        }
        assert_eq!(timer.read(0x10, 3601).unwrap() & 0x1E1E, UIF << 4 | UIF << 12, "overcapture");
        assert_eq!(timer.read(0x40, 3601).unwrap(), 300);
    }

    #[test]
    fn a_trigger_latches_nothing_that_was_not_asked_for() {
        for (offset, value) in [(0x50, 0), (0x08, 0), (0x1C, 0), (0x20, 0)] {
            let mut timer = latching();
            timer.write(offset, value, 0).unwrap();
            timer.remapped_trigger(2, 1200, 1200);
            assert_eq!(timer.read(0x10, 1200).unwrap() & 0x1E1E, 0, "{offset:#x}");
            assert_eq!(timer.read(0x40, 1200).unwrap(), 0, "{offset:#x}");
        }
        let mut timer = latching();
        timer.remapped_trigger(3, 1200, 1200);
        assert_eq!(timer.read(0x40, 1200).unwrap(), 0, "another peripheral's");
    }

    #[test]
    fn a_periodic_tick_comes_every_period() {
        let mut timer = Timer::new(16);
        timer.set_cycles_per_clock(2, 0);
        timer.write(0x28, 71, 0).unwrap();
        timer.write(0x2C, 999, 0).unwrap();
        timer.write(0x14, 1, 0).unwrap();
        timer.write(0x10, 0, 0).unwrap();
        timer.write(0x0C, UIF, 0).unwrap();
        timer.write(0x00, CEN, 0).unwrap();
        for n in 1..=3 {
            assert_eq!(timer.next_event(), Some(n * 144_000));
            timer.advance(n * 144_000);
            assert!(timer.irq());
            timer.write(0x10, 0, n * 144_000).unwrap();
        }
    }
}
