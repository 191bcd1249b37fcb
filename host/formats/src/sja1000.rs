//! The error code capture register of Philips' SJA1000 controller (product specification of 2000-01-04, section 6.4.9 with
//! table 21): in this form, Vector's and PEAK's files give the kind of a bus error.

use cantap_can::BusErrorKind;

/// The two upper bits: kind. Bit 5 is set while receiving. The lower five: the segment of the frame.
const KIND_SHIFT: u32 = 6;
const BIT: u8 = 0;
const FORM: u8 = 1;
const STUFF: u8 = 2;
const OTHER: u8 = 3;
const RECEIVING: u8 = 1 << 5;
const SEGMENT: u8 = 0x1F;
const CRC_SEQUENCE: u8 = 0x08;
const CRC_DELIMITER: u8 = 0x18;
const ACKNOWLEDGE_SLOT: u8 = 0x19;
const DATA_FIELD: u8 = 0x0A;

/// The register for a kind of error. It cannot tell the two bit errors apart.
pub(crate) fn code(kind: BusErrorKind) -> u8 {
    let (kind, direction, segment) = match kind {
        BusErrorKind::Stuff => (STUFF, RECEIVING, DATA_FIELD),
        BusErrorKind::Form => (FORM, RECEIVING, CRC_DELIMITER),
        BusErrorKind::Acknowledgment => (OTHER, 0, ACKNOWLEDGE_SLOT),
        BusErrorKind::BitRecessive | BusErrorKind::BitDominant => (BIT, 0, DATA_FIELD),
        BusErrorKind::Crc => (OTHER, RECEIVING, CRC_SEQUENCE),
    };
    kind << KIND_SHIFT | direction | segment
}

/// The kind of error in the register, as far as it can be expressed.
pub(crate) fn kind(code: u8) -> Option<BusErrorKind> {
    match (code >> KIND_SHIFT, code & SEGMENT) {
        (STUFF, _) => Some(BusErrorKind::Stuff),
        (FORM, _) => Some(BusErrorKind::Form),
        (OTHER, ACKNOWLEDGE_SLOT) => Some(BusErrorKind::Acknowledgment),
        (OTHER, CRC_SEQUENCE | CRC_DELIMITER) => Some(BusErrorKind::Crc),
        _ => None,
    }
}
