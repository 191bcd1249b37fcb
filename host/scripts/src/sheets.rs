//! The electronic data sheets of ready nodes.

const SHEETS: [(&str, &str); 1] = [("drive", include_str!("../nodes/drive.eds"))];

/// The sheet of the ready node with this name, an EDS file.
pub fn sheet(name: &str) -> Option<&'static str> {
    SHEETS.into_iter().find(|(of, _)| *of == name).map(|(_, text)| text)
}

/// The nodes that have one.
pub fn names() -> String {
    SHEETS.map(|(name, _)| name).join(", ")
}
