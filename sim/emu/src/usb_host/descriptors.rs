//! Reads a device's descriptors and checks them as the CDC-ACM drivers of real hosts do (USB 2.0, section 9.6; CDC
//! 1.2, section 5.2; PSTN 1.2, section 5.3). Anything that a driver would stumble over is an error here, not a
//! warning.

use super::enumeration_error::EnumerationError;

const DEVICE: u8 = 1;
const CONFIGURATION: u8 = 2;
const STRING: u8 = 3;
const INTERFACE: u8 = 4;
const ENDPOINT: u8 = 5;
const INTERFACE_ASSOCIATION: u8 = 11;
const CS_INTERFACE: u8 = 0x24;

const CLASS_PER_INTERFACE: (u8, u8, u8) = (0, 0, 0);
const CLASS_ASSOCIATION: (u8, u8, u8) = (0xEF, 2, 1);
const CLASS_COMMUNICATIONS: u8 = 2;
const SUBCLASS_ACM: u8 = 2;
const CLASS_DATA: u8 = 10;

const BULK: u8 = 2;
const INTERRUPT: u8 = 3;

/// Full-speed bulk and control packet sizes (USB 2.0, 5.5.3 and 5.8.3).
const PACKET_SIZES: [u8; 4] = [8, 16, 32, 64];

/// What the device descriptor says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Device {
    /// Vendor ID.
    pub vendor: u16,
    /// Product ID.
    pub product: u16,
    /// Release, binary-coded decimal.
    pub release: u16,
    /// Bytes of the largest packet of endpoint 0.
    pub ep0_packet: u8,
    /// String indices of manufacturer, product and serial number.
    pub strings: [u8; 3],
}

/// A CDC-ACM function, as its configuration describes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CdcAcm {
    /// bConfigurationValue.
    pub configuration: u8,
    /// The communication interface, to which class requests go.
    pub control_interface: u8,
    /// The data interface.
    pub data_interface: u8,
    /// Interrupt IN: number, largest packet, interval in frames.
    pub notification: Pipe,
    /// Bulk IN.
    pub input: Pipe,
    /// Bulk OUT.
    pub output: Pipe,
}

/// An endpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pipe {
    /// Its number, without the direction.
    pub number: u8,
    /// Bytes of its largest packet.
    pub packet: u16,
    /// bInterval.
    pub interval: u8,
}

/// An error about descriptors that are not good enough.
fn bad(what: impl Into<String>) -> EnumerationError {
    EnumerationError::Descriptor(what.into())
}

/// Fails with `what` unless `holds`.
fn check(holds: bool, what: &str) -> Result<(), EnumerationError> {
    if holds { Ok(()) } else { Err(bad(what)) }
}

/// Reads the device descriptor.
pub fn device(bytes: &[u8]) -> Result<Device, EnumerationError> {
    check(bytes.len() == 18 && bytes[0] == 18, "the device descriptor is not 18 bytes long")?;
    check(bytes[1] == DEVICE, "the device descriptor has another type")?;
    let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
    check((0x0110..=0x0210).contains(&word(2)), "bcdUSB is not between 1.1 and 2.1")?;
    let class = (bytes[4], bytes[5], bytes[6]);
    let class_known =
        class == CLASS_PER_INTERFACE || class == CLASS_ASSOCIATION || class.0 == CLASS_COMMUNICATIONS;
    check(class_known, "the device class is neither per interface, association nor communications")?;
    check(PACKET_SIZES.contains(&bytes[7]), "bMaxPacketSize0 is not 8, 16, 32 or 64")?;
    check(bytes[17] >= 1, "there is no configuration")?;
    Ok(Device {
        vendor: word(8),
        product: word(10),
        release: word(12),
        ep0_packet: bytes[7],
        strings: [bytes[14], bytes[15], bytes[16]],
    })
}

/// The total length given in a configuration descriptor's first nine bytes.
pub fn configuration_length(bytes: &[u8]) -> Result<u16, EnumerationError> {
    check(bytes.len() == 9 && bytes[0] == 9, "the configuration descriptor is not 9 bytes long")?;
    check(bytes[1] == CONFIGURATION, "the configuration descriptor has another type")?;
    let total = u16::from_le_bytes([bytes[2], bytes[3]]);
    check(total >= 9, "wTotalLength is shorter than the configuration descriptor")?;
    Ok(total)
}

/// One interface while it is being read.
#[derive(Default)]
struct Interface {
    number: u8,
    class: (u8, u8),
    endpoints_told: u8,
    endpoints: Vec<(u8, u8, Pipe)>,
    functional: Vec<Vec<u8>>,
}

