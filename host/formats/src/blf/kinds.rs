//! Other content of BLF files: the objects of other buses and of the measurement, by groups that users know.
//!
//! Numbers from Tobias Lorenz's vector_blf (`ObjectHeaderBase.h`).

use super::super::codec::OTHER_LIN;

const OTHER: &str = "objects of other kinds";

/// Whether an object belongs to one of the groups that are no part of a CAN trace.
pub(super) fn is_left_out(kind: u32) -> bool {
    group(kind) != OTHER
}

/// A description of an object that is not part of a CAN trace.
pub(super) fn group(kind: u32) -> &'static str {
    match kind {
        3 => "CAN overload frames",
        4 => "CAN statistics",
        5 | 96 | 127 | 128 => "triggers and markers",
        6..=9 | 72 => "environment and system variables",
        11..=21 | 42 | 43 | 54 | 57..=64 | 75 | 87..=89 | 105 => OTHER_LIN,
        22..=25 | 32..=39 | 67..=70 | 76..=85 | 95 => "MOST frames and events",
        29 | 30 | 40 | 41 | 45 | 47..=50 | 66 => "FlexRay frames and events",
        31 | 44 | 74 => "CAN driver errors",
        46 => "GPS positions",
        55 | 56 => "J1708 frames",
        65 | 92 => "comments and texts",
        71 | 102 | 103 | 114 | 120..=122 => "Ethernet frames and events",
        90 => "serial port events",
        91 => "overruns of other buses",
        93 | 94 => "WLAN frames and events",
        97 | 98 | 106 | 107 | 109 => "AFDX frames and events",
        99 | 118 | 119 => "diagnostics and tests",
        110..=113 => "ARINC 429 frames and events",
        _ => OTHER,
    }
}

/// Objects that only describe how the file or the measurement is made, none of which is missed: real-time clock, empty
/// places, the beginning of a loss whose end says how much was lost, settings, attributes.
pub(super) const fn is_bookkeeping(kind: u32) -> bool {
    matches!(kind, 0 | 51 | 115 | 125 | 129 | 130 | 131 | 132)
}
