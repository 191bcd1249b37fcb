//! Definitions of data types of both languages.

#![no_main]

use cantap_protocols::dsdl::{DataTypes, DsdlSource};

libfuzzer_sys::fuzz_target!(|texts: (String, String)| {
    let own = [("own/5.A.uavcan", texts.0), ("own/5.A.1.0.dsdl", texts.1)];
    let _ = DataTypes::with(&own.map(|(path, text)| DsdlSource { path: path.to_owned(), text }));
});
