//! What the core's address space is made of: memories that answer at once, memories with wait states, and
//! windows to the bus.

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rsemu::core::error::BusError;
use rsemu::core::space::{AccessConstraints, MemAttrs, MemOps, MemResult, RamStore, Region};
use rsemu::core::value::Width;

use super::bus::Bus;
use super::memory::Memory;
use crate::memory_map as map;
use crate::timing::{Delays, Posted};

/// What the windows share with the core.
#[derive(Clone)]
pub(super) struct Shared {
    pub bus: Arc<dyn Bus>,
    /// When the step under way began.
    pub clock: Arc<AtomicU64>,
    /// Whether something beyond memory was reached.
    pub touched: Arc<AtomicBool>,
    /// What accesses wait for, if they do.
    pub delays: Option<Arc<Mutex<Delays>>>,
}

impl Shared {
    /// The delays, if there are any. There is only one thread, so the lock never blocks.
    pub fn delays(&self) -> Option<MutexGuard<'_, Delays>> {
        let delays = self.delays.as_ref()?;
        Some(delays.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Makes the write under way, if there is one.
    pub fn complete_write(&self) {
        let posted = self.delays().and_then(|mut delays| delays.take_posted());
        if let Some(Posted { at, address, size, value }) = posted {
            self.write(address, size, value, at);
        }
    }

    /// A bus fault would come long after the instruction; no model reports one.
    fn write(&self, address: u32, size: u8, value: u32, at: u64) -> Option<()> {
        self.touched.store(true, Ordering::Relaxed);
        let done = self.bus.write(address, size, value, at);
        if map::CLOCKS_AND_FLASH.contains(&address)
            && let Some(mut delays) = self.delays()
        {
            delays.set_speeds(self.bus.speeds());
        }
        done
    }
}

/// A window of the address space that goes to the [`Bus`].
pub(super) struct Window {
    pub base: u32,
    pub shared: Shared,
}

impl fmt::Debug for Window {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Window({:#010x})", self.base)
    }
}

impl Window {
    /// Whether this window leads to a part of flash, read through the D-bus.
    fn is_flash(&self) -> bool {
        self.base < map::SRAM.start
    }
}

impl MemOps for Window {
    fn read(&self, offset: u64, dst: &mut [u8], attrs: MemAttrs) -> MemResult {
        if attrs.debug {
            return Err(BusError::BadAccess);
        }
        let address = self.base + offset as u32;
        let shared = &self.shared;
        shared.complete_write();
        // After the access the interrupt lines must be checked.
        shared.touched.store(true, Ordering::Relaxed);
        let now = match shared.delays() {
            None => shared.clock.load(Ordering::Relaxed),
            Some(mut delays) if self.is_flash() => delays.read_system_memory(),
            Some(mut delays) => delays.read_bus(address),
        };
        let value = shared.bus.read(address, dst.len() as u8, now).ok_or(BusError::Unassigned)?;
        dst.copy_from_slice(&value.to_le_bytes()[..dst.len()]);
        Ok(())
    }

    fn write(&self, offset: u64, src: &[u8], attrs: MemAttrs) -> MemResult {
        if attrs.debug {
            return Err(BusError::BadAccess);
        }
        let mut bytes = [0; 4];
        bytes[..src.len()].copy_from_slice(src);
        let value = u32::from_le_bytes(bytes);
        let (address, size) = (self.base + offset as u32, src.len() as u8);
        let shared = &self.shared;
        shared.complete_write();
        if let Some(mut delays) = shared.delays()
            && !self.is_flash()
        {
            delays.write_peripheral(address, size, value);
            return Ok(());
        }
        let now = shared.clock.load(Ordering::Relaxed);
        shared.write(address, size, value, now).ok_or(BusError::Unassigned)
    }

    fn constraints(&self) -> AccessConstraints {
        AccessConstraints::IO.with_widths(Width::U8, Width::U32)
    }
}

/// Which memory it is, as far as timing is concerned.
#[derive(Clone, Copy, Debug)]
enum Behind {
    /// Instructions come through the I-bus, data through the D-bus.
    Flash,
    /// Both come through the system bus.
    Sram { base: u32 },
}

/// A memory whose accesses are reported to the delays.
struct Slow {
    behind: Behind,
    store: Arc<RamStore>,
    delays: Arc<Mutex<Delays>>,
}

impl fmt::Debug for Slow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Slow({:?})", self.behind)
    }
}

impl MemOps for Slow {
    fn read(&self, offset: u64, dst: &mut [u8], attrs: MemAttrs) -> MemResult {
        self.store.read_at(offset, dst)?;
        if attrs.debug {
            return Ok(());
        }
        let mut delays = self.delays.lock().unwrap_or_else(PoisonError::into_inner);
        match (self.behind, &*dst) {
            (Behind::Flash, [low, high]) if attrs.is_fetch() => {
                delays.fetch(offset as u32, u16::from_le_bytes([*low, *high]));
            }
            (Behind::Flash, _) => delays.read_flash(offset as u32),
            (Behind::Sram { base }, _) => {
                delays.read_bus(base + offset as u32);
            }
        }
        Ok(())
    }

    fn write(&self, offset: u64, src: &[u8], attrs: MemAttrs) -> MemResult {
        self.store.write_at(offset, src)?;
        if !attrs.debug
            && let Behind::Sram { base } = self.behind
        {
            let mut delays = self.delays.lock().unwrap_or_else(PoisonError::into_inner);
            delays.write_memory(base + offset as u32);
        }
        Ok(())
    }

    fn constraints(&self) -> AccessConstraints {
        AccessConstraints::ANY
    }
}

/// Flash or SRAM as a region of the address space.
pub(super) fn memory(name: &str, memory: &Memory, delays: Option<&Arc<Mutex<Delays>>>) -> Region {
    let store = Arc::clone(&memory.store);
    let Some(delays) = delays else { return Region::ram(name, store) };
    let behind =
        if memory.base == map::FLASH.start { Behind::Flash } else { Behind::Sram { base: memory.base } };
    let len = store.len();
    Region::io(name, len, Arc::new(Slow { behind, store, delays: Arc::clone(delays) }))
}
