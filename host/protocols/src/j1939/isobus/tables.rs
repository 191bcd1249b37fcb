//! The file of the tables.

/// `data/isobus.csv`.
pub const FILE: &str = include_str!("../../../data/isobus.csv");
