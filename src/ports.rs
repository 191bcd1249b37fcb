//! What the logic needs from hardware, as small traits: the board implements them with registers, tests
//! and the virtual device with fakes.
//!
//! A CAN controller has two sides. [`Traffic`] is touched only by the tasks of priority 4, [`Control`]
//! only by commands; the registers behind them are disjoint, so neither waits for the other.

use cantap_wire::message::{ChannelConfig, Failures, RegisterSet};
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{FdFrame, Frame};

use crate::bus::filters::Layout;

/// The free-running stamp timer at [`crate::TICK_HZ`], with one alarm.
pub trait Clock {
    /// The timer now; wraps at 32 bits.
    fn now(&self) -> u32;
    /// Calls the alarm interrupt at this time; at once if it has passed (by less than half the
    /// timer's range); never if `None`.
    fn set_alarm(&self, at: Option<u32>);
    /// How many ticks early the alarm is set, so that an interrupt under way has ended when the time comes;
    /// [`Self::wait_until`] waits for the rest. 0 where no interrupt is ever late.
    const ALARM_EARLY_TICKS: u32 = 0;
    /// Waits for a time that is at most one and a half times [`Self::ALARM_EARLY_TICKS`] ahead.
    fn wait_until(&self, _at: u32) {}
}

/// How a transmission ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// On the bus, acknowledged.
    Sent,
    /// Given up after losing arbitration (one-shot mode).
    ArbitrationLost,
    /// Given up after an error (one-shot mode).
    Error,
    /// Aborted on request.
    Aborted,
}

/// A controller's error status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ErrorStatus {
    /// The error since the last call, if there was one.
    pub kind: Option<BusErrorKind>,
    /// Fault confinement.
    pub state: ErrorState,
    /// Transmit error counter.
    pub tec: u8,
    /// Receive error counter.
    pub rec: u8,
}

/// A controller's traffic side. No method waits.
pub trait Traffic {
    /// Frames waiting in the receive FIFO: 0 to 3, without one that has been taken and is being released.
    fn pending(&self) -> u8;
    /// The oldest frame in the receive FIFO, which stays there; `None` as for [`Self::receive`].
    fn front(&self) -> Option<Frame>;
    /// Whether the controller has been asked to leave its bus. The interrupts of a board can come just before [`Control::stop`] or
    /// [`Control::halt`] has done so, and then it has not; where they cannot, it always has.
    fn is_leaving(&self) -> bool {
        true
    }
    /// Takes the oldest frame out of the receive FIFO; `None` if there is none, or if the last one taken has not been released yet.
    fn receive(&mut self) -> Option<Frame>;
    /// Whether the FIFO dropped frames since the last call. The FIFO is locked when full: it keeps the
    /// oldest and drops the newest.
    fn take_overrun(&mut self) -> bool;
    /// [`Self::pending`] and [`Self::take_overrun`] in one read. A frame being released may still count.
    fn look(&mut self) -> (u8, bool) {
        (self.pending(), self.take_overrun())
    }
    /// Writes a frame to a free mailbox, where it waits for [`Self::request`], or is overwritten by the next call.
    /// Returns the mailbox, a number below [`crate::bus::mailboxes::MAILBOXES`], or `None` if all are taken.
    fn prepare(&mut self, frame: &Frame) -> Option<u8>;
    /// The same for a CAN FD frame, which no controller of a board takes.
    fn prepare_fd(&mut self, _frame: &FdFrame) -> Option<u8> {
        None
    }
    /// Requests transmission of the frame that was last prepared, which is in this mailbox. Takes next to no time; frames
    /// leave in the order of these calls.
    fn request(&mut self, mailbox: u8);
    /// When the transmit interrupt stamped the first of the finished transmissions not yet taken; `None` if there are none, or where
    /// the interrupt passes on its stamp itself.
    fn stamped(&self) -> Option<u32> {
        None
    }
    /// All finished transmissions have been taken: the interrupt may stamp the next.
    fn await_finished(&mut self) {}
    /// Takes one finished transmission: its mailbox and how it ended.
    fn take_finished(&mut self) -> Option<(u8, Outcome)>;
    /// Requests the abort of every mailbox. Those that can still be aborted are reported as
    /// [`Outcome::Aborted`]; a frame already on the bus may end as sent.
    fn abort(&mut self);
    /// Reads and clears what the error interrupt reports.
    fn take_errors(&mut self) -> ErrorStatus;
    /// The controller's registers, for diagnosis.
    fn registers(&self) -> RegisterSet;
}

/// A controller's control side. No method waits.
pub trait Control {
    /// Asks the controller to leave the bus. It does so when the frame on the bus, if any, has ended.
    fn stop(&mut self);
    /// Makes it leave the bus at once, even in the middle of a frame: for a bus that is stuck. Call it repeatedly until
    /// [`Self::is_stopped`]. It is a reset, after which nothing is as it was written: the configuration, the filters of both
    /// controllers, and perhaps not even the mailboxes' abort.
    fn halt(&mut self);
    /// Whether it has left the bus.
    fn is_stopped(&self) -> bool;
    /// Applies a configuration that is valid, and joins the bus after 11 recessive bits. Only when
    /// stopped.
    fn start(&mut self, config: &ChannelConfig);
    /// Joins the bus again as configured before. Only when stopped.
    fn resume(&mut self);
}

