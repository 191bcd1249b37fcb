//! The messages of CCP 2.1: commands (CROs) with their parts, return codes.
//!
//! A station's address is sent with its lowest byte first; in which order all other numbers are, is the ECU's own matter.

use crate::calibration::parts::PacketPart::{self, Bits, Hex, Named, Number, Rest, Skip};
use crate::calibration::parts::{CommandDefinition, command, name_in};

/// Packet identifier of the answer to a command.
pub const COMMAND_RETURN: u8 = 0xFF;
/// Of a message about something that happened.
pub const EVENT: u8 = 0xFE;

/// Codes of the commands that have more than parts.
pub mod command {
    #![allow(missing_docs, reason = "they have the standard's names")]
    pub const CONNECT: u8 = 0x01;
    pub const SET_MTA: u8 = 0x02;
    pub const DNLOAD: u8 = 0x03;
    pub const UPLOAD: u8 = 0x04;
    pub const START_STOP: u8 = 0x06;
    pub const DISCONNECT: u8 = 0x07;
    pub const START_STOP_ALL: u8 = 0x08;
    pub const SET_S_STATUS: u8 = 0x0C;
    pub const GET_S_STATUS: u8 = 0x0D;
    pub const SHORT_UP: u8 = 0x0F;
    pub const GET_SEED: u8 = 0x12;
    pub const UNLOCK: u8 = 0x13;
    pub const GET_DAQ_SIZE: u8 = 0x14;
    pub const SET_DAQ_PTR: u8 = 0x15;
    pub const WRITE_DAQ: u8 = 0x16;
    pub const EXCHANGE_ID: u8 = 0x17;
    pub const GET_CCP_VERSION: u8 = 0x1B;
    pub const DNLOAD_6: u8 = 0x23;
}

/// Resources, as in the response to EXCHANGE_ID, seeds and keys.
pub const RESOURCES: &[(u8, &str)] = &[(0x01, "calibration"), (0x02, "DAQ"), (0x40, "programming")];
const SESSION: &[(u8, &str)] = &[
    (0x01, "calibration data initialised"),
    (0x02, "DAQ list initialised"),
    (0x04, "resume"),
    (0x40, "store"),
    (0x80, "running"),
];
const ADDRESS: &[PacketPart] = &[Number("mta", 1), Number("extension", 1), Hex("address", 4)];
const NEXT: &[PacketPart] = &[Number("next_extension", 1), Hex("next_address", 4)];
const COUNT: &[PacketPart] = &[Number("elements", 1)];

