//! Names for DeviceNet's and CIP's numbers, as far as they are public. The tables are in `data/devicenet.csv`.

use crate::table::Table;

const FILE: &str = include_str!("../../data/devicenet.csv");
/// The class of the DeviceNet object.
const DEVICENET: u16 = 3;

static SERVICES: Table = Table::new(FILE, "service");
static SERVICES_OF_DEVICENET: Table = Table::new(FILE, "service_of_devicenet");
static SERVICES_WITHOUT_CLASS: Table = Table::new(FILE, "service_without_class");
static CLASSES: Table = Table::new(FILE, "class");
static ERRORS: Table = Table::new(FILE, "error");

/// Services; from 4B on they depend on the class.
pub fn service(service: u8, class: Option<u16>) -> Option<&'static str> {
    SERVICES.get(service).or_else(|| match class {
        Some(DEVICENET) => SERVICES_OF_DEVICENET.get(service),
        Some(_) => None,
        None => SERVICES_WITHOUT_CLASS.get(service),
    })
}

/// Classes of objects.
pub fn class(class: u16) -> Option<&'static str> {
    CLASSES.get(class)
}

/// Why a service is refused.
pub fn error(code: u8) -> &'static str {
    ERRORS.get(code).unwrap_or("reserved")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::check;

    #[test]
    fn every_line_of_the_file_is_in_a_table() {
        let services = [&SERVICES, &SERVICES_OF_DEVICENET, &SERVICES_WITHOUT_CLASS];
        check(FILE, &services.into_iter().chain([&CLASSES, &ERRORS]).collect::<Vec<_>>());
    }
}
