//! What to read, write or measure: a name in the description, or an address.

use anyhow::ensure;
use cantap_protocols::Field;
use cantap_protocols::a2l::{Axis, Description, MemoryObject, ValueError};
use cantap_protocols::calibration::ByteOrder;
use cantap_signals::Suggestion;
use cantap_work::calibration::{MOST_READ, Master, Sampled};

use crate::commands::uds::hex::{Hex, bytes};
use crate::usage_error::usage;

/// A part of the ECU's memory.
#[derive(Clone, Debug)]
pub struct Target {
    /// As it was given.
    pub text: String,
    /// The names of the fields that are meant; for an address, the one of its bytes.
    pub columns: Vec<String>,
    /// What it is in the description, and which of its values is meant if not all are.
    object: Option<(MemoryObject, Option<u32>)>,
    /// Bytes of an address unit.
    unit: u32,
    /// The address extension.
    pub extension: u8,
    /// The address, in the ECU's units.
    pub address: u32,
    /// How many bytes.
    pub length: u32,
    /// Where each value is among them.
    places: Vec<u32>,
    /// How many bytes one value has.
    step: u32,
}

/// Most bytes of one value in a list.
const MOST_SAMPLED: u32 = 7;

/// An error about a name that is not in the description: what there is instead.
fn unknown(text: &str, description: &Description) -> anyhow::Error {
    let names = || description.objects().iter().map(|object| object.name.as_str());
    let without_index = text.split('[').next().unwrap_or(text);
    if let Some(object) = description.object(without_index).filter(|_| without_index != text) {
        let last = object.element_name(object.count().saturating_sub(1));
        return usage(format!("'{text}': the last of {} is {last}", object.name));
    }
    let members: Vec<_> = names()
        .filter(|name| name.strip_prefix(text).is_some_and(|rest| rest.starts_with(['.', '['])))
        .take(MOST_MEMBERS + 1)
        .collect();
    if !members.is_empty() {
        let more = if members.len() > MOST_MEMBERS { ", …" } else { "" };
        let members = members[..members.len().min(MOST_MEMBERS)].join(", ");
        return usage(format!("'{text}' is a structure; it has {members}{more}"));
    }
    let near = Suggestion::nearest(text, names());
    usage(format!("'{text}' is neither in --a2l nor an address, as 20000000:4{near}"))
}

