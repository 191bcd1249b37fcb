//! The adapter on USB.

use std::time::Duration;

use nusb::transfer::{Buffer, Bulk, In, Out};
use nusb::{Endpoint, Interface};

use super::wire::PACKET;
use crate::driver::OpenError;
use crate::usb_device::{Kind, reason};

/// Microchip's vendor number and the number of many products with its chips: these say CAN in their name.
const KIND: Kind = Kind {
    scheme: "canalyst-ii",
    what: "CANalyst-II",
    is_one: |device| {
        let name = device.product_string().unwrap_or_default().to_ascii_uppercase();
        (device.vendor_id(), device.product_id()) == (0x04D8, 0x0053) && name.contains("CAN")
    },
    kernel_driver: None,
};
/// Endpoints for commands and for messages, of each channel.
const COMMANDS: [u8; 2] = [2, 4];
const MESSAGES: [u8; 2] = [1, 3];
const IN: u8 = 0x80;
/// Time limit for a transfer.
const WITHIN: Duration = Duration::from_secs(1);

/// What the driver needs of USB: another one in tests.
pub(super) trait Usb: Send {
    /// A command to a channel.
    fn command(&mut self, channel: usize, packet: [u8; PACKET]) -> Result<(), String>;
    /// The answer to a command.
    fn answer(&mut self, channel: usize) -> Result<Vec<u8>, String>;
    /// Messages of a channel, up to so many bytes.
    fn read(&mut self, channel: usize, len: usize) -> Result<Vec<u8>, String>;
    /// Messages for a channel.
    fn write(&mut self, channel: usize, packet: [u8; PACKET]) -> Result<(), String>;
}

/// An open adapter.
pub(super) struct UsbAdapter {
    commands: [Pair; 2],
    messages: [Pair; 2],
}

impl UsbAdapter {
    /// Opens the adapter with a serial number, or the only one if that is empty. Returns the number.
    pub fn open(serial: &str, address: &str) -> Result<(Self, String), OpenError> {
        let (_, interface, number) = KIND.open(serial, address)?;
        let [first, second] = [0, 1].map(|channel| -> Result<_, OpenError> {
            Ok((pair(&interface, COMMANDS[channel], address)?, pair(&interface, MESSAGES[channel], address)?))
        });
        let ((first_commands, first_messages), (second_commands, second_messages)) = (first?, second?);
        let (commands, messages) = ([first_commands, second_commands], [first_messages, second_messages]);
        Ok((Self { commands, messages }, number))
    }
}

/// To a channel, and from it.
type Pair = (Endpoint<Bulk, Out>, Endpoint<Bulk, In>);

fn pair(interface: &Interface, number: u8, address: &str) -> Result<Pair, OpenError> {
    let failed = |error| KIND.failed(&error, address);
    let out = interface.endpoint::<Bulk, Out>(number).map_err(failed)?;
    let input = interface.endpoint::<Bulk, In>(number | IN).map_err(failed)?;
    Ok((out, input))
}

fn write(out: &mut Endpoint<Bulk, Out>, packet: [u8; PACKET]) -> Result<(), String> {
    out.transfer_blocking(packet.to_vec().into(), WITHIN).status.map_err(reason)
}

fn read(input: &mut Endpoint<Bulk, In>, len: usize) -> Result<Vec<u8>, String> {
    let len = len.next_multiple_of(input.max_packet_size().max(1));
    let completion = input.transfer_blocking(Buffer::new(len), WITHIN);
    completion.status.map_err(reason)?;
    Ok(completion.buffer[..completion.actual_len].to_vec())
}

impl Usb for UsbAdapter {
    fn command(&mut self, channel: usize, packet: [u8; PACKET]) -> Result<(), String> {
        write(&mut self.commands[channel].0, packet)
    }

    fn answer(&mut self, channel: usize) -> Result<Vec<u8>, String> {
        read(&mut self.commands[channel].1, PACKET)
    }

    fn read(&mut self, channel: usize, len: usize) -> Result<Vec<u8>, String> {
        read(&mut self.messages[channel].1, len)
    }

    fn write(&mut self, channel: usize, packet: [u8; PACKET]) -> Result<(), String> {
        write(&mut self.messages[channel].0, packet)
    }
}