/// All commands.
pub const COMMANDS: &[CommandDefinition] = &[
    command(command::CONNECT, "CONNECT", &[Hex("station", 2)], &[]),
    command(command::SET_MTA, "SET_MTA", ADDRESS, &[]),
    command(command::DNLOAD, "DNLOAD", COUNT, NEXT),
    command(command::UPLOAD, "UPLOAD", COUNT, &[]),
    command(0x05, "TEST", &[Hex("station", 2)], &[]),
    command(
        command::START_STOP,
        "START_STOP",
        &[
            Named("mode", &[(0, "stop"), (1, "start"), (2, "prepare")]),
            Number("daq", 1),
            Number("last_odt", 1),
            Number("event", 1),
            Number("prescaler", 2),
        ],
        &[],
    ),
    command(
        command::DISCONNECT,
        "DISCONNECT",
        &[Named("mode", &[(0, "temporary"), (1, "end of session")]), Skip(1), Hex("station", 2)],
        &[],
    ),
    command(
        command::START_STOP_ALL,
        "START_STOP_ALL",
        &[Named("mode", &[(0, "stop all"), (1, "start prepared")])],
        &[],
    ),
    command(0x09, "GET_ACTIVE_CAL_PAGE", &[], &[Number("extension", 1), Hex("address", 4)]),
    command(command::SET_S_STATUS, "SET_S_STATUS", &[Bits("status", SESSION)], &[]),
    command(command::GET_S_STATUS, "GET_S_STATUS", &[], &[Bits("status", SESSION), Hex("additional", 1)]),
    command(0x0E, "BUILD_CHKSUM", &[Number("block_size", 4)], &[Number("length", 1), Hex("checksum", 4)]),
    command(
        command::SHORT_UP,
        "SHORT_UP",
        &[Number("elements", 1), Number("extension", 1), Hex("address", 4)],
        &[],
    ),
    command(0x10, "CLEAR_MEMORY", &[Number("size", 4)], &[]),
    command(0x11, "SELECT_CAL_PAGE", &[], &[]),
    command(
        command::GET_SEED,
        "GET_SEED",
        &[Bits("resource", RESOURCES)],
        &[Named("protected", &[(0, "no"), (1, "yes")]), Rest("seed")],
    ),
    command(command::UNLOCK, "UNLOCK", &[Rest("key")], &[Bits("unlocked", RESOURCES)]),
    command(
        command::GET_DAQ_SIZE,
        "GET_DAQ_SIZE",
        &[Number("daq", 1), Skip(1), Hex("can_id", 4)],
        &[Number("odts", 1), Hex("first_pid", 1)],
    ),
    command(
        command::SET_DAQ_PTR,
        "SET_DAQ_PTR",
        &[Number("daq", 1), Number("odt", 1), Number("entry", 1)],
        &[],
    ),
    command(
        command::WRITE_DAQ,
        "WRITE_DAQ",
        &[Number("size", 1), Number("extension", 1), Hex("address", 4)],
        &[],
    ),
    command(
        command::EXCHANGE_ID,
        "EXCHANGE_ID",
        &[],
        &[Number("length", 1), Hex("type", 1), Bits("available", RESOURCES), Bits("protected", RESOURCES)],
    ),
    command(0x18, "PROGRAM", COUNT, NEXT),
    command(0x19, "MOVE", &[Number("size", 4)], &[]),
    command(
        command::GET_CCP_VERSION,
        "GET_CCP_VERSION",
        &[Number("main_version", 1), Number("release", 1)],
        &[Number("main_version", 1), Number("release", 1)],
    ),
    command(
        0x20,
        "DIAG_SERVICE",
        &[Hex("service", 2), Rest("parameters")],
        &[Number("length", 1), Hex("type", 1)],
    ),
    command(
        0x21,
        "ACTION_SERVICE",
        &[Hex("service", 2), Rest("parameters")],
        &[Number("length", 1), Hex("type", 1)],
    ),
    command(0x22, "PROGRAM_6", &[], NEXT),
    command(command::DNLOAD_6, "DNLOAD_6", &[], NEXT),
];

/// The command with this code.
pub fn find(code: u8) -> Option<&'static CommandDefinition> {
    COMMANDS.iter().find(|command| command.code == code)
}

/// The words for a return code.
pub fn return_name(code: u8) -> Option<&'static str> {
    name_in(
        &[
            (0x00, "acknowledge"),
            (0x01, "DAQ processor overload"),
            (0x10, "command processor busy"),
            (0x11, "DAQ processor busy"),
            (0x12, "internal timeout"),
            (0x18, "key request"),
            (0x19, "session status request"),
            (0x20, "cold start request"),
            (0x21, "calibration data initialisation request"),
            (0x22, "DAQ list initialisation request"),
            (0x23, "code update request"),
            (0x30, "unknown command"),
            (0x31, "command syntax"),
            (0x32, "parameter out of range"),
            (0x33, "access denied"),
            (0x34, "overload"),
            (0x35, "access locked"),
            (0x36, "resource or function not available"),
        ],
        code,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_stands_once() {
        for (at, one) in COMMANDS.iter().enumerate() {
            assert!(find(one.code).is_some());
            assert!(
                COMMANDS[..at].iter().all(|other| other.code != one.code && other.name != one.name),
                "{one:?}"
            );
        }
    }
}