/// Reads a whole configuration and finds the CDC-ACM function in it.
pub fn cdc_acm(bytes: &[u8]) -> Result<CdcAcm, EnumerationError> {
    let header = bytes.get(..9).ok_or_else(|| bad("the configuration is shorter than 9 bytes"))?;
    check(usize::from(configuration_length(header)?) == bytes.len(), "wTotalLength is not the length sent")?;
    check(header[7] & 0x80 != 0, "bit 7 of bmAttributes is reserved and must be set")?;
    check(header[8] <= 250, "bMaxPower asks for more than 500 mA")?;
    let (interfaces, association) = interfaces(&bytes[9..])?;
    check(usize::from(header[4]) == interfaces.len(), "bNumInterfaces is not the number of interfaces")?;
    check(header[5] != 0, "bConfigurationValue is zero, which means not configured")?;

    let control = interfaces
        .iter()
        .find(|interface| interface.class == (CLASS_COMMUNICATIONS, SUBCLASS_ACM))
        .ok_or_else(|| bad("there is no interface of class CDC-ACM"))?;
    let functional = |subtype: u8| {
        control.functional.iter().find(|descriptor| descriptor[2] == subtype).map(Vec::as_slice)
    };
    let length = |descriptor: Option<&[u8]>, least: usize, what: &str| match descriptor {
        Some(descriptor) if descriptor.len() >= least => Ok(descriptor.to_vec()),
        _ => Err(bad(format!("the {what} functional descriptor is missing or short"))),
    };
    check(
        control.functional.first().is_some_and(|descriptor| descriptor[2] == 0 && descriptor.len() == 5),
        "the functional descriptors do not begin with a header",
    )?;
    length(functional(2), 4, "abstract control management")?;
    let union = length(functional(6), 5, "union")?;
    let call = length(functional(1), 5, "call management")?;
    check(union[3] == control.number, "the union's controlling interface is not this one")?;
    let data = interfaces
        .iter()
        .find(|interface| interface.number == union[4])
        .ok_or_else(|| bad("the union names a data interface that is not there"))?;
    check(data.class.0 == CLASS_DATA, "the union's subordinate interface is not of class CDC data")?;
    check(call[4] == data.number, "call management names another data interface than the union")?;
    if let Some((first, count)) = association {
        let covered = |number: u8| (first..first.saturating_add(count)).contains(&number);
        check(
            covered(control.number) && covered(data.number) && count == 2,
            "the interface association does not cover the two interfaces",
        )?;
    }
    let pipe = |interface: &Interface, input: bool, kind: u8, what: &str| {
        let mut found = interface
            .endpoints
            .iter()
            .filter(|endpoint| (endpoint.0 & 0x80 != 0, endpoint.1) == (input, kind));
        match (found.next(), found.next()) {
            (Some(endpoint), None) => Ok(endpoint.2),
            _ => Err(bad(format!("there is not exactly one {what} endpoint"))),
        }
    };
    let acm = CdcAcm {
        configuration: header[5],
        control_interface: control.number,
        data_interface: data.number,
        notification: pipe(control, true, INTERRUPT, "notification (interrupt IN)")?,
        input: pipe(data, true, BULK, "bulk IN")?,
        output: pipe(data, false, BULK, "bulk OUT")?,
    };
    check(acm.notification.interval >= 1, "the notification endpoint's interval is zero")?;
    for pipe in [acm.input, acm.output] {
        let allowed = PACKET_SIZES.iter().any(|size| u16::from(*size) == pipe.packet);
        check(allowed, "a bulk endpoint's packet size is not 8, 16, 32 or 64")?;
    }
    check(acm.notification.packet <= 64, "the notification endpoint's packet is over 64 bytes")?;
    Ok(acm)
}

/// Walks the descriptors after the configuration header.
#[allow(clippy::type_complexity, reason = "the pair is taken apart at its one caller")]
fn interfaces(mut bytes: &[u8]) -> Result<(Vec<Interface>, Option<(u8, u8)>), EnumerationError> {
    let mut interfaces: Vec<Interface> = Vec::new();
    let mut association = None;
    let mut addresses = Vec::new();
    while let [length, kind, ..] = *bytes {
        check(length >= 2 && usize::from(length) <= bytes.len(), "a descriptor runs past the end")?;
        let (descriptor, rest) = bytes.split_at(usize::from(length));
        bytes = rest;
        match (kind, interfaces.last_mut()) {
            (INTERFACE_ASSOCIATION, _) => {
                check(length == 8, "the interface association is not 8 bytes long")?;
                association = Some((descriptor[2], descriptor[3]));
            }
            (INTERFACE, _) => {
                check(length == 9, "an interface descriptor is not 9 bytes long")?;
                check(descriptor[3] == 0, "an alternate setting, which no CDC-ACM driver selects")?;
                let number = descriptor[2];
                check(usize::from(number) == interfaces.len(), "interfaces are not numbered in order")?;
                interfaces.push(Interface {
                    number,
                    class: (descriptor[5], descriptor[6]),
                    endpoints_told: descriptor[4],
                    ..Interface::default()
                });
            }
            (CS_INTERFACE, Some(interface)) => {
                check(length >= 3, "a functional descriptor is too short")?;
                interface.functional.push(descriptor.to_vec());
            }
            (ENDPOINT, Some(interface)) => {
                check(length == 7, "an endpoint descriptor is not 7 bytes long")?;
                let address = descriptor[2];
                check(address & 0x70 == 0 && address & 0xF != 0, "an endpoint address is out of range")?;
                check(!addresses.contains(&address), "two endpoints have one address")?;
                addresses.push(address);
                let pipe = Pipe {
                    number: address & 0xF,
                    packet: u16::from_le_bytes([descriptor[4], descriptor[5]]),
                    interval: descriptor[6],
                };
                interface.endpoints.push((address, descriptor[3] & 3, pipe));
            }
            (_, _) => return Err(bad(format!("a descriptor of type {kind:#04x} is out of place"))),
        }
    }
    check(bytes.is_empty(), "a single byte is left after the last descriptor")?;
    for interface in &interfaces {
        check(
            usize::from(interface.endpoints_told) == interface.endpoints.len(),
            "bNumEndpoints is not the number of endpoints",
        )?;
    }
    Ok((interfaces, association))
}

