//! The packets of XCP (ASAM MCD-1 XCP 1.5, protocol layer): identifiers, commands with their parts, errors, events, services.

use crate::calibration::parts::PacketPart::{self, Bits, Hex, Named, Number, Rest, Skip};
use crate::calibration::parts::{CommandDefinition, command, name_in};

/// Packet identifier of a positive response.
pub const RES: u8 = 0xFF;
/// Of a negative one.
pub const ERR: u8 = 0xFE;
/// Of an event.
pub const EV: u8 = 0xFD;
/// Of a request for a service.
pub const SERV: u8 = 0xFC;
/// The lowest packet identifier of a command; those of a master below it are stimulation.
pub const LEAST_COMMAND: u8 = 0xC0;

/// Codes of the commands that have more than parts.
pub mod command {
    #![allow(missing_docs, reason = "they have the standard's names")]
    pub const CONNECT: u8 = 0xFF;
    pub const DISCONNECT: u8 = 0xFE;
    pub const GET_STATUS: u8 = 0xFD;
    pub const SYNCH: u8 = 0xFC;
    pub const GET_COMM_MODE_INFO: u8 = 0xFB;
    pub const GET_ID: u8 = 0xFA;
    pub const GET_SEED: u8 = 0xF8;
    pub const UNLOCK: u8 = 0xF7;
    pub const SET_MTA: u8 = 0xF6;
    pub const UPLOAD: u8 = 0xF5;
    pub const SHORT_UPLOAD: u8 = 0xF4;
    pub const BUILD_CHECKSUM: u8 = 0xF3;
    pub const DOWNLOAD: u8 = 0xF0;
    pub const DOWNLOAD_NEXT: u8 = 0xEF;
    pub const DOWNLOAD_MAX: u8 = 0xEE;
    pub const SHORT_DOWNLOAD: u8 = 0xED;
    pub const CLEAR_DAQ_LIST: u8 = 0xE3;
    pub const SET_DAQ_PTR: u8 = 0xE2;
    pub const WRITE_DAQ: u8 = 0xE1;
    pub const SET_DAQ_LIST_MODE: u8 = 0xE0;
    pub const GET_DAQ_LIST_MODE: u8 = 0xDF;
    pub const START_STOP_DAQ_LIST: u8 = 0xDE;
    pub const START_STOP_SYNCH: u8 = 0xDD;
    pub const GET_DAQ_CLOCK: u8 = 0xDC;
    pub const GET_DAQ_PROCESSOR_INFO: u8 = 0xDA;
    pub const GET_DAQ_RESOLUTION_INFO: u8 = 0xD9;
    pub const GET_DAQ_LIST_INFO: u8 = 0xD8;
    pub const GET_DAQ_EVENT_INFO: u8 = 0xD7;
    pub const FREE_DAQ: u8 = 0xD6;
    pub const ALLOC_DAQ: u8 = 0xD5;
    pub const ALLOC_ODT: u8 = 0xD4;
    pub const ALLOC_ODT_ENTRY: u8 = 0xD3;
    pub const PROGRAM_START: u8 = 0xD2;
    pub const PROGRAM_CLEAR: u8 = 0xD1;
    pub const PROGRAM: u8 = 0xD0;
    pub const PROGRAM_RESET: u8 = 0xCF;
    pub const PROGRAM_NEXT: u8 = 0xCA;
    pub const PROGRAM_MAX: u8 = 0xC9;
    pub const WRITE_DAQ_MULTIPLE: u8 = 0xC7;
}

/// Codes of errors that a master acts on.
pub mod error {
    #![allow(missing_docs, reason = "they have the standard's names")]
    pub const CMD_SYNCH: u8 = 0x00;
    pub const CMD_BUSY: u8 = 0x10;
    pub const CMD_UNKNOWN: u8 = 0x20;
    pub const CMD_SYNTAX: u8 = 0x21;
    pub const OUT_OF_RANGE: u8 = 0x22;
    pub const ACCESS_DENIED: u8 = 0x24;
    pub const ACCESS_LOCKED: u8 = 0x25;
    pub const SEQUENCE: u8 = 0x29;
    pub const DAQ_CONFIG: u8 = 0x2A;
    pub const MEMORY_OVERFLOW: u8 = 0x30;
}

/// Code of the event that asks the master to wait longer.
pub const EV_CMD_PENDING: u8 = 0x05;
/// Code of the event with which the slave ends the session.
pub const EV_SESSION_TERMINATED: u8 = 0x07;

