//! Silicon that answers late, wrongly or never, from a seed.
//!
//! Everything else here is prompt and true. A chip need not be: its manual promises little about when a flag follows its cause, and other
//! people's drivers know of more. What is here is such behaviour, each with who saw it or what leaves it open; [`Hostile::default`] is
//! the prompt and true chip. A plan is what can happen, and a [`Dice`] decides each time whether it does, so the same plan gives the
//! same run.

use fastrand::Rng;

use crate::Clock;

/// How late something may come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tardy {
    /// Of a hundred times, how often it is late.
    pub percent: u8,
    /// The longest delay, in µs.
    pub longest_us: u32,
    /// Of a hundred late ones, how many never come: only a reset of the peripheral or [`Dice::calm`] ends the wait.
    pub never_percent: u8,
}

impl Tardy {
    /// Never late.
    pub const PROMPT: Self = Self { percent: 0, longest_us: 0, never_percent: 0 };
    /// Never comes at all.
    pub const NEVER: Self = Self { percent: 100, longest_us: 0, never_percent: 100 };

    /// Late every time, by up to this many µs.
    pub const fn always(longest_us: u32) -> Self {
        Self { percent: 100, longest_us, never_percent: 0 }
    }
}

/// What a release of the receive FIFO (RFOM) does in initialisation mode. No manual promises anything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ReleaseInInit {
    /// It works as elsewhere.
    #[default]
    Works,
    /// RFOM stays set, and the frame in place, until the controller leaves the mode.
    Waits,
    /// Nothing happens.
    Ignored,
}

/// What the CAN controllers and their pins may do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CanFaults {
    /// The end of a release of the receive FIFO: RFOM stays set, and the frame in place (RM0090 Rev 21 §32.9.2 gives no time).
    pub release: Tardy,
    /// What a release does in initialisation mode.
    pub release_in_init: ReleaseInInit,
    /// INAK after INRQ. Until then the controller receives.
    pub initialisation: Tardy,
    /// SLAK after a master reset, beyond the time that this always takes (Linux polls for it every 10 ms).
    pub master_reset: Tardy,
    /// Of a hundred resets by the clock controller while TX is connected to its pin, how many leave it dominant (an F107 in silent
    /// mode: about ten, libcyphal PR 69). It stays until the pin is disconnected.
    pub reset_sticks_percent: u8,
    /// A TX pin that is connected to a controller without a clock is dominant. The manual does not say what it is.
    pub unclocked_is_dominant: bool,
}

/// What OTG_FS may do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UsbFaults {
    /// The end of a core soft reset, and AHBIDL after it.
    pub core_reset: Tardy,
    /// The end of a flush (TXFFLSH): "the application must write this bit only after checking that the core is neither writing to
    /// nor reading from the Tx FIFO" (RM0090, GRSTCTL). What is written meanwhile is flushed, too.
    pub flush: Tardy,
    /// An IN endpoint's NAK (NAKSTS and INEPNE) after SNAK.
    pub nak: Tardy,
    /// No INEPNE if the endpoint answers NAK already (Zephyr #73142).
    pub silent_nak: bool,
    /// EPDISD after EPDIS.
    pub disable: Tardy,
    /// EPDIS does nothing on an OUT endpoint without global OUT NAK (RM0090, "Disabling an OUT endpoint"), and GONAKEFF comes only when its
    /// pattern is taken from the receive FIFO ("Setting the global OUT NAK").
    pub out_needs_global_nak: bool,
    /// Of a hundred packets, before how many an impossible status stands in the receive FIFO (libopencm3 #672, Klipper).
    pub bogus_status_percent: u8,
    /// The end of the setup stage enters the receive FIFO only when the next token arrives (TinyUSB, Klipper), which is answered
    /// with NAK.
    pub late_setup_complete: bool,
    /// It clears endpoint 0's EPENA only when it is taken from the receive FIFO: what was armed before is lost.
    pub setup_complete_disarms: bool,
    /// It does not come while DOEPINT0.STUP is set (an F722: libopencm3 #1262).
    pub stup_blocks: bool,
    /// DAINT shows endpoints with any flag, masked or not (TXFE is set out of reset).
    pub daint_shows_all: bool,
    /// Device mode after FDMOD: until then CMOD says host, and the device registers cannot be written (RM0090, GUSBCFG: 25 ms).
    pub device_mode: Tardy,
}