/// The first language of string descriptor 0.
pub fn language(bytes: &[u8]) -> Result<u16, EnumerationError> {
    let whole = bytes.len() >= 4 && usize::from(bytes[0]) == bytes.len() && bytes[1] == STRING;
    check(whole, "string descriptor 0 lists no language")?;
    Ok(u16::from_le_bytes([bytes[2], bytes[3]]))
}

/// A string descriptor's text.
pub fn string(bytes: &[u8]) -> Result<String, EnumerationError> {
    let whole = bytes.len() >= 2 && usize::from(bytes[0]) == bytes.len() && bytes.len().is_multiple_of(2);
    check(whole && bytes[1] == STRING, "a string descriptor is not whole")?;
    let units: Vec<u16> = bytes[2..].chunks(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
    String::from_utf16(&units).map_err(|_| bad("a string descriptor is not UTF-16"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What usbd-serial sends for one function: association, communication interface with header,
    /// ACM, union and call management, data interface.
    fn good() -> Vec<u8> {
        let body: &[u8] = &[
            8, 11, 0, 2, 2, 2, 0, 0, //
            9, 4, 0, 0, 1, 2, 2, 0, 0, //
            5, 0x24, 0, 0x10, 0x01, //
            4, 0x24, 2, 0, //
            5, 0x24, 6, 0, 1, //
            5, 0x24, 1, 0, 1, //
            7, 5, 0x81, 3, 8, 0, 255, //
            9, 4, 1, 0, 2, 10, 0, 0, 0, //
            7, 5, 0x82, 2, 64, 0, 0, //
            7, 5, 0x01, 2, 64, 0, 0, //
        ];
        let mut bytes = vec![9, 2, 0, 0, 2, 1, 0, 0x80, 50];
        bytes.extend_from_slice(body);
        bytes[2] = bytes.len() as u8;
        bytes
    }

    #[test]
    fn a_good_configuration_names_its_pipes() {
        let acm = cdc_acm(&good()).unwrap();
        assert_eq!((acm.configuration, acm.control_interface, acm.data_interface), (1, 0, 1));
        assert_eq!((acm.input.number, acm.output.number, acm.notification.number), (2, 1, 1));
        assert_eq!((acm.input.packet, acm.notification.interval), (64, 255));
    }

    #[test]
    fn what_a_driver_stumbles_over_is_refused() {
        // Offset into the configuration, the byte put there, and the expected message.
        for (at, byte, what) in [
            (2, 66, "wTotalLength"),
            (4, 1, "bNumInterfaces"),
            (5, 0, "bConfigurationValue"),
            (7, 0, "bmAttributes"),
            (8, 251, "bMaxPower"),
            (12, 1, "association"),
            (23, 0xFF, "no interface of class CDC-ACM"),
            (28, 9, "functional descriptors"),
            (33, 9, "abstract control"),
            (37, 9, "union"),
            (38, 1, "controlling interface"),
            (39, 2, "not there"),
            (44, 0, "call management"),
            (47, 0x80, "endpoint address"),
            (48, 2, "notification"),
            (51, 0, "interval"),
            (57, 8, "class CDC data"),
            (63, 0x81, "one address"),
            (65, 63, "packet size"),
            (73, 9, "past the end"),
        ] {
            let mut bytes = good();
            let index = if at == 73 { bytes.len() - 7 } else { at };
            bytes[index] = byte;
            let error = cdc_acm(&bytes).unwrap_err().to_string();
            assert!(error.contains(what), "byte {at} = {byte}: {error}");
        }
    }

    #[test]
    fn no_cut_configuration_is_accepted() {
        let whole = good();
        for length in 0..whole.len() {
            let mut cut = whole[..length].to_vec();
            assert!(cdc_acm(&cut).is_err());
            if length > 3 {
                // A length that agrees with the cut does not save it.
                cut[2] = length as u8;
                assert!(cdc_acm(&cut).is_err(), "cut to {length}");
            }
        }
    }

    #[test]
    fn strings_are_utf16() {
        assert_eq!(string(&[8, 3, b'a', 0, 0xE4, 0, b'z', 0]).unwrap(), "aäz");
        assert!(string(&[7, 3, b'a', 0, 0xE4, 0, b'z']).is_err());
        assert!(string(&[4, 3, 0x00, 0xD8]).is_err());
        assert_eq!(language(&[4, 3, 9, 4]).unwrap(), 0x0409);
        assert!(language(&[2, 3]).is_err());
    }
}
