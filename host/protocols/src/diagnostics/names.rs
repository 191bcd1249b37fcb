//! Names for numbers: services, sub-functions, identifiers, reasons. The tables, with their sources, are in `data/diagnostics.csv`.

use crate::table::Table;

pub const FILE: &str = include_str!("../../data/diagnostics.csv");

static UDS_SERVICES: Table = Table::new(FILE, "uds_service");
static KWP_SERVICES: Table = Table::new(FILE, "kwp_service");
static KWP_NAMES: Table = Table::new(FILE, "kwp_name");
static OBD_SERVICES: Table = Table::new(FILE, "obd_service");
static REASONS: Table = Table::new(FILE, "reason");
static REASON_RANGES: Table = Table::new(FILE, "reason_range");
static DATA_IDENTIFIERS: Table = Table::new(FILE, "data_identifier");
static SUB_FUNCTIONS: Table = Table::new(FILE, "sub_function");
static STORED_EVENTS: Table = Table::new(FILE, "stored_event");

/// A service of UDS.
pub fn uds_service(sid: u8) -> Option<&'static str> {
    UDS_SERVICES.get(sid)
}

/// A service that only KWP2000 has.
pub fn kwp_only_service(sid: u8) -> Option<&'static str> {
    KWP_SERVICES.get(sid)
}

/// A service of KWP2000.
pub fn kwp_service(sid: u8) -> Option<&'static str> {
    kwp_only_service(sid).or_else(|| KWP_NAMES.get(sid)).or_else(|| uds_service(sid))
}

/// A service of OBD-II.
pub fn obd_service(sid: u8) -> Option<&'static str> {
    OBD_SERVICES.get(sid)
}

/// Whether a standard has this reason for a refusal.
pub fn is_reason(nrc: u8) -> bool {
    REASONS.get(nrc).is_some()
}

/// Why a request was refused.
pub fn reason(nrc: u8) -> &'static str {
    REASONS.get(nrc).or_else(|| REASON_RANGES.get(nrc)).unwrap_or("reserved")
}

/// A data identifier.
pub fn data_identifier(did: u16) -> Option<&'static str> {
    DATA_IDENTIFIERS.get(did)
}

/// A service's sub-function, without the bit that suppresses the response.
pub fn sub_function(sid: u8, sub: u8) -> Option<&'static str> {
    let named = SUB_FUNCTIONS.get(u16::from_be_bytes([sid, sub]));
    named.or_else(|| match (sid, sub) {
        // A bit says that the event outlasts a reset.
        (0x86, 0x40..=0x7F) => STORED_EVENTS.get(sub),
        (0x27, 1..=0x7E) if sub % 2 == 1 => Some("request seed"),
        (0x27, 1..=0x7E) => Some("send key"),
        _ => None,
    })
}

/// Whether the service's second byte is a sub-function whose highest bit suppresses the response.
pub const fn has_sub_function(sid: u8) -> bool {
    matches!(sid, 0x10 | 0x11 | 0x19 | 0x27 | 0x28 | 0x29 | 0x2C | 0x31 | 0x3E | 0x83 | 0x85 | 0x86 | 0x87)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::{dtc, meanings, monitors, obd, scaling};
    use crate::table::check;

    #[test]
    fn every_line_of_the_file_is_in_a_table() {
        let names = [
            &UDS_SERVICES,
            &KWP_SERVICES,
            &KWP_NAMES,
            &OBD_SERVICES,
            &REASONS,
            &REASON_RANGES,
            &DATA_IDENTIFIERS,
            &SUB_FUNCTIONS,
            &STORED_EVENTS,
            &dtc::STATUS,
        ];
        let others =
            meanings::TABLES.iter().chain(&obd::TABLES).chain(&monitors::TABLES).chain(&scaling::TABLES);
        check(FILE, &names.into_iter().chain(others.copied()).collect::<Vec<_>>());
    }
}
