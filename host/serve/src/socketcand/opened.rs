//! A bus that a client has open: what it sends there once, and what the board sends for it repeatedly.

use std::collections::HashMap;

use cantap_trace::counted;
use cantap_wire::message::Periodic;
use cantap_wire::{Frame, Id};

use super::connection::Connection;
use crate::News;
use crate::lock::lock;
use crate::open_bus::OpenBus;

/// An open bus.
pub struct Opened {
    pub bus: OpenBus,
    /// Frames sent repeatedly: the board's entry and the period in microseconds.
    pub periodic: HashMap<Id, (u8, u64)>,
}

impl Opened {
    pub fn new(bus: OpenBus) -> Self {
        Self { bus, periodic: HashMap::new() }
    }
}

impl Connection {
    /// Only listens again, if nothing is sent any more.
    pub fn listen_again(&self, opened: &mut Opened) -> Result<(), String> {
        if !opened.periodic.is_empty() {
            return Ok(());
        }
        if let Some(after) = opened.bus.listen_again(|| self.missed())? {
            let (client, channel) = (self.name.clone(), opened.bus.channel);
            self.buses[0].board.tell(News::Idle { client, channel, after });
        }
        Ok(())
    }

    pub fn send(&self, bus: &mut OpenBus, frame: Frame) -> Result<(), String> {
        bus.may_send(|| self.missed())?;
        let tag = bus.next_tag();
        lock(&self.hearing).own.sends(tag, frame);
        bus.send(tag, frame).inspect_err(|_| lock(&self.hearing).own.failed(tag))
    }

    /// Has the board send a frame repeatedly; one with the same identifier is replaced.
    pub fn add(&self, opened: &mut Opened, us: u64, frame: Frame) -> Result<(), String> {
        let Opened { bus, periodic } = opened;
        bus.may_send(|| self.missed())?;
        let hello = bus.device.hello();
        let ticks = u128::from(us) * u128::from(hello.tick_hz) / 1_000_000;
        let period_ticks = u32::try_from(ticks).map_err(|_| {
            format!(
                "the board's longest period is {} s",
                u64::from(u32::MAX) / u64::from(hello.tick_hz.max(1))
            )
        })?;
        let slot = match periodic.get(&frame.id()) {
            Some((slot, _)) => *slot,
            None => (0..hello.periodic_slots)
                .find(|slot| periodic.values().all(|(taken, _)| taken != slot))
                .ok_or_else(|| {
                    format!("the board sends at most {} periodically", counted(hello.periodic_slots, "frame"))
                })?,
        };
        let entry = Periodic { frame, period_ticks, count: 0, modifiers: heapless::Vec::new() };
        let before = lock(&self.hearing).own.repeats(frame.id(), Some(frame));
        if let Err(error) = bus.device.set_periodic(bus.channel, slot, Some(entry)) {
            lock(&self.hearing).own.repeats(frame.id(), before);
            return Err(error.to_string());
        }
        periodic.insert(frame.id(), (slot, us));
        Ok(())
    }
}
