//! What the device sends on its own: periodic frames and replies. Each ends with the object that requested
//! it.

use std::sync::{Arc, Mutex, Weak};

use cantap::periodic::{check_modifiers, period_ticks};
use cantap::wire::message::{
    Checksum, DEVICE_TAG, Filter, FrameKind, MAX_MODIFIERS, Modifier, Periodic, TRIGGER_TAG, Trigger,
};
use cantap::{Channel, Frame, Id};
use pyo3::prelude::*;

use super::lock::lock;
use super::session::{Session, SlotTable};
use super::transmissions::{NOBODY, SenderId};
use crate::error::Error;
use crate::frame::AnyFrame;
use crate::grammar::{Identifier, Seconds};
use crate::number::Whole;

/// A modifier as it comes from Python: its kind, the byte, and two numbers or a name.
pub type ModifierWords = (String, Whole<u8>, Whole<u8>, Whole<u8>, String);

/// What to reply to: identifier, mask, whether it has 29 bits.
pub type Match = (Identifier, Option<Identifier>, Option<bool>);

fn modifier((kind, byte, low_bit, bits, algorithm): &ModifierWords) -> Result<Modifier, Error> {
    let byte = byte.0;
    Ok(match kind.as_str() {
        "counter" => Modifier::Counter { byte, low_bit: low_bit.0, bits: bits.0 },
        "random" => Modifier::Random { byte },
        _ => {
            let algorithm = match algorithm.as_str() {
                "xor" => Checksum::Xor,
                "sum" => Checksum::Sum,
                "crc8-j1850" => Checksum::Crc8J1850,
                other => {
                    let words = format!("'{other}' is not a checksum; there are xor, sum and crc8-j1850");
                    return Err(Error::argument(words));
                }
            };
            Modifier::Checksum { byte, algorithm }
        }
    })
}

/// An entry in one of the device's tables.
struct Entry {
    /// Gone when the device is closed, and with it everything that it sends on its own.
    session: Weak<Session>,
    table: SlotTable,
    channel: Channel,
    slot: Mutex<Option<u8>>,
}

impl Entry {
    /// `sender`: who has its frames sent.
    fn take(
        session: &Arc<Session>,
        table: SlotTable,
        channel: Channel,
        sender: SenderId,
    ) -> Result<Self, Error> {
        let slot = session.take_slot(table, channel)?;
        let first = if table == SlotTable::Periodic { DEVICE_TAG } else { TRIGGER_TAG };
        session.transmissions.requested(channel, first + u32::from(slot), sender);
        Ok(Self { session: Arc::downgrade(session), table, channel, slot: Mutex::new(Some(slot)) })
    }

    /// Whether it is in the device's table.
    fn is_running(&self) -> bool {
        lock(&self.slot).is_some() && self.session.upgrade().is_some_and(|session| session.device().is_ok())
    }

    /// Ends it, unless it has already ended.
    fn clear(&self) -> Result<(), Error> {
        let Some(slot) = lock(&self.slot).take() else { return Ok(()) };
        let Some(session) = self.session.upgrade() else { return Ok(()) };
        let device = session.device()?;
        let cleared = match self.table {
            SlotTable::Periodic => device.set_periodic(self.channel, slot, None),
            SlotTable::Replies => device.set_trigger(self.channel, slot, None),
        };
        session.free_slot(self.table, self.channel, slot);
        Ok(cleared?)
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        // If the request fails, the device is gone, and with it the session.
        let _ = self.clear();
    }
}

/// A frame that the device sends repeatedly, by its own timer, until this is stopped or dropped.
#[pyclass(module = "cantap", frozen)]
pub struct PeriodicFrame {
    entry: Entry,
    set: Mutex<Periodic>,
}

impl PeriodicFrame {
    pub fn begin(
        session: Arc<Session>,
        channel: Channel,
        frame: Frame,
        period: Seconds,
        count: u32,
        modifiers: &[ModifierWords],
        sender: SenderId,
    ) -> Result<Self, Error> {
        let period = period.duration("period")?;
        let ticks = period_ticks(period, session.device()?.hello().tick_hz).map_err(Error::argument)?;
        let list = modifiers.iter().map(modifier).collect::<Result<Vec<_>, _>>()?;
        check_modifiers(&frame, &list).map_err(Error::argument)?;
        let modifiers = heapless::Vec::from_slice(&list).map_err(|_| {
            Error::argument(format!("a periodic frame has at most {MAX_MODIFIERS} modifiers"))
        })?;
        let set = Periodic { frame, period_ticks: ticks, count, modifiers };
        let entry = Entry::take(&session, SlotTable::Periodic, channel, sender)?;
        let task = Self { entry, set: Mutex::new(set) };
        task.apply()?;
        Ok(task)
    }

    fn apply(&self) -> Result<(), Error> {
        let slot = lock(&self.entry.slot);
        let (Some(slot), Some(session)) = (*slot, self.entry.session.upgrade()) else {
            return Err(Error::Address("this periodic frame was stopped; begin another one".to_owned()));
        };
        let set = lock(&self.set).clone();
        Ok(session.device()?.set_periodic(self.entry.channel, slot, Some(set))?)
    }
}

#[pymethods]
impl PeriodicFrame {
    /// Whether it is still active, apart from any limit to its count.
    #[getter]
    fn is_running(&self) -> bool {
        self.entry.is_running()
    }

    /// Sends another frame from now on; its period starts over.
    fn update(&self, py: Python<'_>, frame: AnyFrame) -> PyResult<()> {
        let frame = frame.classic("what a device repeats")?;
        let changed = {
            let set = lock(&self.set);
            check_modifiers(&frame, &set.modifiers).map_err(Error::argument)
        };
        changed?;
        lock(&self.set).frame = frame;
        Ok(py.detach(|| self.apply())?)
    }

    /// Stops it.
    fn stop(&self, py: Python<'_>) -> PyResult<()> {
        Ok(py.detach(|| self.entry.clear())?)
    }
}

/// A frame that the device sends whenever it receives a matching one, until this is stopped or dropped.
#[pyclass(module = "cantap", frozen)]
pub struct Reply {
    entry: Entry,
}

impl Reply {
    pub fn begin(
        session: Arc<Session>,
        channel: Channel,
        (id, mask, extended): Match,
        reply: Frame,
        count: u32,
    ) -> Result<Self, Error> {
        let id = id.checked(extended)?;
        let widest = if id.is_extended() { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
        let mask = mask.map_or(widest, |mask| mask.raw);
        if mask > widest {
            return Err(Error::argument(format!(
                "the mask {mask:#X} has more bits than the identifier, {widest:#X}"
            )));
        }
        let filter = Filter { extended: id.is_extended(), kind: FrameKind::Any, id: id.raw() & mask, mask };
        let entry = Entry::take(&session, SlotTable::Replies, channel, NOBODY)?;
        let slot = lock(&entry.slot).unwrap_or_default();
        session.device()?.set_trigger(channel, slot, Some(Trigger { filter, reply, count }))?;
        Ok(Self { entry })
    }
}

#[pymethods]
impl Reply {
    /// Whether it is still active, apart from any limit to its count.
    #[getter]
    fn is_running(&self) -> bool {
        self.entry.is_running()
    }

    /// Stops it.
    fn stop(&self, py: Python<'_>) -> PyResult<()> {
        Ok(py.detach(|| self.entry.clear())?)
    }
}
