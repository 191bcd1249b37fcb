//! Protocols and their names.

use std::fmt;
use std::str::FromStr;

/// The protocol of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Protocol {
    /// Transfers of ISO 15765-2 whose content is not a known service.
    IsoTp,
    /// Diagnostic services of ISO 14229.
    Uds,
    /// Diagnostic services of ISO 14230-3 on CAN.
    Kwp2000,
    /// Services 01 to 0A of SAE J1979.
    Obd,
    /// SAE J1939.
    J1939,
    /// NMEA 2000.
    Nmea2000,
    /// CANopen: CiA 301 and 305.
    CanOpen,
    /// DeviceNet.
    DeviceNet,
    /// XCP on CAN.
    Xcp,
    /// CCP 2.1.
    Ccp,
    /// DroneCAN, which was UAVCAN v0.
    DroneCan,
    /// Cyphal on CAN, which was UAVCAN v1.
    Cyphal,
}

impl Protocol {
    /// All of them.
    pub const ALL: [Self; 12] = [
        Self::IsoTp,
        Self::Uds,
        Self::Kwp2000,
        Self::Obd,
        Self::J1939,
        Self::Nmea2000,
        Self::CanOpen,
        Self::DeviceNet,
        Self::Xcp,
        Self::Ccp,
        Self::DroneCan,
        Self::Cyphal,
    ];

    /// Its name in text, JSON and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::IsoTp => "isotp",
            Self::Uds => "uds",
            Self::Kwp2000 => "kwp2000",
            Self::Obd => "obd",
            Self::J1939 => "j1939",
            Self::Nmea2000 => "nmea2000",
            Self::CanOpen => "canopen",
            Self::DeviceNet => "devicenet",
            Self::Xcp => "xcp",
            Self::Ccp => "ccp",
            Self::DroneCan => "dronecan",
            Self::Cyphal => "cyphal",
        }
    }

    /// Whether it is ISO 15765-2 or on top of it: a tester's, which may come at any time.
    pub const fn is_diagnostics(self) -> bool {
        self.bit() & Self::DIAGNOSTICS != 0
    }

    /// The set of those.
    pub(crate) const DIAGNOSTICS: u16 =
        Self::IsoTp.bit() | Self::Uds.bit() | Self::Kwp2000.bit() | Self::Obd.bit();

    /// XCP and CCP.
    pub(crate) const CALIBRATION: u16 = Self::Xcp.bit() | Self::Ccp.bit();

    /// Its bit in a set.
    pub(crate) const fn bit(self) -> u16 {
        1 << self as u16
    }
}

impl fmt::Display for Protocol {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// No protocol has this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no protocol '{name}'; there are {}", Protocol::ALL.map(Protocol::name).join(", "))]
pub struct UnknownProtocol {
    /// The given name.
    pub name: String,
}

impl FromStr for Protocol {
    type Err = UnknownProtocol;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let name = text.to_ascii_lowercase();
        let found = Self::ALL.into_iter().find(|protocol| protocol.name() == name);
        found.ok_or_else(|| UnknownProtocol { name: text.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A protocol that is missing from the list could not be selected by name. The last one's number must match the list's
    /// length.
    #[test]
    fn every_protocol_can_be_named() {
        assert_eq!(Protocol::ALL.len(), Protocol::Cyphal as usize + 1);
        for (number, protocol) in Protocol::ALL.into_iter().enumerate() {
            assert_eq!(protocol as usize, number);
            assert_eq!(protocol.name().parse(), Ok(protocol));
        }
        assert!("odb".parse::<Protocol>().is_err());
    }
}
