//! Prints the signals of a trace: `cargo run -p cantap-work --example decode_file FILE DATABASE`.

use std::error::Error;
use std::io::Write;
use std::path::Path;

use cantap_formats::{ReadOptions, open_reader};
use cantap_signals::{Decoder, Source};

/// Prints every signal; returns what of the file could not be read, empty if nothing.
pub fn decode(file: &Path, database: &Path, out: &mut impl Write) -> Result<String, Box<dyn Error>> {
    let database = cantap_signals::load(database)?;
    let decoder = Decoder::new(vec![Source { channel: None, database }]);
    let mut records = open_reader(file, &ReadOptions::default())?.readable();
    for record in records.by_ref() {
        for reading in decoder.readings(&record) {
            writeln!(out, "{:.6} {}: {reading}", record.time_ns as f64 / 1e9, reading.message.name)?;
        }
    }
    Ok(records.unread().to_string())
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args_os().skip(1);
    let (file, database) = (arguments.next(), arguments.next());
    let (Some(file), Some(database)) = (file, database) else { return Err("name a trace and a database".into()) };
    let unread = decode(file.as_ref(), database.as_ref(), &mut std::io::stdout())?;
    eprint!("{unread}");
    Ok(())
}
