//! Parameter groups and failure modes by name.

/// Names of groups that are likely to be on a bus, by the acronyms of SAE J1939-71 and the numbers of SAE J1939-73.
///
/// Witnesses: canmatrix' j1939.dbc (acronyms) and can-j1939 (DM numbers), both by a test
/// (`protocols_agree_with_peers.rs`); the list of groups in isoxml-js (`src/PGNs.ts`), which has the name of each in
/// words; Wireshark's isobus dissector for those of ISO 11783. The number of DM9 is the one between DM8 and DM10.
const GROUPS: [(u32, &str); 123] = [
    (0x0000, "TSC1 torque/speed control"),
    (0x0100, "TC1 transmission control"),
    (0x9E00, "DM29 number of trouble codes"),
    (0x9F00, "DM35 immediate fault status"),
    (0xA000, "DM34 not-to-exceed status"),
    (0xA100, "DM33 emission increasing device active time"),
    (0xA200, "DM32 regulated exhaust emission level exceedance"),
    (0xA300, "DM31 trouble code to lamp association"),
    (0xA400, "DM30 scaled test results"),
    (0xC100, "DM21 diagnostic readiness 2"),
    (0xC200, "DM20 monitor performance ratio"),
    (0xC300, "DM22 clear or reset one trouble code"),
    (0xC700, "ETP.DT"),
    (0xC800, "ETP.CM"),
    (0xC900, "request 2"),
    (0xCA00, "transfer"),
    (0xD300, "DM19 calibration information"),
    (0xD400, "DM18 data security"),
    (0xD600, "DM17 boot load data"),
    (0xD700, "DM16 binary data transfer"),
    (0xD800, "DM15 memory access response"),
    (0xD900, "DM14 memory access request"),
    (0xDA00, "diagnostics by ISO 15765"),
    (0xDB00, "diagnostics by ISO 15765, to all"),
    (0xDF00, "DM13 stop start broadcast"),
    (0xE300, "DM7 command of a non-continuously monitored test"),
    (0xE800, "acknowledgement"),
    (0xEA00, "request"),
    (0xEB00, "TP.DT"),
    (0xEC00, "TP.CM"),
    (0xEE00, "address claimed"),
    (0xEF00, "proprietary A"),
    (0x1_EF00, "proprietary A2"),
    (0xF000, "ERC1 retarder"),
    (0xF001, "EBC1 brakes"),
    (0xF002, "ETC1 transmission"),
    (0xF003, "EEC2 engine"),
    (0xF004, "EEC1 engine"),
    (0xF005, "ETC2 transmission"),
    (0xF006, "EAC1 axle"),
    (0xF009, "VDC2 vehicle dynamics"),
    (0xF00A, "EGF1 engine gas flow rate"),
    (0xFCC6, "DM57 OBD information"),
    (0xFCC7, "DM56 model year and certification engine family"),
    (0xFCD1, "DM53 active service only trouble codes"),
    (0xFCD2, "DM54 previously active service only trouble codes"),
    (0xFCD3, "DM55 clear service only trouble codes"),
    (0xFD54, "DM52 class C trouble codes, previously active"),
    (0xFD55, "DM51 class C trouble codes, confirmed and active"),
    (0xFD56, "DM50 class C trouble codes, pending"),
    (0xFD57, "DM49 class B2 trouble codes, previously active"),
    (0xFD58, "DM48 class B2 trouble codes, confirmed and active"),
    (0xFD59, "DM47 class B2 trouble codes, pending"),
    (0xFD5A, "DM46 class B1 trouble codes, previously active"),
    (0xFD5B, "DM45 class B1 trouble codes, confirmed and active"),
    (0xFD5C, "DM44 class B1 trouble codes, pending"),
    (0xFD5D, "DM43 class A trouble codes, previously active"),
    (0xFD5E, "DM42 class A trouble codes, confirmed and active"),
    (0xFD5F, "DM41 class A trouble codes, pending"),
    (0xFD60, "DM40 harmonized B1 failure counts"),
    (0xFD61, "DM39 harmonized cumulative malfunction indicator time"),
    (0xFD62, "DM38 harmonized global regulation description"),
    (0xFD63, "DM37 harmonized roadworthiness, system"),
    (0xFD64, "DM36 harmonized roadworthiness, vehicle"),
    (0xFD7C, "DPFC1 particulate filter control"),
    (0xFD80, "DM28 permanent trouble codes"),
    (0xFD82, "DM27 all pending trouble codes"),
    (0xFDB5, "DM23 previously active emission-related trouble codes"),
    (0xFDB6, "DM24 SPN support"),
    (0xFDB7, "DM25 expanded freeze frame"),
    (0xFDB8, "DM26 diagnostic readiness 3"),
    (0xFDC5, "ECUID identification of the control unit"),
    (0xFE4E, "DC1 door control 1"),
    (0xFE4F, "VDC1 vehicle dynamics stability control"),
    (0xFE56, "AT1T1I aftertreatment tank"),
    (0xFE6C, "TCO1 tachograph"),
    (0xFE70, "CVW combination vehicle weight"),
    (0xFEAE, "AIR1 air supply pressure"),
    (0xFEAF, "GFC fuel consumption, gaseous"),
    (0xFEB0, "TTI2 trip time information 2"),
    (0xFEBD, "FD fan drive"),
    (0xFEBF, "EBC2 wheel speeds"),
    (0xFEC0, "SERV service"),
    (0xFEC1, "VDHR high resolution vehicle distance"),
    (0xFECA, "DM1 active trouble codes"),
    (0xFECB, "DM2 previously active trouble codes"),
    (0xFECC, "DM3 clear previously active trouble codes"),
    (0xFECD, "DM4 freeze frame"),
    (0xFECE, "DM5 diagnostic readiness"),
    (0xFECF, "DM6 pending trouble codes"),
    (0xFED0, "DM8 test results"),
    (0xFED1, "DM9 oxygen sensor test results"),
    (0xFED2, "DM10 non-continuously monitored test support"),
    (0xFED3, "DM11 clear active trouble codes"),
    (0xFED4, "DM12 emission-related active trouble codes"),
    (0xFED8, "commanded address"),
    (0xFEDA, "SOFT software identification"),
    (0xFEDB, "EFL/P2 engine fluid level and pressure"),
    (0xFEDC, "IO idle operation"),
    (0xFEDF, "EEC3 engine"),
    (0xFEE0, "VD vehicle distance"),
    (0xFEE1, "RC retarder configuration"),
    (0xFEE2, "TCFG transmission configuration"),
    (0xFEE3, "EC1 engine configuration"),
    (0xFEE4, "SHUTDN shutdown"),
    (0xFEE5, "HOURS engine hours, revolutions"),
    (0xFEE6, "TD time and date"),
    (0xFEE8, "VDS vehicle direction and speed"),
    (0xFEE9, "LFC fuel consumption, liquid"),
    (0xFEEA, "VW vehicle weight"),
    (0xFEEB, "CI component identification"),
    (0xFEEC, "VI vehicle identification"),
    (0xFEEE, "ET1 engine temperature"),
    (0xFEEF, "EFL/P1 engine fluid level and pressure"),
    (0xFEF0, "PTO power take-off"),
    (0xFEF1, "CCVS1 cruise control and vehicle speed"),
    (0xFEF2, "LFE1 fuel economy, liquid"),
    (0xFEF3, "VP vehicle position"),
    (0xFEF5, "AMB ambient conditions"),
    (0xFEF6, "IC1 inlet and exhaust conditions"),
    (0xFEF7, "VEP1 vehicle electrical power"),
    (0xFEF8, "TRF1 transmission fluids"),
    (0xFEFC, "DD1 dash display"),
];

