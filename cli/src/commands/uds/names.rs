//! Identifiers by number or by the name that a description of the ECU (ODX) has for them.

use cantap_protocols::odx::{Ecu, NamedRequest};

use super::hex::word;
use crate::usage_error::usage;

/// An identifier.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Identifier {
    /// Its number.
    Number(u16),
    /// Its name.
    Name(String),
}

/// Up to four hexadecimal digits are a number; everything else is a name.
pub fn identifier(text: &str) -> Result<Identifier, String> {
    match word(text) {
        Ok(number) => Ok(Identifier::Number(number)),
        Err(error) if text.starts_with(|letter: char| letter.is_alphabetic() || letter == '_') => {
            // A number with a wrong digit is not meant as a name.
            let is_number = text.starts_with("0x") || text.starts_with("0X");
            if is_number { Err(error) } else { Ok(Identifier::Name(text.to_owned())) }
        }
        Err(error) => Err(format!("{error}, or a name of --odx")),
    }
}

/// The request that begins with these bytes and asks for this.
pub fn request(
    ecu: Option<&Ecu>,
    begins: &[u8],
    identifier: &Identifier,
    rest: &[u8],
) -> anyhow::Result<Vec<u8>> {
    let name = match identifier {
        Identifier::Number(number) => return Ok([begins, &number.to_be_bytes(), rest].concat()),
        Identifier::Name(name) => name,
    };
    let Some(ecu) = ecu else {
        return Err(usage(format!(
            "{name} is not an identifier: write up to four hexadecimal digits, as F190, or give the ECU's description with --odx"
        )));
    };
    let NamedRequest { bytes, open, .. } =
        ecu.request(name, begins).map_err(|error| usage(error.to_string()))?;
    match (open.is_empty(), rest.is_empty()) {
        (false, true) => Err(usage(format!(
            "{name} also needs {}; write the request in hexadecimal, as raw '{} …'",
            open.join(", "),
            bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
        ))),
        _ => Ok([&bytes, rest].concat()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_a_number_is_a_name() {
        assert_eq!(identifier("F190"), Ok(Identifier::Number(0xF190)));
        assert_eq!(
            identifier("Vehicle_Identification"),
            Ok(Identifier::Name("Vehicle_Identification".to_owned()))
        );
        for wrong in ["12345", "0xXYZ", "", "-1"] {
            assert!(identifier(wrong).is_err(), "{wrong}");
        }
        let error = request(None, &[0x22], &Identifier::Name("VIN".to_owned()), &[]).unwrap_err();
        assert!(error.to_string().contains("--odx"), "{error}");
    }
}