/// Resources, as in CONNECT's response, protection, seeds and keys.
pub const RESOURCES: &[(u8, &str)] =
    &[(0x01, "calibration"), (0x04, "DAQ"), (0x08, "STIM"), (0x10, "programming"), (0x20, "debugging")];
const COMM_MODE_BASIC: &[(u8, &str)] = &[
    (0x01, "Motorola"),
    (0x02, "words"),
    (0x04, "double words"),
    (0x40, "slave block mode"),
    (0x80, "more by GET_COMM_MODE_INFO"),
];
const COMM_MODE_OPTIONAL: &[(u8, &str)] = &[(0x01, "master block mode"), (0x02, "interleaved")];
const SESSION_STATUS: &[(u8, &str)] = &[
    (0x01, "store calibration"),
    (0x02, "calibration page configuration lost"),
    (0x04, "store DAQ"),
    (0x08, "clear DAQ"),
    (0x10, "DAQ configuration lost"),
    (0x40, "DAQ running"),
    (0x80, "resume"),
];
const CONNECT_MODES: &[(u8, &str)] = &[(0, "normal"), (1, "user defined")];
const ID_TYPES: &[(u8, &str)] = &[
    (0, "text"),
    (1, "A2L file name without path and extension"),
    (2, "A2L file name"),
    (3, "URL of the A2L file"),
    (4, "A2L file"),
    (5, "EPK"),
];
const LIST_MODES: &[(u8, &str)] = &[
    (0x01, "alternating"),
    (0x02, "STIM"),
    (0x04, "counter"),
    (0x10, "time stamp"),
    (0x20, "without packet identifier"),
    (0x40, "running"),
    (0x80, "resume"),
];
const SELECTIONS: &[(u8, &str)] = &[(0, "stop"), (1, "start"), (2, "select")];
const SYNCH_MODES: &[(u8, &str)] =
    &[(0, "stop all"), (1, "start selected"), (2, "stop selected"), (3, "prepare selected")];
const DAQ_PROPERTIES: &[(u8, &str)] = &[
    (0x01, "dynamic"),
    (0x02, "prescaler"),
    (0x04, "resume"),
    (0x08, "bitwise STIM"),
    (0x10, "time stamps"),
    (0x20, "packet identifiers can be left out"),
    (0x40, "overload in the packet identifier"),
    (0x80, "overload as event"),
];
const EVENT_PROPERTIES: &[(u8, &str)] = &[(0x04, "DAQ"), (0x08, "STIM"), (0x10, "packed")];
const PAGE_MODES: &[(u8, &str)] = &[(0x01, "ECU"), (0x02, "XCP"), (0x80, "all segments")];
const CHECKSUMS: &[(u8, &str)] = &[
    (1, "sum of bytes in a byte"),
    (2, "sum of bytes in a word"),
    (3, "sum of bytes in a double word"),
    (4, "sum of words in a word"),
    (5, "sum of words in a double word"),
    (6, "sum of double words"),
    (7, "CRC-16"),
    (8, "CRC-16 CCITT"),
    (9, "CRC-32"),
    (0xFF, "user defined"),
];
const ADDRESS: &[PacketPart] = &[Skip(2), Number("extension", 1), Hex("address", 4)];
const COUNTED_ADDRESS: &[PacketPart] =
    &[Number("elements", 1), Skip(1), Number("extension", 1), Hex("address", 4)];
const COUNT: &[PacketPart] = &[Number("elements", 1)];
const LIST: &[PacketPart] = &[Skip(1), Number("daq", 2)];

