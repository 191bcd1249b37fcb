//! Parameter groups, failure modes and the parts of a NAME. The tables, with their sources, are in `data/j1939.csv`.

use crate::table::Table;

const FILE: &str = include_str!("../../data/j1939.csv");

static GROUPS: Table = Table::new(FILE, "group");
static FAILURE_MODES: Table = Table::new(FILE, "failure_mode");
static INDUSTRY_GROUPS: Table = Table::new(FILE, "industry_group");
static FUNCTIONS: Table = Table::new(FILE, "function");

/// A parameter group's name.
pub fn group(pgn: u32) -> Option<&'static str> {
    GROUPS.get(pgn)
}

/// A failure mode identifier (FMI).
pub fn failure_mode(fmi: u8) -> &'static str {
    FAILURE_MODES.get(fmi).unwrap_or("reserved")
}

/// The industry group in a NAME.
pub fn industry_group(group: u8) -> Option<&'static str> {
    INDUSTRY_GROUPS.get(group)
}

/// The function in a NAME, if it has the same meaning in every industry.
pub fn function(function: u8) -> Option<&'static str> {
    FUNCTIONS.get(function)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::check;

    #[test]
    fn every_line_of_the_file_is_in_a_table() {
        check(FILE, &[&GROUPS, &FAILURE_MODES, &INDUSTRY_GROUPS, &FUNCTIONS]);
        assert_eq!(group(0xF004), Some("EEC1 engine"));
        assert_eq!(group(0x1_EF00), Some("proprietary A2"));
    }
}