/// The timer that drives a TX pin dominant for a while, once, in place of its controller.
#[cfg(any(feature = "disturb", not(target_os = "none")))]
pub trait PulseTimer {
    /// Whether a channel's TX pin has such a timer.
    fn reaches(&self, channel: cantap_wire::Channel) -> bool;
    /// Sets the timer up, for a level of this many ticks that begins when the stamp timer is at `at`, less than half its range ahead. The pin
    /// stays its controller's.
    fn prepare(&mut self, channel: cantap_wire::Channel, at: u32, ticks: u16);
    /// Connects the timer, which was prepared, to the pin: recessive until the level begins, and after it.
    fn connect(&mut self, channel: cantap_wire::Channel);
    /// Gives the pin back to its controller, and stops the timer. Returns whether the level had begun since [`Self::prepare`].
    fn disconnect(&mut self) -> bool;
    /// As [`Clock::set_alarm`], an alarm of its own.
    fn set_alarm(&mut self, at: Option<u32>);
}

/// The acceptance filters of all controllers.
pub trait FilterBanks {
    /// Compares the banks as they are now with the layout, and writes those that differ. Reception is interrupted, so no channel may
    /// be open unless the layout's shape (split, modes, scales) is unchanged and only closed channels' banks differ. Returns whether
    /// anything differed.
    fn write(&mut self, layout: &Layout) -> bool;
}

/// A change of a receive pin's level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PinEdge {
    /// The stamp timer at the edge.
    pub at: u32,
    /// Whether the level after it is dominant (or else recessive).
    pub dominant: bool,
    /// The meter was blind for a moment just before: edges may be missing, and this one may have been earlier.
    pub unsure: bool,
}

/// Measures when a channel's receive pin changes, whatever the bit rate. It only listens, and never at the cost of capture: what it misses
/// is marked.
pub trait EdgeMeter {
    /// Discards what was measured, and watches this channel's pin from now on; `None` stops watching.
    fn watch(&mut self, channel: Option<cantap_wire::Channel>);
    /// Takes the oldest edge. A meter keeps [`EDGES_KEPT`]; when they are full, it is blind until all of them are taken.
    fn next(&mut self) -> Option<PinEdge>;
    /// Whether the watched pin is dominant; false if no pin is watched.
    fn is_dominant(&self) -> bool;
}

/// Edges that a meter keeps: those of two of the longest frames.
pub const EDGES_KEPT: usize = 256;

/// The chip itself.
pub trait Chip {
    /// Temperature in 0.1 °C, if it can be measured.
    fn temperature_decicelsius(&mut self) -> Option<i16>;
    /// Supply voltage in mV, if it can be measured.
    fn supply_millivolts(&mut self) -> Option<u16>;
    /// How often the firmware has failed since power-on, and why it last did.
    fn failures(&mut self) -> Failures;
    /// Shows a pattern on the LEDs for this long.
    fn identify(&mut self, seconds: u8);
    /// Restarts the firmware; on the board it does not return.
    fn reset(&mut self);
    /// Enters the ROM bootloader; on the board it does not return. Returns whether there is one.
    fn bootloader(&mut self) -> bool;
    /// Stores bytes (at most [`crate::port::command::MAX_SAVED`]) over a power cycle; empty erases. Returns whether it worked.
    fn save(&mut self, bytes: &[u8]) -> bool;
    /// Reads what was stored into `out`, as far as it fits, and returns the length read.
    fn load(&mut self, out: &mut [u8]) -> usize;
}

/// What a host has done with a port, as counters that wrap: only changes matter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PortHistory {
    /// How often it was opened. Opening it after the device was reconfigured counts as opening it again.
    pub opened: u8,
    /// How often, with the port open, the device was reconfigured or its configuration was removed.
    pub configured: u8,
}

/// The USB port's data pipes.
pub trait Port {
    /// Whether a host has the port open.
    fn is_open(&self) -> bool;
    /// Whether, with the port open, the host has suspended the bus or removed the device's configuration. The port does not
    /// count as open meanwhile, and does again afterwards.
    fn is_suspended(&self) -> bool {
        false
    }
    /// What the host has done with the port so far.
    fn history(&self) -> PortHistory {
        PortHistory::default()
    }
    /// Hands over as many of these bytes as fit into one transfer and returns how many: all of them, or whole packets of
    /// [`PACKET`]. `None` if the last transfer is still under way. Without bytes it sends an empty packet.
    fn write(&mut self, bytes: &[u8]) -> Option<usize>;
    /// Takes one packet and returns its length.
    fn read(&mut self, packet: &mut [u8; PACKET]) -> Option<usize>;
    /// Makes the host wait before it sends more, or lets it continue. What is already on its way still arrives: at most [`ON_ITS_WAY`]
    /// packets.
    fn hold(&mut self, hold: bool);
}

/// Packets that may still arrive after the host is made to wait: those already let in.
pub const ON_ITS_WAY: usize = 4;
/// Largest packet of a full-speed bulk endpoint, in bytes (USB 2.0, 5.8.3).
pub const PACKET: usize = 64;
