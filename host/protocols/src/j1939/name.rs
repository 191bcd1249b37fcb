//! The 64-bit NAME with which a node claims its address (SAE J1939-81, 4.1).

use crate::Field;

/// Its parts.
pub fn fields(name: u64, fields: &mut Vec<Field>) {
    let part = |shift: u32, bits: u32| (name >> shift & ((1 << bits) - 1)) as i64;
    let industry = part(60, 3);
    fields.push(Field::hex("name", name, 16));
    fields.push(Field::number("identity", part(0, 21)));
    fields.push(Field::number("manufacturer", part(21, 11)));
    fields.push(Field::number("ecu_instance", part(32, 3)));
    fields.push(Field::number("function_instance", part(35, 5)));
    fields.push(Field::number("function", part(40, 8)).meaning(function(part(40, 8))));
    fields.push(Field::number("vehicle_system", part(49, 7)));
    fields.push(Field::number("vehicle_system_instance", part(56, 4)));
    fields.push(Field::number("industry_group", industry).meaning(industry_group(industry)));
    let arbitrary = if part(63, 1) == 1 { "takes any address" } else { "keeps to its address" };
    fields.push(Field::number("arbitrary_address_capable", part(63, 1)).meaning(Some(arbitrary)));
}

const fn industry_group(group: i64) -> Option<&'static str> {
    Some(match group {
        0 => "global",
        1 => "on-highway",
        2 => "agriculture and forestry",
        3 => "construction",
        4 => "marine",
        5 => "industrial and stationary",
        _ => return None,
    })
}

/// Functions below 128 have the same meaning in every industry.
const fn function(function: i64) -> Option<&'static str> {
    Some(match function {
        0 => "engine",
        1 => "auxiliary power unit",
        2 => "electric propulsion control",
        3 => "transmission",
        4 => "battery pack monitor",
        5 => "shift control",
        6 => "power take-off",
        7 => "axle, steering",
        8 => "axle, drive",
        9 => "brakes, system controller",
        10 => "brakes, steer axle",
        11 => "brakes, drive axle",
        12 => "retarder, engine",
        13 => "retarder, driveline",
        14 => "cruise control",
        15 => "fuel system",
        16 => "steering controller",
        17 => "suspension, steer axle",
        18 => "suspension, drive axle",
        19 => "instrument cluster",
        20 => "trip recorder",
        21 => "cab climate control",
        24 => "electrical system controller",
        25 => "network interconnect",
        26 => "body controller",
        29 => "off-board diagnostic service tool",
        _ => return None,
    })
}
