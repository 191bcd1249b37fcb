//! The virtual COM port: usb-device and usbd-serial answer the host's control requests, data goes to the bus directly.

use cantap_firmware::oddities::UsbOddities;
use cantap_firmware::ports::{PACKET, Port, PortHistory};
use cantap_wire::{USB_PID, USB_VID};
use cortex_m::peripheral::NVIC;
use heapless::String;
use stm32f4xx_hal::pac::{Interrupt, OTG_FS_DEVICE, OTG_FS_GLOBAL, OTG_FS_PWRCLK};
use stm32f4xx_hal::rcc::{Enable, Rcc, Reset};
use usb_device::bus::UsbBusAllocator;
use usb_device::device::{StringDescriptors, UsbDevice, UsbDeviceBuilder, UsbDeviceState, UsbRev, UsbVidPid};
use usbd_serial::{CdcAcmClass, USB_CLASS_CDC};

use super::bus::{Bus, Core, Line, Shared};
use super::registers::Registers;
use super::requests::Requests;
use crate::hw::stamp::StampTimer;

/// Current requested from the bus, in mA: what a bus-powered hub has for a device (USB 2.0, 7.2.1: one unit load).
const MAX_POWER_MA: usize = 100;

/// Turns of usb-device in one poll: a request of endpoint 0 has three stages.
const TURNS_PER_POLL: usize = 16;

/// The peripheral.
type Peripheral = (OTG_FS_GLOBAL, OTG_FS_DEVICE, OTG_FS_PWRCLK);

/// The port. [`Self::poll`] is the interrupt's.
pub struct UsbPort {
    device: UsbDevice<'static, Bus>,
    class: CdcAcmClass<'static, Bus>,
    requests: Requests,
    core: &'static Shared,
}

/// What must live as long as the program.
pub struct Memory {
    core: Option<Shared>,
    bus: Option<UsbBusAllocator<Bus>>,
    serial: String<24>,
}

impl Memory {
    /// Empty memory, for [`UsbPort::new`].
    pub const fn new() -> Self {
        Self { core: None, bus: None, serial: String::new() }
    }
}

impl UsbPort {
    /// Connects to the bus; a host enumerates the device from now on.
    pub fn new(
        usb: Peripheral,
        timer: StampTimer,
        rcc: &mut Rcc,
        serial: &String<24>,
        memory: &'static mut Memory,
    ) -> Self {
        OTG_FS_GLOBAL::enable(rcc);
        OTG_FS_GLOBAL::reset(rcc);
        memory.serial.clone_from(serial);
        let core: &'static Shared = memory.core.insert(Shared::new(Core::new(Registers::new(usb, timer))));
        let bus: &'static _ = memory.bus.insert(UsbBusAllocator::new(Bus::new(core)));
        let class = CdcAcmClass::new(bus, PACKET as u16);
        let strings = StringDescriptors::default()
            .manufacturer("cantap")
            .product("cantap CAN analyser")
            .serial_number(&memory.serial);
        let device = UsbDeviceBuilder::new(bus, UsbVidPid(USB_VID, USB_PID))
            // USB 2.1 would promise link power management.
            .usb_rev(UsbRev::Usb200)
            .device_class(USB_CLASS_CDC)
            .composite_with_iads()
            .strings(&[strings])
            .and_then(|builder| builder.max_packet_size_0(PACKET as u8))
            .and_then(|builder| builder.max_power(MAX_POWER_MA))
            // Cannot fail: one language, packets of 64 bytes, and less than the 500 mA that a device may ask for.
            .expect("the descriptors are within USB's limits")
            .build();
        Self { device, class, requests: Requests::new(core), core }
    }

    /// Services the bus: resets, control requests, packets received and sent.
    pub fn poll(&mut self) {
        // Each turn handles something that is waiting.
        for _ in 0..TURNS_PER_POLL {
            if !self.device.poll(&mut [&mut self.requests, &mut self.class]) {
                return;
            }
        }
        // Something goes on reporting: the tick must have its turn.
        NVIC::pend(Interrupt::OTG_FS);
    }

    /// Once a millisecond: what the controller could not take before.
    pub fn tick(&mut self) {
        self.core.with(Core::tick);
    }

    /// What the controller did that it should not.
    pub fn oddities(&self) -> UsbOddities {
        self.core.with(|core| core.oddities())
    }
}

impl Port for UsbPort {
    fn is_open(&self) -> bool {
        self.device.state() == UsbDeviceState::Configured && self.core.with(|core| core.line()) != Line::Down
    }

    fn is_suspended(&self) -> bool {
        // A pulled cable looks like a suspend, too, because nothing measures VBUS.
        self.device.state() != UsbDeviceState::Configured && self.core.with(|core| core.line()) != Line::Down
    }

    fn history(&self) -> PortHistory {
        self.core.with(|core| core.history())
    }

    fn write(&mut self, bytes: &[u8]) -> Option<usize> {
        self.core.with(|core| core.write_bulk(bytes))
    }

    fn read(&mut self, packet: &mut [u8; PACKET]) -> Option<usize> {
        self.core.with(|core| core.read_bulk(packet))
    }

    fn hold(&mut self, hold: bool) {
        self.core.with(|core| core.hold_bulk(hold));
    }
}
