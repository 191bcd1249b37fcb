//! The board's USB port with a host at the other end of the cable: what the machine sees as one
//! peripheral.

use crate::Peripheral;
use crate::otg::Otg;
use crate::usb_host::{CdcDriver, HostDriver, Timing, UsbHost};

/// OTG_FS and the host that it is connected to.
#[derive(Debug)]
pub struct UsbPort<D = CdcDriver> {
    otg: Otg,
    host: UsbHost<D>,
}

impl UsbPort {
    /// A port whose cable is out. The emulator's own host is at the other end.
    pub fn new(timing: Timing) -> Self {
        Self::with_driver(timing, CdcDriver::new())
    }
}

impl<D: HostDriver> UsbPort<D> {
    /// The same, with another driver.
    pub fn with_driver(timing: Timing, driver: D) -> Self {
        Self { otg: Otg::new(), host: UsbHost::new(timing, driver) }
    }

    /// The host, advanced to `now`, and the controller, which some of its actions need.
    pub fn host(&mut self, now: u64) -> (&mut UsbHost<D>, &mut Otg) {
        self.host.advance(&mut self.otg, now);
        (&mut self.host, &mut self.otg)
    }

    /// The controller, to make it hostile or calm.
    pub fn otg_mut(&mut self) -> &mut Otg {
        &mut self.otg
    }

    /// The controller.
    pub fn otg(&self) -> &Otg {
        &self.otg
    }
}

impl<D: HostDriver> Peripheral for UsbPort<D> {
    fn read(&mut self, offset: u32, size: u8, now: u64) -> u32 {
        self.host.advance(&mut self.otg, now);
        self.otg.settle(now);
        let word = self.otg.read(offset & !3);
        if size == 4 { word } else { word >> (8 * (offset & 3)) & ((1 << (8 * size)) - 1) }
    }

    fn write(&mut self, offset: u32, _size: u8, value: u32, now: u64) {
        // The core's bus interface accepts only whole words (RM0090, "CSR memory map"), as drivers
        // know.
        self.host.advance(&mut self.otg, now);
        self.otg.settle(now);
        self.otg.write(offset & !3, value);
    }

    fn irq(&self) -> bool {
        self.otg.irq()
    }

    fn next_event(&self) -> Option<u64> {
        self.host.next_event(&self.otg)
    }

    fn advance(&mut self, now: u64) {
        self.host.advance(&mut self.otg, now);
    }

    fn take_trigger(&mut self) -> Option<u64> {
        self.host.take_sof()
    }

    fn reset(&mut self, now: u64) {
        // The reset of the registers removes the pull-up; the host notices at its next frame.
        self.host.advance(&mut self.otg, now);
        self.otg = self.otg.after_reset();
    }
}
