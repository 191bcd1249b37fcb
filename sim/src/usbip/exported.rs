//! What the server says about its device before a kernel has seen it: a record made from the device's own
//! descriptors.

use super::error::Error;

/// The bus ID that a kernel asks for.
pub const BUS_ID: &str = "1-1";
/// Bytes of the record (usbip_protocol.rst, OP_REP_IMPORT from "path" on).
const RECORD_BYTES: usize = 312;
const BUS_ID_AT: usize = 256;
const NUMBERS_AT: usize = 288;
const IDS_AT: usize = 300;
const CLASS_AT: usize = 306;
const COUNTS_AT: usize = 309;
/// A full-speed device, in the kernel's `enum usb_device_speed`.
const FULL_SPEED: u8 = 2;

const INTERFACE: u8 = 4;
const ENDPOINT: u8 = 5;

/// An endpoint of the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Endpoint {
    /// bEndpointAddress.
    pub address: u8,
    /// wMaxPacketSize.
    pub packet: usize,
    /// Its interface's number.
    pub interface: u8,
    /// bmAttributes' transfer type.
    pub kind: u8,
    /// bInterval.
    pub interval: u8,
}

/// The device, as its descriptors describe it.
#[derive(Clone, Debug)]
pub struct Exported {
    device: Vec<u8>,
    record: Vec<u8>,
    interfaces: Vec<u8>,
    endpoints: Vec<Endpoint>,
}

impl Exported {
    /// From the device descriptor and the whole configuration.
    pub fn new(device: &[u8], configuration: &[u8]) -> Result<Self, Error> {
        if device.len() != 18 || configuration.len() < 9 {
            return Err(Error::Descriptors { device: device.len(), configuration: configuration.len() });
        }
        let (mut interfaces, mut endpoints, mut interface) = (Vec::new(), Vec::new(), 0);
        let mut rest = configuration;
        while let [length, kind, ..] = *rest {
            let Some((one, more)) = rest.split_at_checked(length.max(2).into()) else { break };
            match (kind, one.len()) {
                (INTERFACE, 9..) => {
                    interface = one[2];
                    interfaces.extend([one[5], one[6], one[7], 0]);
                }
                (ENDPOINT, 7..) => {
                    let packet = u16::from_le_bytes([one[4], one[5]]).into();
                    let (kind, interval) = (one[3] & 3, one[6]);
                    endpoints.push(Endpoint { address: one[2], packet, interface, kind, interval });
                }
                _ => {}
            }
            rest = more;
        }
        let mut record = vec![0; RECORD_BYTES];
        let mut put = |at: usize, bytes: &[u8]| record[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, b"/sys/devices/emulated");
        put(BUS_ID_AT, BUS_ID.as_bytes());
        put(NUMBERS_AT, &[0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, FULL_SPEED]);
        // idVendor, idProduct and bcdDevice, little-endian in the descriptor.
        put(IDS_AT, &[device[9], device[8], device[11], device[10], device[13], device[12]]);
        put(CLASS_AT, &device[4..7]);
        // Not configured; bNumConfigurations, bNumInterfaces.
        put(COUNTS_AT, &[0, device[17], configuration[4]]);
        Ok(Self { device: device.to_vec(), record, interfaces, endpoints })
    }

    /// The device descriptor.
    pub fn device(&self) -> &[u8] {
        &self.device
    }

    /// The record for an import.
    pub fn record(&self) -> Vec<u8> {
        self.record.clone()
    }

    /// Class, subclass, protocol and a zero of each interface.
    pub fn interfaces(&self) -> &[u8] {
        &self.interfaces
    }

    /// Every endpoint except 0.
    pub fn endpoints(&self) -> &[Endpoint] {
        &self.endpoints
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DEVICE: [u8; 18] = [18, 1, 0, 2, 0xEF, 2, 1, 64, 9, 0x12, 1, 0, 3, 4, 1, 2, 3, 1];

    #[test]
    fn the_record_is_made_of_the_descriptors() {
        let mut configuration = vec![9, 2, 34, 0, 2, 1, 0, 0x80, 50];
        configuration.extend([9, 4, 0, 0, 1, 2, 2, 1, 0, 7, 5, 0x81, 3, 8, 0, 16]);
        configuration.extend([9, 4, 1, 0, 2, 10, 0, 0, 0, 7, 5, 0x82, 2, 64, 0, 0]);
        let exported = Exported::new(&DEVICE, &configuration).unwrap();
        assert_eq!(exported.record()[256..259], *b"1-1");
        let tail = [0, 0, 0, 2, 0x12, 9, 0, 1, 4, 3, 0xEF, 2, 1, 0, 1, 2];
        assert_eq!(exported.record()[296..], tail);
        assert_eq!(exported.interfaces(), [2, 2, 1, 0, 10, 0, 0, 0]);
        let endpoints = [
            Endpoint { address: 0x81, packet: 8, interface: 0, kind: 3, interval: 16 },
            Endpoint { address: 0x82, packet: 64, interface: 1, kind: 2, interval: 0 },
        ];
        assert_eq!(exported.endpoints(), endpoints);
    }

    /// Wherever a configuration is cut off, everything before the cut is read.
    #[test]
    fn broken_configurations_end_where_they_break() {
        for end in [0, 1, 9, 200] {
            let configuration = [vec![9, 2, 34, 0, 2, 1, 0, 0x80, 50], vec![9, end]].concat();
            assert!(Exported::new(&DEVICE, &configuration).unwrap().endpoints().is_empty());
        }
        assert!(Exported::new(&DEVICE[..8], &[0; 9]).is_err());
    }
}