/// All commands.
pub const COMMANDS: &[CommandDefinition] = &[
    command(
        command::CONNECT,
        "CONNECT",
        &[Named("mode", CONNECT_MODES)],
        &[
            Bits("resources", RESOURCES),
            Bits("comm_mode_basic", COMM_MODE_BASIC),
            Number("max_cto", 1),
            Number("max_dto", 2),
            Number("protocol_version", 1),
            Number("transport_version", 1),
        ],
    ),
    command(command::DISCONNECT, "DISCONNECT", &[], &[]),
    command(
        command::GET_STATUS,
        "GET_STATUS",
        &[],
        &[
            Bits("status", SESSION_STATUS),
            Bits("protected", RESOURCES),
            Number("state", 1),
            Hex("configuration", 2),
        ],
    ),
    command(command::SYNCH, "SYNCH", &[], &[]),
    command(
        command::GET_COMM_MODE_INFO,
        "GET_COMM_MODE_INFO",
        &[],
        &[
            Skip(1),
            Bits("comm_mode_optional", COMM_MODE_OPTIONAL),
            Skip(1),
            Number("max_block_frames", 1),
            Number("min_separation_100us", 1),
            Number("queue_size", 1),
            Hex("driver_version", 1),
        ],
    ),
    command(
        command::GET_ID,
        "GET_ID",
        &[Named("type", ID_TYPES)],
        &[Hex("mode", 1), Skip(2), Number("length", 4), Rest("identification")],
    ),
    command(0xF9, "SET_REQUEST", &[Hex("mode", 1), Hex("configuration", 2)], &[]),
    command(
        command::GET_SEED,
        "GET_SEED",
        &[Named("part", &[(0, "first"), (1, "rest")]), Bits("resource", RESOURCES)],
        &[Number("length", 1), Rest("seed")],
    ),
    command(command::UNLOCK, "UNLOCK", &[Number("length", 1), Rest("key")], &[Bits("protected", RESOURCES)]),
    command(command::SET_MTA, "SET_MTA", ADDRESS, &[]),
    command(command::UPLOAD, "UPLOAD", COUNT, &[]),
    command(command::SHORT_UPLOAD, "SHORT_UPLOAD", COUNTED_ADDRESS, &[]),
    command(
        command::BUILD_CHECKSUM,
        "BUILD_CHECKSUM",
        &[Skip(3), Number("block_size", 4)],
        &[Named("type", CHECKSUMS), Skip(2), Hex("checksum", 4)],
    ),
    command(0xF2, "TRANSPORT_LAYER_CMD", &[Hex("sub_command", 1), Rest("parameters")], &[Rest("result")]),
    command(0xF1, "USER_CMD", &[Hex("sub_command", 1), Rest("parameters")], &[Rest("result")]),
    command(command::DOWNLOAD, "DOWNLOAD", COUNT, &[]),
    command(command::DOWNLOAD_NEXT, "DOWNLOAD_NEXT", COUNT, &[]),
    command(command::DOWNLOAD_MAX, "DOWNLOAD_MAX", &[], &[]),
    command(command::SHORT_DOWNLOAD, "SHORT_DOWNLOAD", COUNTED_ADDRESS, &[]),
    command(0xEC, "MODIFY_BITS", &[Number("shift", 1), Hex("and_mask", 2), Hex("xor_mask", 2)], &[]),
    command(0xEB, "SET_CAL_PAGE", &[Bits("mode", PAGE_MODES), Number("segment", 1), Number("page", 1)], &[]),
    command(
        0xEA,
        "GET_CAL_PAGE",
        &[Bits("mode", PAGE_MODES), Number("segment", 1)],
        &[Skip(2), Number("page", 1)],
    ),
    command(0xE9, "GET_PAG_PROCESSOR_INFO", &[], &[Number("segments", 1), Hex("properties", 1)]),
    command(
        0xE8,
        "GET_SEGMENT_INFO",
        &[Hex("mode", 1), Number("segment", 1), Hex("info", 1), Number("mapping", 1)],
        &[Rest("info")],
    ),
    command(
        0xE7,
        "GET_PAGE_INFO",
        &[Skip(1), Number("segment", 1), Number("page", 1)],
        &[Hex("properties", 1), Number("init_segment", 1)],
    ),
    command(0xE6, "SET_SEGMENT_MODE", &[Hex("mode", 1), Number("segment", 1)], &[]),
    command(0xE5, "GET_SEGMENT_MODE", &[Skip(1), Number("segment", 1)], &[Skip(1), Hex("mode", 1)]),
    command(
        0xE4,
        "COPY_CAL_PAGE",
        &[Number("from_segment", 1), Number("from_page", 1), Number("to_segment", 1), Number("to_page", 1)],
        &[],
    ),
    command(command::CLEAR_DAQ_LIST, "CLEAR_DAQ_LIST", LIST, &[]),
    command(
        command::SET_DAQ_PTR,
        "SET_DAQ_PTR",
        &[Skip(1), Number("daq", 2), Number("odt", 1), Number("entry", 1)],
        &[],
    ),
    command(
        command::WRITE_DAQ,
        "WRITE_DAQ",
        &[Hex("bit_offset", 1), Number("size", 1), Number("extension", 1), Hex("address", 4)],
        &[],
    ),
    command(
        command::SET_DAQ_LIST_MODE,
        "SET_DAQ_LIST_MODE",
        &[
            Bits("mode", LIST_MODES),
            Number("daq", 2),
            Number("event", 2),
            Number("prescaler", 1),
            Number("priority", 1),
        ],
        &[],
    ),
    command(
        command::GET_DAQ_LIST_MODE,
        "GET_DAQ_LIST_MODE",
        LIST,
        &[
            Bits("mode", LIST_MODES),
            Skip(2),
            Number("event", 2),
            Number("prescaler", 1),
            Number("priority", 1),
        ],
    ),
    command(
        command::START_STOP_DAQ_LIST,
        "START_STOP_DAQ_LIST",
        &[Named("mode", SELECTIONS), Number("daq", 2)],
        &[Hex("first_pid", 1)],
    ),
    command(command::START_STOP_SYNCH, "START_STOP_SYNCH", &[Named("mode", SYNCH_MODES)], &[]),
    command(command::GET_DAQ_CLOCK, "GET_DAQ_CLOCK", &[], &[Skip(3), Number("clock", 4)]),
    command(
        0xDB,
        "READ_DAQ",
        &[],
        &[Hex("bit_offset", 1), Number("size", 1), Number("extension", 1), Hex("address", 4)],
    ),
    command(
        command::GET_DAQ_PROCESSOR_INFO,
        "GET_DAQ_PROCESSOR_INFO",
        &[],
        &[
            Bits("properties", DAQ_PROPERTIES),
            Number("lists", 2),
            Number("events", 2),
            Number("predefined_lists", 1),
            Hex("key", 1),
        ],
    ),
    command(
        command::GET_DAQ_RESOLUTION_INFO,
        "GET_DAQ_RESOLUTION_INFO",
        &[],
        &[
            Number("daq_granularity", 1),
            Number("daq_largest", 1),
            Number("stim_granularity", 1),
            Number("stim_largest", 1),
            Hex("timestamp_mode", 1),
            Number("timestamp_ticks", 2),
        ],
    ),
    command(
        command::GET_DAQ_LIST_INFO,
        "GET_DAQ_LIST_INFO",
        LIST,
        &[Hex("properties", 1), Number("odts", 1), Number("entries", 1), Number("event", 2)],
    ),
    command(
        command::GET_DAQ_EVENT_INFO,
        "GET_DAQ_EVENT_INFO",
        &[Skip(1), Number("event", 2)],
        &[
            Bits("properties", EVENT_PROPERTIES),
            Number("lists", 1),
            Number("name_length", 1),
            Number("cycle", 1),
            Number("cycle_unit", 1),
            Number("priority", 1),
        ],
    ),
    command(command::FREE_DAQ, "FREE_DAQ", &[], &[]),
    command(command::ALLOC_DAQ, "ALLOC_DAQ", &[Skip(1), Number("lists", 2)], &[]),
    command(command::ALLOC_ODT, "ALLOC_ODT", &[Skip(1), Number("daq", 2), Number("odts", 1)], &[]),
    command(
        command::ALLOC_ODT_ENTRY,
        "ALLOC_ODT_ENTRY",
        &[Skip(1), Number("daq", 2), Number("odt", 1), Number("entries", 1)],
        &[],
    ),
    command(
        command::PROGRAM_START,
        "PROGRAM_START",
        &[],
        &[
            Skip(1),
            Bits("comm_mode", COMM_MODE_OPTIONAL),
            Number("max_cto", 1),
            Number("max_block_frames", 1),
            Number("min_separation_100us", 1),
            Number("queue_size", 1),
        ],
    ),
    command(command::PROGRAM_CLEAR, "PROGRAM_CLEAR", &[Hex("mode", 1), Skip(2), Hex("range", 4)], &[]),
    command(command::PROGRAM, "PROGRAM", COUNT, &[]),
    command(command::PROGRAM_RESET, "PROGRAM_RESET", &[], &[]),
    command(0xCE, "GET_PGM_PROCESSOR_INFO", &[], &[Hex("properties", 1), Number("sectors", 1)]),
    command(0xCD, "GET_SECTOR_INFO", &[Hex("mode", 1), Number("sector", 1)], &[Rest("info")]),
    command(0xCC, "PROGRAM_PREPARE", &[Skip(1), Number("code_size", 2)], &[]),
    command(
        0xCB,
        "PROGRAM_FORMAT",
        &[Hex("compression", 1), Hex("encryption", 1), Hex("programming", 1), Hex("access", 1)],
        &[],
    ),
    command(command::PROGRAM_NEXT, "PROGRAM_NEXT", COUNT, &[]),
    command(command::PROGRAM_MAX, "PROGRAM_MAX", &[], &[]),
    command(0xC8, "PROGRAM_VERIFY", &[Hex("mode", 1), Hex("type", 2), Hex("value", 4)], &[]),
    command(command::WRITE_DAQ_MULTIPLE, "WRITE_DAQ_MULTIPLE", COUNT, &[]),
    command(0xC6, "TIME_CORRELATION_PROPERTIES", &[Rest("parameters")], &[Rest("result")]),
    command(0xC5, "DTO_CTR_PROPERTIES", &[Rest("parameters")], &[Rest("result")]),
    command(0xC0, "LEVEL_1_COMMAND", &[Hex("sub_command", 1), Rest("parameters")], &[Rest("result")]),
];