/// How many members of a structure an error names.
const MOST_MEMBERS: usize = 5;
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
            (None, _) => Err(match description {
                Some(description) => unknown(text, description),
                None => usage(format!("'{text}' is no address, as 20000000:4; names need --a2l")),
            }),
            (_, None) => Err(usage(format!("'{text}': write 1 to {MOST_READ} bytes behind the address"))),
        }
    }

    /// Something to write this value to.
    pub fn to_write(text: &str, value: &str, description: Option<&Description>) -> anyhow::Result<Self> {
        if let Some(target) = Self::named(text, description)? {
            if target.object.as_ref().is_some_and(|(object, _)| !object.is_parameter) {
                return Err(usage(format!("{text} is not to be written, by --a2l")));
            }
            // A number that does not fit is found before anything is sent.
            target.bytes(value, Some(ByteOrder::Little))?;
            return Ok(target);
        }
        let Some((extension, address)) = address(text) else {
            return Err(match description {
                Some(description) => unknown(text, description),
                None => usage(format!("'{text}' is no address in hexadecimal; names need --a2l")),
            });
        };
        let Hex(data) = bytes(value).map_err(usage)?;
        Ok(Self::of_address(text, extension, address, data.len() as u32))
    }

    fn named(text: &str, description: Option<&Description>) -> anyhow::Result<Option<Self>> {
        let Some(description) = description else { return Ok(None) };
        let Some((object, element)) = description.element(text) else { return Ok(None) };
        let mut target = Self::of_address(text, 0, 0, 1);
        target.unit = description.granularity().into();
        target.point_to(object.clone(), element)?;
        Ok(Some(target))
    }

    /// Makes it this object, or one of its values.
    fn point_to(&mut self, object: MemoryObject, element: Option<u32>) -> anyhow::Result<()> {
        let size = object.element_size() as u32;
        let from = element.map_or(0, |element| object.element_offset(element)) + object.offset;
        let length = element.map_or(object.size(), |_| size as usize);
        // Memory is read in whole units.
        let inner = from % self.unit;
        let whole = (length as u64 + u64::from(inner)).next_multiple_of(self.unit.into());
        if whole > u64::from(MOST_READ) || (element.is_none() && object.count() > MOST_VALUES) {
            return Err(usage(format!(
                "{} is too large to be read at once; read parts of it by address",
                self.text
            )));
        }
        let elements = element.map_or(0..object.count(), |element| element..element + 1);
        let place = |at: u32| if element.is_some() { inner } else { inner + object.element_offset(at) };
        self.places = elements.clone().map(place).collect();
        self.columns = elements.map(|at| object.element_name(at)).collect();
        self.extension = object.extension;
        self.address = object.address.wrapping_add(from / self.unit);
        self.length = whole as u32;
        self.step = size;
        self.object = Some((object, element));
        Ok(())
    }

    /// Asks the ECU how many points its axes have now, where that can change; what it is depends on it.
    pub fn settle(
        &mut self,
        description: Option<&Description>,
        master: &mut Master<'_>,
    ) -> anyhow::Result<()> {
        let Some((object, element)) = self.object.clone() else { return Ok(()) };
        ensure!(
            master.granularity() == self.unit as usize,
            "the ECU counts addresses in units of {}, --a2l in units of {} bytes",
            master.granularity(),
            self.unit
        );
        let mut counts = Vec::new();
        for number in object.numbers() {
            let Some(number) = number else {
                counts.push(None);
                continue;
            };
            let asked = Self::read(number, description)?;
            let bytes = master.read(asked.extension, asked.address, asked.length)?;
            let field = asked.fields(&bytes, master.order()).into_iter().next().flatten();
            let count = field.and_then(|field| field.value.as_number());
            counts.push(Some(count.map_or(0, |count| count as u32)));
        }
        if counts.is_empty() {
            return Ok(());
        }
        let indices = element.map(|element| object.indices(element));
        let now = object.with_points(&counts).map_err(|why| anyhow::anyhow!("{}: {why}", self.text))?;
        let element = match indices {
            Some(indices) => {
                let element = now.element(&indices);
                ensure!(element.is_some(), "{}: the ECU has fewer points now", self.text);
                element
            }
            None => None,
        };
        self.point_to(now, element)
    }

    /// The axes of a curve or a map as a whole: points that are the same always, and what is to be read for the others.
    pub fn axes(&self, description: Option<&Description>) -> (Vec<Field>, Vec<Self>) {
        let (mut fixed, mut stored) = (Vec::new(), Vec::new());
        let Some((object, None)) = &self.object else { return (fixed, stored) };
        for axis in &object.axes {
            match axis {
                Axis::Fixed(fields) => fixed.extend(fields.iter().cloned()),
                Axis::Stored(name) => stored.extend(Self::named(name, description).ok().flatten()),
                Axis::Unknown => {}
            }
        }
        (fixed, stored)
    }

    fn of_address(text: &str, extension: u8, address: u32, length: u32) -> Self {
        Self {
            text: text.to_owned(),
            columns: vec![column(extension, address)],
            object: None,
            unit: 1,
            extension,
            address,
            length,
            places: vec![0],
            step: length,
        }
    }

    /// The fields that are in these bytes, read from there: one for each of the columns.
    pub fn fields(&self, bytes: &[u8], order: Option<ByteOrder>) -> Vec<Option<Field>> {
        if self.object.is_none() {
            return vec![Some(Field::bytes(self.columns[0].clone(), bytes))];
        }
        let part = |place: u32| bytes.get(place as usize..place as usize + self.step as usize);
        let places = self.places.iter().zip(0..);
        places.map(|(place, at)| self.field(at, part(*place)?, order)).collect()
    }

    /// The field of one of its values.
    pub fn field(&self, at: u32, bytes: &[u8], order: Option<ByteOrder>) -> Option<Field> {
        let (object, element) = self.object.as_ref()?;
        let is_whole = bytes.len() == self.step as usize;
        is_whole.then(|| object.field(element.unwrap_or(at), bytes, order))
    }

    /// Its values by the names that their bytes have where a listener knows only the address.
    pub fn by_address(&self) -> Vec<(String, (&Self, u32))> {
        let sampled = self.sampled().into_iter().zip(0..);
        sampled
            .map(|(Sampled { extension, address, .. }, at)| (column(extension, address), (self, at)))
            .collect()
    }

    /// The bytes for a value.
    pub fn bytes(&self, value: &str, order: Option<ByteOrder>) -> anyhow::Result<Vec<u8>> {
        match &self.object {
            Some((object, _)) => {
                let is_single = self.places.len() == 1 && self.length == self.step;
                let bytes = if is_single { object.bytes(value, order) } else { Err(ValueError::NotSingle) };
                bytes.map_err(|error| usage(format!("{}: {error}", self.text)))
            }
            None => bytes(value).map(|Hex(bytes)| bytes).map_err(usage),
        }
    }

    /// What of it is an entry of a list each.
    pub fn sampled(&self) -> Vec<Sampled> {
        let entries = self.places.iter().map(|place| Sampled {
            extension: self.extension,
            address: self.address.wrapping_add(place / self.unit),
            size: self.step as usize,
        });
        entries.collect()
    }

    /// Whether it can be in a list.
    pub fn check_sampled(&self) -> anyhow::Result<()> {
        let is_whole = |bytes: &u32| bytes.is_multiple_of(self.unit);
        if !is_whole(&self.step) || !self.places.iter().all(is_whole) {
            return Err(usage(format!(
                "{} is less than one of the ECU's address units of {} bytes; use poll",
                self.text, self.unit
            )));
        }
        if self.step > MOST_SAMPLED {
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
