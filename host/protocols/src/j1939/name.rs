//! The 64-bit NAME with which a node claims its address (SAE J1939-81, 4.1).

use super::names;
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
    fields.push(Field::number("function", part(40, 8)).meaning(names::function(part(40, 8) as u8)));
    fields.push(Field::number("vehicle_system", part(49, 7)));
    fields.push(Field::number("vehicle_system_instance", part(56, 4)));
    fields.push(Field::number("industry_group", industry).meaning(names::industry_group(industry as u8)));
    let arbitrary = if part(63, 1) == 1 { "takes any address" } else { "keeps to its address" };
    fields.push(Field::number("arbitrary_address_capable", part(63, 1)).meaning(Some(arbitrary)));
}
