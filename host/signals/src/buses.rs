//! Files that describe several buses: which of them are read, and the warning if all are.

use std::collections::HashMap;

use cantap_can::Id;

use super::fault::{DatabaseError, Fault, FaultKind};
use super::xml;

/// Which of a file's buses are read: the requested one, or all.
pub fn chosen(file: &str, all: Vec<String>, wanted: Option<&str>) -> Result<Vec<String>, DatabaseError> {
    let Some(wanted) = wanted else { return Ok(all) };
    if all.iter().any(|name| name == wanted) {
        return Ok(vec![wanted.to_owned()]);
    }
    let reason = match &all[..] {
        [] => format!("there is no bus {wanted:?} in it; its buses have no names"),
        all => format!("there is no bus {wanted:?} in it; its buses are {}", all.join(", ")),
    };
    Err(xml::faulty(file, reason))
}

/// The warning if identifiers are used on several buses that are read as one. `messages` are identifiers with the number of their
/// bus.
pub fn warning(buses: &[String], messages: impl IntoIterator<Item = (Id, usize)>) -> Option<Fault> {
    let mut first: HashMap<Id, usize> = HashMap::new();
    let others = messages.into_iter().filter(|(id, bus)| first.entry(*id).or_insert(*bus) != bus).count();
    (others > 0).then(|| Fault {
        line: 0,
        symbol: String::new(),
        kind: FaultKind::SeveralBuses { buses: buses.to_vec(), messages: others },
    })
}
