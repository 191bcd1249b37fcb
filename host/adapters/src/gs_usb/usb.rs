//! The adapter on USB.

use std::time::Duration;

use nusb::transfer::{Buffer, Bulk, ControlIn, ControlOut, ControlType, In, Out, Recipient};
use nusb::{Endpoint, Interface, MaybeFuture};

use super::pipes::Usb;
use crate::driver::OpenError;
use crate::source::{Piece, Source};
use crate::usb_device::{Kind, reason};

/// Vendor and product of those that Linux's driver knows (`gs_usb_table` of `drivers/net/can/usb/gs_usb.c`).
const KNOWN: [(u16, u16); 6] = [
    // Geschwister Schneider and candleLight, CANable with that firmware.
    (0x1D50, 0x606F),
    (0x1209, 0x2323),
    // CES CANext FD.
    (0x1CD2, 0x606F),
    // ABE CAN debugger FD.
    (0x16D0, 0x10B8),
    // Xylanta SAINT3.
    (0x16D0, 0x0F30),
    CANNECTIVITY,
];
const CANNECTIVITY: (u16, u16) = (0x1209, 0xCA01);
const KIND: Kind = Kind {
    scheme: "gs_usb",
    what: "gs_usb adapter",
    is_one: |device| KNOWN.contains(&(device.vendor_id(), device.product_id())),
    kernel_driver: Some("gs_usb"),
};
const INTERFACE: u8 = 0;
/// Time limit for a request with data for the adapter.
const REQUEST_WITHIN: Duration = Duration::from_secs(1);
/// A read returns after this time.
const READ_TIMEOUT: Duration = Duration::from_millis(50);
/// Transfers that wait for the adapter's frames, as in Linux's driver, and those that wait to be sent.
const READS: usize = 30;
const WRITES: usize = 10;
/// Room for a CAN FD frame with a stamp, in packets of 64 bytes or one of 512.
const READ_BYTES: usize = 128;

/// An open adapter.
pub(super) struct UsbAdapter {
    interface: Interface,
    source: Source<Vec<u8>>,
    out: Endpoint<Bulk, Out>,
    confirms: bool,
}

impl UsbAdapter {
    /// Opens the adapter with a serial number, or the only one if that is empty. Returns the number.
    pub fn open(serial: &str, address: &str) -> Result<(Self, String), OpenError> {
        let (device, interface, number) = KIND.open(serial, address)?;
        let failed = |error| KIND.failed(&error, address);
        let bulk = |is_in: bool| {
            let endpoints = interface.descriptor().into_iter().flat_map(|setting| setting.endpoints());
            let mut addresses = endpoints
                .filter(|endpoint| endpoint.transfer_type() == nusb::descriptors::TransferType::Bulk)
                .map(|endpoint| endpoint.address());
            addresses.find(|address| (address & 0x80 != 0) == is_in)
        };
        let (Some(from), Some(to)) = (bulk(true), bulk(false)) else {
            return Err(OpenError::Foreign { address: address.to_owned(), expected: "a gs_usb adapter" });
        };
        let input = interface.endpoint::<Bulk, In>(from).map_err(failed)?;
        let out = interface.endpoint::<Bulk, Out>(to).map_err(failed)?;
        let source =
            reader(input).map_err(|source| OpenError::Unreachable { address: address.to_owned(), source })?;
        let confirms = (device.vendor_id(), device.product_id()) == CANNECTIVITY;
        Ok((Self { interface, source, out, confirms }, number))
    }
}

/// Keeps transfers waiting at the adapter, and notes when each was full.
fn reader(mut input: Endpoint<Bulk, In>) -> std::io::Result<Source<Vec<u8>>> {
    let len = READ_BYTES.next_multiple_of(input.max_packet_size().max(1));
    for _ in 0..READS {
        input.submit(Buffer::new(len));
    }
    Source::start(true, move || {
        let Some(completion) = input.wait_next_complete(READ_TIMEOUT) else { return Ok(None) };
        completion.status.map_err(reason)?;
        let bytes = completion.buffer[..completion.actual_len].to_vec();
        let mut buffer = completion.buffer;
        buffer.clear();
        input.submit(buffer);
        Ok((!bytes.is_empty()).then_some(bytes))
    })
}

impl Usb for UsbAdapter {
    fn confirms(&self) -> bool {
        self.confirms
    }

    fn control_out(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), String> {
        let (control_type, recipient, index) = (ControlType::Vendor, Recipient::Interface, INTERFACE.into());
        let request = ControlOut { control_type, recipient, request, value, index, data };
        self.interface.control_out(request, REQUEST_WITHIN).wait().map_err(reason)
    }

    fn control_in(
        &mut self,
        request: u8,
        value: u16,
        length: u16,
        within: Duration,
    ) -> Result<Vec<u8>, String> {
        let (control_type, recipient, index) = (ControlType::Vendor, Recipient::Interface, INTERFACE.into());
        let request = ControlIn { control_type, recipient, request, value, index, length };
        self.interface.control_in(request, within).wait().map_err(reason)
    }

    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        self.source.next(wait)
    }

    fn write(&mut self, bytes: Vec<u8>) -> Result<bool, String> {
        while self.out.pending() > 0
            && let Some(completion) = self.out.wait_next_complete(Duration::ZERO)
        {
            completion.status.map_err(reason)?;
        }
        if self.out.pending() >= WRITES {
            return Ok(false);
        }
        self.out.submit(bytes.into());
        Ok(true)
    }
}
