//! What the values of OBD-II's parameters stand for, where they are not numbers.

/// Fuel system status (parameter 03), one bit each; from 20 on in newer cars only.
const FUEL_SYSTEM: [(u8, &str); 9] = [
    (0x00, "off or not there"),
    (0x01, "open loop, not warm enough"),
    (0x02, "closed loop"),
    (0x04, "open loop by load or deceleration"),
    (0x08, "open loop by a failure"),
    (0x10, "closed loop with a fault"),
    (0x20, "open loop, not warm enough, bank 2"),
    (0x40, "open loop by load or deceleration, bank 2"),
    (0x80, "open loop by a failure, bank 2"),
];

/// Where secondary air goes (parameter 12), one bit each.
const SECONDARY_AIR: [(u8, &str); 4] = [
    (0x01, "upstream of the catalyst"),
    (0x02, "downstream of the catalyst"),
    (0x04, "to the atmosphere or off"),
    (0x08, "on for diagnostics"),
];

/// Parameter 5F.
const EMISSION_REQUIREMENTS: [(u8, &str); 4] =
    [(0x0E, "Euro IV B1"), (0x0F, "Euro V B2"), (0x10, "Euro EEV C"), (0x11, "Euro VI")];

/// Parameter 51: up to 23 as in Wireshark, the others as in OBDb/SAEJ1979.
const FUELS: [&str; 33] = [
    "not available",
    "petrol",
    "methanol",
    "ethanol",
    "diesel",
    "LPG",
    "CNG",
    "propane",
    "electric",
    "bifuel running petrol",
    "bifuel running methanol",
    "bifuel running ethanol",
    "bifuel running LPG",
    "bifuel running CNG",
    "bifuel running propane",
    "bifuel running electricity",
    "bifuel running electric and combustion engine",
    "hybrid petrol",
    "hybrid ethanol",
    "hybrid diesel",
    "hybrid electric",
    "hybrid running electric and combustion engine",
    "hybrid regenerative",
    "bifuel running diesel",
    "bifuel running natural gas",
    "bifuel running diesel",
    "natural gas",
    "dual fuel diesel and CNG",
    "dual fuel diesel and LNG",
    "hydrogen fuel cell",
    "hydrogen combustion engine",
    "kerosene",
    "heavy fuel oil",
];

/// Parameter 1C: as in Wireshark, and where it has nothing, as in OBDb/SAEJ1979. 33 is "HD EOBD-IV" in Wireshark, but
/// stands for Euro VI.
const STANDARDS: [&str; 60] = [
    "",
    "OBD II (CARB)",
    "OBD (EPA)",
    "OBD and OBD II",
    "OBD I",
    "not OBD compliant",
    "EOBD",
    "EOBD and OBD II",
    "EOBD and OBD",
    "EOBD, OBD and OBD II",
    "JOBD",
    "JOBD and OBD II",
    "JOBD and EOBD",
    "JOBD, EOBD and OBD II",
    "Euro IV B1",
    "Euro V B2",
    "Euro EEV C",
    "EMD: engine manufacturer diagnostics",
    "EMD+: engine manufacturer diagnostics, enhanced",
    "HD OBD-C: heavy duty, partial",
    "HD OBD: heavy duty",
    "WWH OBD: worldwide harmonized",
    "",
    "HD EOBD-I: heavy duty, without NOx control",
    "HD EOBD-I N: heavy duty, with NOx control",
    "HD EOBD-II: heavy duty, without NOx control",
    "HD EOBD-II N: heavy duty, with NOx control",
    "HD ZEV: heavy duty, zero emissions",
    "OBDBr-1: Brazil, phase 1",
    "OBDBr-2: Brazil, phase 2",
    "KOBD: Korea",
    "IOBD I: India, BS4",
    "IOBD II: India, BS4",
    "HD EOBD-VI: heavy duty, Euro VI",
    "OBD, OBD II and HD OBD",
    "OBDBr-3: Brazil, phase 3",
    "MC EOBD-I: motorcycle, Europe",
    "MC EOBD-II: motorcycle, Europe",
    "MC COBD-I: motorcycle, China",
    "MC TOBD-I: motorcycle, Taiwan",
    "MC JOBD-I: motorcycle, Japan",
    "CN-OBD-6: China, stage 6",
    "OBDBr-P7: Brazil, phase 7",
    "CN-HDOBD-VI: China, heavy duty",
    "IOBD I: India, BS6",
    "IOBD II: India, BS6",
    "IHDOBD: India, BSVI, heavy duty",
    "OBDBr-P8: Brazil, phase 8",
    "HD JOBD-II: Japan, heavy duty",
    "HD KOBD-II: Korea, heavy duty",
    "CN-OROBD-IV: China, off-road",
    "CARB ACC-II: zero emissions",
    "MC JOBD-II: motorcycle, Japan",
    "MC OBD: motorcycle, CARB",
    "MC OBD: motorcycle, EPA",
    "MC OBD: motorcycle, CARB and EPA",
    "CARB ZEP: heavy duty, zero emissions",
    "CARB ACC-II and EPA Tier 4: zero emissions",
    "EPA Tier 4: zero emissions",
    "EPA HD OBD: heavy duty",
];

/// What a value of the parameter stands for.
pub fn of(pid: u8, raw: u64) -> Option<&'static str> {
    let raw = u8::try_from(raw).ok()?;
    let listed =
        |texts: &[&'static str]| texts.get(usize::from(raw)).copied().filter(|text| !text.is_empty());
    let table: &[(u8, &str)] = match pid {
        0x03 => &FUEL_SYSTEM,
        0x12 => &SECONDARY_AIR,
        0x1C => return listed(&STANDARDS),
        0x51 => return listed(&FUELS),
        0x5F => &EMISSION_REQUIREMENTS,
        _ => return None,
    };
    table.iter().find(|(known, _)| *known == raw).map(|(_, text)| *text)
}
