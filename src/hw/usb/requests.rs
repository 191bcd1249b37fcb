//! Host requests that usb-device does not pass on: setting a configuration or an interface. An observer in the list of classes
//! sees each request before it is carried out.

use usb_device::UsbDirection;
use usb_device::class::{ControlOut, UsbClass};
use usb_device::control::{Recipient, Request, RequestType};
use usb_device::endpoint::EndpointAddress;

use super::bus::{Bus, Shared};
use super::{BULK_IN, BULK_OUT, NOTIFY_IN};

/// PSTN 1.2, 6.3.12: bit 0 of the value is DTR.
const SET_CONTROL_LINE_STATE: u8 = 0x22;
/// usbd-serial's interfaces: the first for control, the second for data.
const CONTROL_INTERFACE: u16 = 0;
const DATA_INTERFACE: u16 = 1;

/// The observer.
pub struct Requests(&'static Shared);

impl Requests {
    pub const fn new(core: &'static Shared) -> Self {
        Self(core)
    }

    fn restart(&self, index: usize, direction: UsbDirection) {
        self.0.with(|core| core.restart(EndpointAddress::from_parts(index, direction)));
    }
}

impl UsbClass<Bus> for Requests {
    fn control_out(&mut self, transfer: ControlOut<Bus>) {
        let request = *transfer.request();
        match (request.request_type, request.recipient, request.request) {
            // usb-device accepts only these two values.
            (RequestType::Standard, Recipient::Device, Request::SET_CONFIGURATION) if request.value <= 1 => {
                self.0.with(|core| core.configure(request.value == 1));
            }
            (RequestType::Standard, Recipient::Interface, Request::SET_INTERFACE) if request.value == 0 => {
                match request.index {
                    CONTROL_INTERFACE => self.restart(NOTIFY_IN, UsbDirection::In),
                    DATA_INTERFACE => {
                        self.restart(BULK_IN, UsbDirection::In);
                        self.restart(BULK_OUT, UsbDirection::Out);
                    }
                    _ => {
                        // Fails only if nobody waits for an answer.
                        let _ = transfer.reject();
                    }
                }
            }
            // bmAttributes does not offer remote wakeup (USB 2.0, 9.4.9: a request error).
            (RequestType::Standard, Recipient::Device, Request::SET_FEATURE | Request::CLEAR_FEATURE)
                if request.value == Request::FEATURE_DEVICE_REMOTE_WAKEUP =>
            {
                let _ = transfer.reject();
            }
            (RequestType::Class, Recipient::Interface, SET_CONTROL_LINE_STATE)
                if request.index == CONTROL_INTERFACE =>
            {
                self.0.with(|core| core.set_dtr(request.value & 1 != 0));
            }
            _ => {}
        }
    }
}
