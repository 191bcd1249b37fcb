//! Names for CiA 301's numbers.

/// Network management commands.
pub const fn command(command: u8) -> Option<&'static str> {
    Some(match command {
        1 => "start",
        2 => "stop",
        128 => "enter pre-operational",
        129 => "reset node",
        130 => "reset communication",
        _ => return None,
    })
}

/// States of a node, without the toggle bit of guarding.
pub const fn state(state: u8) -> Option<&'static str> {
    Some(match state {
        0 => "boot-up",
        4 => "stopped",
        5 => "operational",
        127 => "pre-operational",
        _ => return None,
    })
}

/// Why an SDO transfer was aborted (CiA 301, table 22).
pub const fn abort(code: u32) -> &'static str {
    match code {
        0x0503_0000 => "toggle bit not alternated",
        0x0504_0000 => "protocol timed out",
        0x0504_0001 => "command specifier not valid or unknown",
        0x0504_0002 => "invalid block size",
        0x0504_0003 => "invalid sequence number",
        0x0504_0004 => "CRC error",
        0x0504_0005 => "out of memory",
        0x0601_0000 => "unsupported access to an object",
        0x0601_0001 => "attempt to read a write only object",
        0x0601_0002 => "attempt to write a read only object",
        0x0602_0000 => "object does not exist",
        0x0604_0041 => "object cannot be mapped to the PDO",
        0x0604_0042 => "mapped objects would exceed the PDO's length",
        0x0604_0043 => "general parameter incompatibility",
        0x0604_0047 => "general internal incompatibility",
        0x0606_0000 => "access failed due to a hardware error",
        0x0607_0010 => "data type or length does not match",
        0x0607_0012 => "data type does not match, too long",
        0x0607_0013 => "data type does not match, too short",
        0x0609_0011 => "sub-index does not exist",
        0x0609_0030 => "invalid value",
        0x0609_0031 => "value too high",
        0x0609_0032 => "value too low",
        0x0609_0036 => "maximum value is less than minimum value",
        0x060A_0023 => "resource not available",
        0x0800_0000 => "general error",
        0x0800_0020 => "data cannot be transferred or stored",
        0x0800_0021 => "data cannot be transferred or stored: local control",
        0x0800_0022 => "data cannot be transferred or stored: device state",
        0x0800_0023 => "no object dictionary",
        0x0800_0024 => "no data available",
        _ => "unknown code",
    }
}

/// Emergency error codes (CiA 301, table 26), as specifically as they are known.
pub const fn emergency(code: u16) -> &'static str {
    match code {
        0x0000..=0x00FF => "no error, or reset",
        0x1000..=0x10FF => "generic error",
        0x2000..=0x20FF => "current",
        0x2100..=0x21FF => "current, device input side",
        0x2200..=0x22FF => "current inside the device",
        0x2300..=0x23FF => "current, device output side",
        0x3000..=0x30FF => "voltage",
        0x3100..=0x31FF => "mains voltage",
        0x3200..=0x32FF => "voltage inside the device",
        0x3300..=0x33FF => "output voltage",
        0x4000..=0x40FF => "temperature",
        0x4100..=0x41FF => "ambient temperature",
        0x4200..=0x42FF => "device temperature",
        0x5000..=0x50FF => "device hardware",
        0x6000..=0x60FF => "device software",
        0x6100..=0x61FF => "internal software",
        0x6200..=0x62FF => "user software",
        0x6300..=0x63FF => "data set",
        0x7000..=0x70FF => "additional modules",
        0x8000..=0x80FF => "monitoring",
        0x8110 => "CAN overrun, objects lost",
        0x8120 => "CAN in error passive mode",
        0x8130 => "life guard or heartbeat error",
        0x8140 => "recovered from bus off",
        0x8150 => "CAN-ID collision",
        0x8100..=0x81FF => "communication",
        0x8210 => "PDO not processed due to length error",
        0x8220 => "PDO length exceeded",
        0x8230 => "DAM MPDO not processed",
        0x8240 => "unexpected SYNC data length",
        0x8250 => "RPDO timeout",
        0x8200..=0x82FF => "protocol error",
        0x9000..=0x90FF => "external error",
        0xF000..=0xF0FF => "additional functions",
        0xFF00..=0xFFFF => "device specific",
        _ => "reserved",
    }
}

/// Objects of the communication profile.
pub fn object(index: u16) -> Option<&'static str> {
    Some(match index {
        0x1000 => "device type",
        0x1001 => "error register",
        0x1002 => "manufacturer status register",
        0x1003 => "predefined error field",
        0x1005 => "COB-ID SYNC",
        0x1006 => "communication cycle period",
        0x1007 => "synchronous window length",
        0x1008 => "manufacturer device name",
        0x1009 => "manufacturer hardware version",
        0x100A => "manufacturer software version",
        0x100C => "guard time",
        0x100D => "life time factor",
        0x1010 => "store parameters",
        0x1011 => "restore default parameters",
        0x1012 => "COB-ID TIME",
        0x1013 => "high resolution time stamp",
        0x1014 => "COB-ID EMCY",
        0x1015 => "inhibit time EMCY",
        0x1016 => "consumer heartbeat time",
        0x1017 => "producer heartbeat time",
        0x1018 => "identity object",
        0x1019 => "synchronous counter overflow value",
        0x1020 => "verify configuration",
        0x1029 => "error behaviour",
        0x1200..=0x127F => "SDO server parameter",
        0x1280..=0x12FF => "SDO client parameter",
        0x1400..=0x15FF => "RPDO communication parameter",
        0x1600..=0x17FF => "RPDO mapping parameter",
        0x1800..=0x19FF => "TPDO communication parameter",
        0x1A00..=0x1BFF => "TPDO mapping parameter",
        0x1F50 => "program data",
        0x1F51 => "program control",
        0x1F80 => "NMT startup",
        _ => return None,
    })
}