/// A parameter group's name.
pub fn group(pgn: u32) -> Option<&'static str> {
    let place = GROUPS.binary_search_by_key(&order(pgn), |(known, _)| order(*known)).ok();
    place.map(|place| GROUPS[place].1).or(match pgn {
        0xFF00..=0xFFFF => Some("proprietary B"),
        0x1_FF00..=0x1_FFFF => Some("proprietary B2"),
        _ => None,
    })
}

/// The table is sorted by the low 16 bits, so that pages are together.
const fn order(pgn: u32) -> u32 {
    (pgn & 0xFFFF) << 2 | pgn >> 16
}

/// Failure mode identifiers (SAE J1939-73, appendix A), as listed publicly in the J1939 library of CODESYS (its
/// enumeration FMI), and in engine makers' manuals.
pub const fn failure_mode(fmi: u8) -> &'static str {
    match fmi {
        0 => "above normal range, most severe",
        1 => "below normal range, most severe",
        2 => "erratic, intermittent or incorrect",
        3 => "voltage above normal or shorted high",
        4 => "voltage below normal or shorted low",
        5 => "current below normal or open circuit",
        6 => "current above normal or grounded circuit",
        7 => "mechanical system not responding or out of adjustment",
        8 => "abnormal frequency, pulse width or period",
        9 => "abnormal update rate",
        10 => "abnormal rate of change",
        11 => "root cause not known",
        12 => "bad intelligent device or component",
        13 => "out of calibration",
        14 => "special instructions",
        15 => "above normal range, least severe",
        16 => "above normal range, moderately severe",
        17 => "below normal range, least severe",
        18 => "below normal range, moderately severe",
        19 => "received network data in error",
        20 => "drifted high",
        21 => "drifted low",
        31 => "condition exists",
        _ => "reserved",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_in_order() {
        assert!(GROUPS.is_sorted_by_key(|(pgn, _)| order(*pgn)));
        assert_eq!(group(0xF004), Some("EEC1 engine"));
        assert_eq!(group(0x1_EF00), Some("proprietary A2"));
    }
}
