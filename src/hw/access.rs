//! Joins the session, at priority 2, to what the tasks of priority 4 own: [`Board`] for the real
//! board.

use cantap_firmware::QUEUE_BYTES;
use cantap_firmware::bus::capture::Capture;
use cantap_firmware::bus::sof::SofReading;
use cantap_firmware::port::board::Board;
use cantap_wire::{CHANNELS, Channel};
use rtic::Mutex;

use super::can::{CanControl, CanFilters, CanTraffic};
use super::chip::BoardChip;
use super::crc::CrcUnit;
use super::edges::PinMeter;
use super::sof::SofLatch;
use super::stamp::{StampAlarm, StampTimer};

/// What the tasks of priority 4 own.
pub struct Tap {
    /// The logic.
    pub capture: Capture<'static>,
    /// The controllers' traffic halves.
    pub traffic: [CanTraffic; CHANNELS],
    /// The stamp timer with its alarm.
    pub alarm: StampAlarm,
    /// What disturbs a bus.
    #[cfg(feature = "disturb")]
    pub disturber: cantap_firmware::bus::disturb::Disturber,
    /// Its timer.
    #[cfg(feature = "disturb")]
    pub pulse: super::disturb::BusPulse,
}

#[cfg(feature = "disturb")]
impl Tap {
    /// The stamp timer's interrupt: it may be the alarm of a disturbance.
    pub fn on_pulse_alarm(&mut self) {
        let Self { capture, alarm, disturber, pulse, .. } = self;
        pulse.acknowledge();
        disturber.on_alarm(pulse, capture, alarm);
    }
}

/// What commands own.
pub struct Controls {
    /// The controllers' control halves.
    pub can: [CanControl; CHANNELS],
    /// The acceptance filters.
    pub filters: CanFilters,
    /// The chip.
    pub chip: BoardChip,
    /// The stamp timer, for reading.
    pub stamp: StampTimer,
    /// Its latch of USB's start of frame.
    pub sof: SofLatch,
    /// The CRC unit.
    pub crc: CrcUnit,
    /// The meter for the receive pins.
    pub meter: PinMeter,
}

/// What commands own, and access to the rest.
pub struct Access<'a, T> {
    /// The resource to lock: holding it raises the priority to the capture's.
    pub tap: T,
    /// What needs no lock.
    pub controls: &'a mut Controls,
}

impl<T: Mutex<T = Tap>> Board<'static, QUEUE_BYTES> for Access<'_, T> {
    type Traffic = CanTraffic;
    type Control = CanControl;
    type Clock = StampAlarm;
    type Filters = CanFilters;
    type Chip = BoardChip;
    type Meter = PinMeter;

    fn with_capture<R>(
        &mut self,
        act: impl FnOnce(&mut Capture<'static>, &mut [CanTraffic; CHANNELS], &StampAlarm) -> R,
    ) -> R {
        self.tap.lock(|tap| act(&mut tap.capture, &mut tap.traffic, &tap.alarm))
    }

    #[cfg(feature = "disturb")]
    fn with_disturber<R>(
        &mut self,
        act: impl FnOnce(
            &mut cantap_firmware::bus::disturb::Disturber,
            &mut dyn cantap_firmware::ports::PulseTimer,
            &mut Capture<'static>,
            &StampAlarm,
        ) -> R,
    ) -> Option<R> {
        self.tap.lock(|tap| Some(act(&mut tap.disturber, &mut tap.pulse, &mut tap.capture, &tap.alarm)))
    }

    #[cfg(feature = "disturb")]
    fn describe(&self, hello: &mut cantap_wire::Hello) {
        if crate::board::PULSE_PINS.iter().any(Option::is_some) {
            hello.capabilities |= cantap_wire::message::capability::DISTURB;
        }
    }

    fn now(&self) -> u32 {
        self.controls.stamp.now()
    }

    fn take_sof(&mut self) -> Option<SofReading> {
        self.controls.sof.take()
    }

    fn crc32(&mut self, message: &[u8]) -> u32 {
        self.controls.crc.crc32(message)
    }

    fn control(&mut self, channel: Channel) -> &mut CanControl {
        &mut self.controls.can[channel.index()]
    }

    fn filters(&mut self) -> &mut CanFilters {
        &mut self.controls.filters
    }

    fn chip(&mut self) -> &mut BoardChip {
        &mut self.controls.chip
    }

    fn meter(&mut self) -> &mut PinMeter {
        &mut self.controls.meter
    }
}