/// The command with this code.
pub fn find(code: u8) -> Option<&'static CommandDefinition> {
    COMMANDS.iter().find(|command| command.code == code)
}

/// The name of an error.
pub fn error_name(code: u8) -> Option<&'static str> {
    name_in(
        &[
            (error::CMD_SYNCH, "ERR_CMD_SYNCH"),
            (error::CMD_BUSY, "ERR_CMD_BUSY"),
            (0x11, "ERR_DAQ_ACTIVE"),
            (0x12, "ERR_PGM_ACTIVE"),
            (error::CMD_UNKNOWN, "ERR_CMD_UNKNOWN"),
            (error::CMD_SYNTAX, "ERR_CMD_SYNTAX"),
            (error::OUT_OF_RANGE, "ERR_OUT_OF_RANGE"),
            (0x23, "ERR_WRITE_PROTECTED"),
            (error::ACCESS_DENIED, "ERR_ACCESS_DENIED"),
            (error::ACCESS_LOCKED, "ERR_ACCESS_LOCKED"),
            (0x26, "ERR_PAGE_NOT_VALID"),
            (0x27, "ERR_MODE_NOT_VALID"),
            (0x28, "ERR_SEGMENT_NOT_VALID"),
            (error::SEQUENCE, "ERR_SEQUENCE"),
            (error::DAQ_CONFIG, "ERR_DAQ_CONFIG"),
            (error::MEMORY_OVERFLOW, "ERR_MEMORY_OVERFLOW"),
            (0x31, "ERR_GENERIC"),
            (0x32, "ERR_VERIFY"),
            (0x33, "ERR_RESOURCE_TEMPORARY_NOT_ACCESSIBLE"),
            (0x34, "ERR_SUBCMD_UNKNOWN"),
            (0x35, "ERR_TIMECORR_STATE_CHANGE"),
            (0xFC, "ERR_DBG"),
        ],
        code,
    )
}

