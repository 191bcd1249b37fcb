//! The core's system bus: SRAM without wait states, the bridges to APB1 and APB2, the AHB peripherals, and the
//! write buffer.
//!
//! A bridge is synchronous (RM0090 Rev 21 §2.1.11), so an access waits for an edge of the slower clock; then every
//! transfer takes two of its cycles, set-up and access (AMBA APB). ARM's own bridge adds a cycle of the faster clock if
//! data is registered, which is the default; ST does not say, so that cycle is charged.

use super::speeds::Speeds;

/// What an access to AHB1's registers costs beyond the core's own two cycles has not been published.
const AHB1: u64 = 2;
/// Neither has it for the USB core's, whose FIFOs share a memory with the USB side.
const AHB2: u64 = 4;
/// A registered word in the bridge.
const REGISTERED: u64 = 1;

enum Slave {
    /// No wait states (RM0090 Rev 21 §2.3.1).
    Sram,
    /// This many cycles for each access.
    Ahb(u64),
    /// Behind a bridge, whose clock takes this many cycles.
    Apb(u64),
}

impl Slave {
    /// The slave that answers at an address (RM0090 Rev 21 Table 1).
    fn at(address: u32, speeds: &Speeds) -> Self {
        match address {
            0x4000_0000..0x4001_0000 => Self::Apb(speeds.apb1),
            0x4001_0000..0x4002_0000 => Self::Apb(speeds.apb2),
            0x4002_0000..0x5000_0000 => Self::Ahb(AHB1),
            0x5000_0000..0x6000_0000 => Self::Ahb(AHB2),
            _ => Self::Sram,
        }
    }
}

/// When the core is done with a write, and when the write is done.
pub struct Write {
    /// The core continues.
    pub accepted: u64,
    /// The slave has received it.
    pub done: u64,
}

/// The bus, and with it the core's write buffer, which has one place (DDI 0439D §3.5): the next access on this bus
/// waits until it is empty.
#[derive(Debug, Default)]
pub struct SystemBus {
    free_at: u64,
}

impl SystemBus {
    /// When everything under way is done.
    pub fn free_at(&self) -> u64 {
        self.free_at
    }

    /// A read that begins at `now`; returns when it is done.
    pub fn read(&mut self, address: u32, now: u64, speeds: &Speeds) -> u64 {
        let start = now.max(self.free_at);
        self.free_at = match Slave::at(address, speeds) {
            Slave::Sram => start,
            Slave::Ahb(cycles) => start + cycles,
            // The cycle in which the bridge passes on its register is the second of the core's own two.
            Slave::Apb(clock) => start.next_multiple_of(clock) + 2 * clock,
        };
        self.free_at
    }

    /// A write that begins at `now`.
    pub fn write(&mut self, address: u32, now: u64, speeds: &Speeds) -> Write {
        let accepted = now.max(self.free_at);
        self.free_at = match Slave::at(address, speeds) {
            Slave::Sram => accepted,
            Slave::Ahb(cycles) => accepted + cycles,
            Slave::Apb(clock) => accepted.next_multiple_of(clock) + 2 * clock + REGISTERED,
        };
        Write { accepted, done: self.free_at }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SRAM: u32 = 0x2000_0000;
    const TIM2: u32 = 0x4000_0000;
    const SYSCFG: u32 = 0x4001_3800;
    const GPIOA: u32 = 0x4002_0000;
    const OTG_FS: u32 = 0x5000_0000;

    fn speeds() -> Speeds {
        Speeds { apb1: 4, apb2: 2, ..Speeds::default() }
    }

    #[test]
    fn a_read_waits_for_the_clock_of_its_bus() {
        let wait = |address: u32, now: u64| SystemBus::default().read(address, now, &speeds()) - now;
        assert_eq!([100, 101, 102, 103].map(|now| wait(TIM2, now)), [8, 11, 10, 9]);
        assert_eq!([100, 101].map(|now| wait(SYSCFG, now)), [4, 5]);
        assert_eq!([SRAM, GPIOA, OTG_FS].map(|address| wait(address, 100)), [0, 2, 4]);
    }

    #[test]
    fn a_write_is_over_at_once_and_keeps_the_next_access_waiting() {
        let mut bus = SystemBus::default();
        let write = bus.write(TIM2, 101, &speeds());
        assert_eq!((write.accepted, write.done), (101, 104 + 8 + 1));
        assert_eq!(bus.read(SRAM, 103, &speeds()), 113, "SRAM is on the same bus");
        let write = bus.write(TIM2, 114, &speeds());
        assert_eq!(bus.write(TIM2, 116, &speeds()).accepted, write.done, "the buffer has one place");
    }
}
