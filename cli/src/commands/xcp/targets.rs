//! What to read, write or measure: a name in the description, or an address.

use cantap_protocols::Field;
use cantap_protocols::a2l::Description;
use cantap_protocols::calibration::ByteOrder;
use cantap_work::calibration::{MOST_READ, Sampled};

use crate::commands::uds::hex::{Hex, bytes};
use crate::usage_error::usage;

/// A part of the ECU's memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// As it was given.
    pub text: String,
    /// The names of the fields that are meant; for an address, the one of its bytes.
    pub columns: Vec<String>,
    /// The object's name in the description.
    object: Option<String>,
    /// The address extension.
    pub extension: u8,
    /// The address.
    pub address: u32,
    /// How many bytes.
    pub length: u32,
    /// How many bytes one value of it has.
    step: u32,
}

/// Most values of an array.
const MOST_VALUES: u32 = 4096;

/// An address with its extension: `20000000`, `1/20000000`.
fn address(text: &str) -> Option<(u8, u32)> {
    let (extension, address) = match text.split_once('/') {
        Some((extension, address)) => (u8::from_str_radix(extension, 16).ok()?, address),
        None => (0, text),
    };
    let digits = address.strip_prefix("0x").or_else(|| address.strip_prefix("0X")).unwrap_or(address);
    let is_hex = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
    Some((extension, u32::from_str_radix(digits, 16).ok().filter(|_| is_hex)?))
}

/// The column of an address's bytes, as data packets name it.
fn column(extension: u8, address: u32) -> String {
    if extension == 0 { format!("{address:08X}") } else { format!("{extension:02X}:{address:08X}") }
}

impl Target {
    /// Something to read.
    pub fn read(text: &str, description: Option<&Description>) -> anyhow::Result<Self> {
        if let Some(target) = Self::named(text, description)? {
            return Ok(target);
        }
        let (place, length) = text.split_once(':').unwrap_or((text, "1"));
        let length = length.parse().ok().filter(|length| (1..=MOST_READ).contains(length));
        match (address(place), length) {
            (Some((extension, address)), Some(length)) => {
                Ok(Self::of_address(text, extension, address, length))
            }
            (None, _) if description.is_some() => {
                Err(usage(format!("'{text}' is neither in --a2l nor an address, as 20000000:4")))
            }
            (None, _) => Err(usage(format!("'{text}' is no address, as 20000000:4; names need --a2l"))),
            (_, None) => Err(usage(format!("'{text}': write 1 to {MOST_READ} bytes behind the address"))),
        }
    }

    /// Something to write this value to.
    pub fn to_write(text: &str, value: &str, description: Option<&Description>) -> anyhow::Result<Self> {
        if let Some(target) = Self::named(text, description)? {
            let object = description.and_then(|one| one.object(text));
            if object.is_some_and(|object| !object.is_parameter) {
                return Err(usage(format!("{text} is not to be written, by --a2l")));
            }
            // A number that does not fit is found before anything is sent.
            target.bytes(value, description, Some(ByteOrder::Little))?;
            return Ok(target);
        }
        let Some((extension, address)) = address(text) else {
            return Err(usage(format!("'{text}' is neither in --a2l nor an address in hexadecimal")));
        };
        let Hex(data) = bytes(value).map_err(usage)?;
        Ok(Self::of_address(text, extension, address, data.len() as u32))
    }

    fn named(text: &str, description: Option<&Description>) -> anyhow::Result<Option<Self>> {
        let Some(object) = description.and_then(|one| one.object(text)) else { return Ok(None) };
        let is_array = object.count > 1 && !object.is_text;
        if object.size() as u64 > u64::from(MOST_READ) || (is_array && object.count > MOST_VALUES) {
            return Err(usage(format!(
                "{text} is too large to be read at once; read parts of it by address"
            )));
        }
        let columns = if is_array {
            (0..object.count).map(|element| format!("{}[{element}]", object.name)).collect()
        } else {
            vec![object.name.clone()]
        };
        let length = object.size() as u32;
        Ok(Some(Self {
            text: text.to_owned(),
            columns,
            object: Some(object.name.clone()),
            extension: object.extension,
            address: object.address,
            length,
            step: if is_array { object.data_type.size() as u32 } else { length },
        }))
    }

    fn of_address(text: &str, extension: u8, address: u32, length: u32) -> Self {
        Self {
            text: text.to_owned(),
            columns: vec![column(extension, address)],
            object: None,
            extension,
            address,
            length,
            step: length,
        }
    }

    /// The fields that are in these bytes, read from there: one for each of the columns.
    pub fn fields(
        &self,
        bytes: &[u8],
        description: Option<&Description>,
        order: Option<ByteOrder>,
    ) -> Vec<Option<Field>> {
        let object = self.object.as_ref().and_then(|name| description?.object(name));
        let Some(object) = object else {
            return vec![Some(Field::bytes(self.columns[0].clone(), bytes))];
        };
        let parts = bytes.chunks(self.step as usize).zip(0..);
        let fields = parts.map(|(bytes, element)| Some(object.field(element, bytes, order)));
        fields.take(self.columns.len()).collect()
    }

    /// The bytes for a value.
    pub fn bytes(
        &self,
        value: &str,
        description: Option<&Description>,
        order: Option<ByteOrder>,
    ) -> anyhow::Result<Vec<u8>> {
        let object = self.object.as_ref().and_then(|name| description?.object(name));
        match object {
            Some(object) => {
                object.bytes(value, order).map_err(|error| usage(format!("{}: {error}", self.text)))
            }
            None => bytes(value).map(|Hex(bytes)| bytes).map_err(usage),
        }
    }

    /// What of it is an entry of a list each.
    pub fn sampled(&self) -> Vec<Sampled> {
        let step = self.step.max(1);
        let count = self.length / step;
        let entries = (0..count).map(|element| Sampled {
            extension: self.extension,
            address: self.address.wrapping_add(element * step),
            size: step as usize,
        });
        entries.collect()
    }

    /// Whether it can be in a list.
    pub fn check_sampled(&self) -> anyhow::Result<()> {
        if self.step > 7 {
            return Err(usage(format!(
                "{} has {} bytes, and has no room in a frame; use poll",
                self.text, self.step
            )));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_have_a_length_and_perhaps_an_extension() {
        let read = |text: &str| {
            Target::read(text, None).map(|target| (target.extension, target.address, target.length)).ok()
        };
        assert_eq!(read("20000000:4"), Some((0, 0x2000_0000, 4)));
        assert_eq!(read("0x20000000"), Some((0, 0x2000_0000, 1)));
        assert_eq!(read("1/ABC:300"), Some((1, 0xABC, 300)));
        for wrong in ["EngineSpeed", "20000000:0", "20000000:x", "123456789", "+1", ""] {
            assert_eq!(read(wrong), None, "{wrong}");
        }
    }
}