/// What a seed makes of the chip.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Hostile {
    /// Decides each time whether something happens.
    pub seed: u64,
    /// CAN controllers.
    pub can: CanFaults,
    /// USB.
    pub usb: UsbFaults,
    /// The flash interface is busy beyond the operation's time.
    pub flash_busy: Tardy,
}

impl Hostile {
    /// What `seed` makes of the chip: some of the faults, each seldom or often. What no driver can live with for ever (a flag that never
    /// comes) is seldom.
    pub fn seeded(seed: u64) -> Self {
        let mut random = Rng::with_seed(seed ^ 0x5EED_C41F);
        let mut tardy = |longest_us: u32| {
            if random.bool() {
                return Tardy::PROMPT;
            }
            Tardy {
                percent: [1, 5, 20, 100][random.usize(..4)],
                longest_us: random.u32(1..=longest_us),
                never_percent: [0, 0, 2, 20][random.usize(..4)],
            }
        };
        let (release, initialisation, master_reset) = (tardy(50), tardy(20_000), tardy(20_000));
        let (core_reset, flush, nak, disable) = (tardy(200), tardy(200), tardy(500), tardy(500));
        let flash_busy = tardy(5_000);
        let mut often = |percents: &[u8]| percents[random.usize(..percents.len())];
        let (reset_sticks_percent, bogus_status_percent) = (often(&[0, 10, 100]), often(&[0, 0, 1, 10]));
        Self {
            seed,
            can: CanFaults {
                release,
                release_in_init: [ReleaseInInit::Works, ReleaseInInit::Waits, ReleaseInInit::Ignored]
                    [random.usize(..3)],
                initialisation,
                master_reset,
                reset_sticks_percent,
                unclocked_is_dominant: random.bool(),
            },
            usb: UsbFaults {
                core_reset,
                flush,
                nak,
                silent_nak: random.bool(),
                disable,
                out_needs_global_nak: random.bool(),
                bogus_status_percent,
                late_setup_complete: random.bool(),
                setup_complete_disarms: random.bool(),
                stup_blocks: random.bool(),
                daint_shows_all: random.bool(),
                device_mode: if random.bool() { Tardy::PROMPT } else { Tardy::always(25_000) },
            },
            flash_busy,
        }
    }
}

/// Decides, each time, whether something happens.
#[derive(Clone, Debug)]
pub struct Dice {
    random: Rng,
    clock: Clock,
    /// Nothing is late any more.
    calm: bool,
}

impl Dice {
    /// Those of one peripheral, which `salt` tells from the others.
    pub fn new(seed: u64, salt: u64, clock: Clock) -> Self {
        Self { random: Rng::with_seed(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ salt), clock, calm: false }
    }

    /// From now on the chip is prompt and true, and what was never to come comes.
    pub fn calm(&mut self) {
        self.calm = true;
    }

    /// Whether [`Self::calm`] was called.
    pub fn is_calm(&self) -> bool {
        self.calm
    }

    /// The cycle at which something comes whose cause is now: 0 if at once, [`u64::MAX`] if never.
    pub fn due(&mut self, tardy: Tardy, now: u64) -> u64 {
        if !self.hits(tardy.percent) {
            return 0;
        }
        if self.hits(tardy.never_percent) {
            return u64::MAX;
        }
        now + self.random.u64(1..=self.clock.us(tardy.longest_us.into()).max(1))
    }

    /// Whether it happens this time.
    pub fn hits(&mut self, percent: u8) -> bool {
        percent > 0 && !self.calm && self.random.u8(..100) < percent
    }

    /// Whether something that was due at `at` has come by now.
    pub fn has_come(&self, at: u64, now: u64) -> bool {
        at <= now || self.calm && at == u64::MAX
    }

    /// Any word.
    pub fn word(&mut self) -> u32 {
        self.random.u32(..)
    }
}

impl Default for Dice {
    /// Those of a prompt and true chip.
    fn default() -> Self {
        Self::new(0, 0, Clock::new(12_000_000))
    }
}
