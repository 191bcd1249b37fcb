//! Writes the definitions of data types in a folder as one text, as `data/dronecan.dsdl` and `data/cyphal.dsdl` are:
//!
//! ```text
//! cargo run -p cantap-protocols --example condense_dsdl -- FOLDER > data/dronecan.dsdl
//! ```
//!
//! The folder is that in which the outermost namespaces are.

use std::path::Path;

use cantap_protocols::dsdl::{Source, condensed};

fn main() -> std::io::Result<()> {
    let folder = std::env::args().nth(1).ok_or_else(|| std::io::Error::other("which folder?"))?;
    print!("{}", condensed(&Source::read_folder(Path::new(&folder))?));
    Ok(())
}
