//! The 64-bit NAME with which a node claims its address (SAE J1939-81, 4.1).

use super::names;
use crate::Field;

/// The parts of a NAME, each as wide as its comment says; higher bits are left out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct J1939Name {
    /// 21 bits, unique among its manufacturer's.
    pub identity: u32,
    /// 11 bits.
    pub manufacturer: u16,
    /// 3 bits: which of several units that do a function together.
    pub ecu_instance: u8,
    /// 5 bits.
    pub function_instance: u8,
    /// What it does.
    pub function: u8,
    /// 7 bits; NMEA 2000 calls it the device class.
    pub vehicle_system: u8,
    /// 4 bits.
    pub vehicle_system_instance: u8,
    /// 3 bits; 4 is marine.
    pub industry_group: u8,
    /// Whether it takes another address if somebody with a lower NAME has its own.
    pub takes_any_address: bool,
}

impl J1939Name {
    /// As in an address claim, read as a little-endian number.
    pub fn raw(self) -> u64 {
        let part = |value: u32, bits: u32, shift: u32| u64::from(value & ((1 << bits) - 1)) << shift;
        part(self.identity, 21, 0)
            | part(self.manufacturer.into(), 11, 21)
            | part(self.ecu_instance.into(), 3, 32)
            | part(self.function_instance.into(), 5, 35)
            | part(self.function.into(), 8, 40)
            | part(self.vehicle_system.into(), 7, 49)
            | part(self.vehicle_system_instance.into(), 4, 56)
            | part(self.industry_group.into(), 3, 60)
            | part(self.takes_any_address.into(), 1, 63)
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_read_as_it_was_written() {
        let name = J1939Name {
            identity: 0x1F_FFF0,
            manufacturer: 0x7FE,
            ecu_instance: 5,
            function_instance: 17,
            function: 130,
            vehicle_system: 75,
            vehicle_system_instance: 9,
            industry_group: 4,
            takes_any_address: true,
        };
        let mut read = Vec::new();
        fields(name.raw(), &mut read);
        let numbers: Vec<f64> = read[1..].iter().filter_map(|field| field.value.as_number()).collect();
        assert_eq!(numbers, [2_097_136.0, 2046.0, 5.0, 17.0, 130.0, 75.0, 9.0, 4.0, 1.0]);
    }
}