/// The name of an event.
pub fn event_name(code: u8) -> Option<&'static str> {
    name_in(
        &[
            (0x00, "EV_RESUME_MODE"),
            (0x01, "EV_CLEAR_DAQ"),
            (0x02, "EV_STORE_DAQ"),
            (0x03, "EV_STORE_CAL"),
            (EV_CMD_PENDING, "EV_CMD_PENDING"),
            (0x06, "EV_DAQ_OVERLOAD"),
            (EV_SESSION_TERMINATED, "EV_SESSION_TERMINATED"),
            (0x08, "EV_TIME_SYNC"),
            (0x09, "EV_STIM_TIMEOUT"),
            (0x0A, "EV_SLEEP"),
            (0x0B, "EV_WAKE_UP"),
            (0x0C, "EV_ECU_STATE_CHANGE"),
            (0xFE, "EV_USER"),
            (0xFF, "EV_TRANSPORT"),
        ],
        code,
    )
}

/// The name of a service that a slave requests.
pub fn service_name(code: u8) -> Option<&'static str> {
    name_in(&[(0x00, "SERV_RESET"), (0x01, "SERV_TEXT")], code)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_stands_once() {
        for (at, one) in COMMANDS.iter().enumerate() {
            assert!(one.code >= LEAST_COMMAND && find(one.code).is_some());
            assert!(
                COMMANDS[..at].iter().all(|other| other.code != one.code && other.name != one.name),
                "{one:?}"
            );
        }
    }
}
