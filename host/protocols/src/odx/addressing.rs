//! Which identifiers an ECU has on CAN: the communication parameters of ISO 15765-2 (ISO 22900-2, annex B).

use std::collections::BTreeMap;

use cantap_trace::Id;

use super::layer::View;
use super::model::{Model, Name};
use super::xml::integer;
use crate::iso_tp::{Endpoint, Pair};

/// The parts of `CP_UniqueRespIdTable` in their order, for files without their definition.
const PARTS: [&str; 9] = [
    "CP_CanPhysReqFormat",
    "CP_CanPhysReqId",
    "CP_CanPhysReqExtAddr",
    "CP_CanRespUSDTFormat",
    "CP_CanRespUSDTId",
    "CP_CanRespUSDTExtAddr",
    "CP_CanRespUUDTFormat",
    "CP_CanRespUUDTId",
    "CP_CanRespUUDTExtAddr",
];
const TABLE: &str = "CP_UniqueRespIdTable";

/// Pairs of identifiers, in order.
pub fn pairs(model: &Model, view: &View) -> Vec<Pair> {
    let mut by_protocol: BTreeMap<Option<Name>, BTreeMap<&str, &str>> = BTreeMap::new();
    let mut pairs = Vec::new();
    for ((name, protocol), values) in &view.comparams {
        if let (Some(part), Some(value)) = (PARTS.iter().find(|part| ***part == **name), values.first()) {
            let parts = by_protocol.entry(protocol.clone()).or_default();
            parts.extend(value.first().map(|value| (*part, &**value)));
        }
    }
    for ((name, protocol), values) in &view.comparams {
        if &**name != TABLE {
            continue;
        }
        let names = model.complex.iter().find(|(number, _)| &*model.names[**number as usize] == TABLE);
        for row in values {
            // What a row leaves out may stand beside it.
            let mut parts = by_protocol.get(protocol).cloned().unwrap_or_default();
            match names {
                Some((_, names)) => {
                    parts.extend(names.iter().zip(row).map(|(name, value)| (&**name, &**value)));
                }
                None => parts.extend(PARTS.into_iter().zip(row.iter().map(|value| &**value))),
            }
            pairs.extend(pair(&parts));
        }
    }
    if pairs.is_empty() {
        pairs.extend(by_protocol.values().filter_map(pair));
    }
    pairs.sort_by_key(|pair| (pair.a.id.raw(), pair.a.address, pair.b.id.raw()));
    pairs.dedup();
    pairs
}

fn pair(parts: &BTreeMap<&str, &str>) -> Option<Pair> {
    let endpoint = |id: &str, format: &str, address: &str| {
        let raw = u32::try_from(integer(parts.get(id)?)?).ok()?;
        let format = parts.get(format).copied().unwrap_or_default();
        let is_extended = format.contains("29-bit") || raw > 0x7FF;
        let id = if is_extended { Id::extended(raw) } else { Id::standard(raw) }?;
        // Extended addressing: the first data byte is an address.
        let address = format.starts_with("extended").then(|| parts.get(address)).flatten();
        let address =
            address.and_then(|address| integer(address)).and_then(|address| u8::try_from(address).ok());
        Some(Endpoint { id, address })
    };
    let a = endpoint(PARTS[1], PARTS[0], PARTS[2])?;
    let b = endpoint(PARTS[4], PARTS[3], PARTS[5])?;
    (a != b).then_some(Pair { a, b })
}
