//! Writes the definitions of data types in a folder as one text, as `host/protocols/data/dronecan.dsdl` and `cyphal.dsdl` there are:
//!
//! ```text
//! cargo run -p cantap-work --example condense_dsdl -- FOLDER > host/protocols/data/dronecan.dsdl
//! ```
//!
//! The folder is that in which the outermost namespaces are.

use std::path::Path;

use cantap_protocols::dsdl::condensed;
use cantap_work::dsdl::read_folder;

fn main() -> std::io::Result<()> {
    let folder = std::env::args().nth(1).ok_or_else(|| std::io::Error::other("which folder?"))?;
    print!("{}", condensed(&read_folder(Path::new(&folder))?));
    Ok(())
}
