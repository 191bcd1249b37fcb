//! The USB virtual COM port: OTG_FS, one CDC-ACM function, packets in and out.

use cantap_firmware::ports::{PACKET, Port};
use cantap_wire::{USB_PID, USB_VID};
use heapless::String;
use stm32f4xx_hal::otg_fs::{USB, UsbBus, UsbBusType};
use stm32f4xx_hal::pac::{OTG_FS_DEVICE, OTG_FS_GLOBAL};
use usb_device::bus::UsbBusAllocator;
use usb_device::device::{StringDescriptors, UsbDevice, UsbDeviceBuilder, UsbDeviceState, UsbVidPid};
use usbd_serial::{CdcAcmClass, USB_CLASS_CDC};

/// Words for received packets: 64 bytes each for endpoint 0 and the data endpoint.
const RECEIVE_WORDS: usize = 2 * PACKET / 4;
/// Current that is asked of the bus, in mA: chip, LEDs and two transceivers with room to spare, and half of what a
/// port gives.
const MAX_POWER_MA: usize = 250;
/// IN endpoints beside endpoint 0.
const IN_ENDPOINTS: core::ops::RangeInclusive<usize> = 1..=3;
/// An endpoint is disabled, or a FIFO flushed, in a few clocks; so many reads are more than that.
const MOST_READS: u32 = 1_000;

/// The port. [`Self::poll`] is the interrupt's.
pub struct UsbPort {
    device: UsbDevice<'static, UsbBusType>,
    class: CdcAcmClass<'static, UsbBusType>,
    /// The host was told to wait.
    held: bool,
}

/// What must live as long as the program.
pub struct Memory {
    words: [u32; RECEIVE_WORDS],
    bus: Option<UsbBusAllocator<UsbBusType>>,
    serial: String<24>,
}

impl Memory {
    /// Nothing yet.
    pub const fn new() -> Self {
        Self { words: [0; RECEIVE_WORDS], bus: None, serial: String::new() }
    }
}

impl UsbPort {
    /// Connects to the bus; a host enumerates the device from now on.
    pub fn new(usb: USB, serial: &String<24>, memory: &'static mut Memory) -> Self {
        memory.serial.clone_from(serial);
        let bus = memory.bus.insert(UsbBus::new(usb, &mut memory.words));
        let class = CdcAcmClass::new(bus, PACKET as u16);
        let strings = StringDescriptors::default()
            .manufacturer("cantap")
            .product("cantap CAN analyser")
            .serial_number(&memory.serial);
        let device = UsbDeviceBuilder::new(bus, UsbVidPid(USB_VID, USB_PID))
            .device_class(USB_CLASS_CDC)
            .composite_with_iads()
            .strings(&[strings])
            .and_then(|builder| builder.max_power(MAX_POWER_MA))
            // Cannot fail: one language, and less than the 500 mA that a device may ask for.
            .expect("the descriptors are within USB's limits")
            .build();
        Self { device, class, held: false }
    }

    /// Looks after the bus: resets, control requests, packets that have come or gone. Handles one of them at a time;
    /// the interrupt comes again while there are more.
    pub fn poll(&mut self) {
        let enumerated = global().gintsts().read().enumdne().bit();
        self.device.poll(&mut [&mut self.class]);
        if enumerated {
            release_in_endpoints();
        }
        if self.held {
            // The driver takes NAK back at the end of each packet.
            self.refuse_packets(true);
        }
    }
}

impl UsbPort {
    /// Answers what the host sends with NAK from here on, or no longer (RM0090, OTG_FS_DOEPCTLx, SNAK and CNAK).
    fn refuse_packets(&self, refuse: bool) {
        let endpoint = self.class.read_ep().address().index();
        device().doep(endpoint - 1).ctl().modify(|_, w| w.snak().bit(refuse).cnak().bit(!refuse));
    }

    /// Whether the data endpoint is in use.
    fn sends(&self) -> bool {
        let endpoint = self.class.write_ep().address().index();
        device().diep(endpoint - 1).ctl().read().usbaep().bit()
    }
}

impl Port for UsbPort {
    fn is_open(&self) -> bool {
        // A pulled cable shows as suspend, because nothing measures VBUS. A bus reset takes the endpoints out of use at
        // once; the device's state follows only when it is over, at least 10 ms later.
        self.device.state() == UsbDeviceState::Configured && self.class.dtr() && self.sends()
    }

    fn write(&mut self, packet: &[u8]) -> bool {
        // Between a bus reset and the end of the enumeration the driver has switched its endpoints off, but would take
        // a packet all the same, and the endpoint would be stuck with it (synopsys-usb-otg 0.4).
        self.sends()
            && self.device.state() == UsbDeviceState::Configured
            && self.class.write_packet(packet).is_ok()
    }

    fn read(&mut self, packet: &mut [u8; PACKET]) -> Option<usize> {
        self.class.read_packet(packet).ok()
    }

    fn hold(&mut self, hold: bool) {
        if hold != self.held {
            self.held = hold;
            self.refuse_packets(hold);
        }
    }
}

/// Takes back packets that were waiting when the bus was reset. The driver flushes their FIFO but leaves the endpoint
/// enabled, so that it would wait for ever for a packet to end that is not there (synopsys-usb-otg 0.4,
/// `EndpointIn::deconfigure`; RM0090, "IN endpoint disable").
fn release_in_endpoints() {
    for number in IN_ENDPOINTS {
        let endpoint = device().diep(number - 1);
        if !endpoint.ctl().read().epena().bit() {
            continue;
        }
        endpoint.ctl().modify(|_, w| w.snak().set_bit().epdis().set_bit());
        wait_while(|| endpoint.ctl().read().epena().bit());
        let reset = global().grstctl();
        // SAFETY: the field takes the number of any FIFO; endpoints have the FIFO of their own number.
        reset.modify(|_, w| unsafe { w.txfnum().bits(number as u8).txfflsh().set_bit() });
        wait_while(|| reset.read().txfflsh().bit());
    }
}

fn wait_while(busy: impl Fn() -> bool) {
    let mut reads = MOST_READS;
    while busy() && reads > 0 {
        reads -= 1;
    }
}

fn device() -> &'static stm32f4xx_hal::pac::otg_fs_device::RegisterBlock {
    // SAFETY: the driver that owns the peripheral runs only inside methods of the port, and so does this.
    unsafe { &*OTG_FS_DEVICE::ptr() }
}

fn global() -> &'static stm32f4xx_hal::pac::otg_fs_global::RegisterBlock {
    // SAFETY: as in `device`.
    unsafe { &*OTG_FS_GLOBAL::ptr() }
}
