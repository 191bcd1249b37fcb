//! What is in the ECU's memory: measured values and parameters.

use std::sync::Arc;

use half::f16;

use super::conversion::{Conversion, Meaning, Texts};
use super::data_type::{DataType, Dimension};
use super::record::{Record, Role};
use crate::calibration::parts::ByteOrder;
use crate::{Field, Value};

/// Which bits of a number are meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bits {
    /// Those that count.
    pub mask: u64,
    /// To the right afterwards; to the left if below zero.
    pub shift: i32,
    /// The highest bit of the mask is a sign.
    pub is_signed: bool,
}

/// How many values an object has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Shape {
    /// One number without dimensions, otherwise an array, the first index in the name first.
    Numbers(Vec<Dimension>),
    /// Text of so many bytes.
    Text(u32),
}

/// An axis of a curve or a map.
#[derive(Clone, Debug)]
pub enum Axis {
    /// Its points are computed, and the same always: as fields.
    Fixed(Vec<Field>),
    /// Its points are the object with this name.
    Stored(String),
    /// It is not known.
    Unknown,
}

/// How an object is part of a record whose axes have fewer points at times.
#[derive(Clone, Debug)]
pub struct PartOfRecord {
    pub(super) record: Arc<Record>,
    pub(super) role: Role,
    /// Where the record begins.
    pub(super) address: u32,
    /// The most points of each axis.
    pub(super) most: Vec<u32>,
    /// The names of the objects that say how many points each axis has.
    pub(super) numbers: Vec<Option<String>>,
}

/// A value in the memory.
#[derive(Clone, Debug)]
pub struct MemoryObject {
    /// Its name.
    pub name: String,
    /// What it is, in words.
    pub description: String,
    /// The address extension.
    pub extension: u8,
    /// The address, in the ECU's units.
    pub address: u32,
    /// Bytes beyond that address.
    pub offset: u32,
    /// How it is stored.
    pub data_type: DataType,
    /// The order of its bytes; `None` for the connection's.
    pub order: Option<ByteOrder>,
    /// Which bits of it are meant.
    pub bits: Option<Bits>,
    /// How the number becomes a value.
    pub conversion: Conversion,
    /// Texts for single numbers beside it, such as "sensor broken".
    pub status: Texts,
    /// The value's unit.
    pub unit: String,
    /// How many there are.
    pub shape: Shape,
    /// The axes of a curve or a map.
    pub axes: Vec<Axis>,
    /// The record that it is part of, if that may be shorter than the most.
    pub(super) part: Option<PartOfRecord>,
    /// A parameter, which may be written; otherwise a measured value.
    pub is_parameter: bool,
    /// The least and the greatest value.
    pub limits: (f64, f64),
}

/// Why a value cannot be written.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ValueError {
    /// The text is neither a number nor one of the object's texts.
    #[error("'{0}' is neither a number nor one of its texts")]
    NotAValue(String),
    /// It is beyond the limits.
    #[error("it has to be from {0} to {1}")]
    OutOfLimits(f64, f64),
    /// No number stands for it.
    #[error("no number in the memory stands for this value")]
    NoNumber,
    /// The type of the number has no room for it.
    #[error("the number has no room for this value")]
    NoRoom,
    /// Arrays as a whole, texts, and some bits of a number are not written.
    #[error("only single, whole numbers can be written by name; write bytes to its address instead")]
    NotSingle,
    /// The order of its bytes is not known.
    #[error("the order of its bytes is not known")]
    NoOrder,
}

impl MemoryObject {
    /// Whether it is text.
    pub const fn is_text(&self) -> bool {
        matches!(self.shape, Shape::Text(_))
    }

    /// How many numbers it has; 1 of a text.
    pub fn count(&self) -> u32 {
        match &self.shape {
            Shape::Numbers(dimensions) => {
                let counts = dimensions.iter().map(|dimension| dimension.count);
                counts.fold(1, u32::saturating_mul)
            }
            Shape::Text(_) => 1,
        }
    }

    /// Bytes of one of them; of a text, all of it.
    pub const fn element_size(&self) -> usize {
        match self.shape {
            Shape::Numbers(_) => self.data_type.size(),
            Shape::Text(length) => length as usize,
        }
    }

    /// Bytes from the first of them to the end of the last, whatever is between them.
    pub fn size(&self) -> usize {
        let Shape::Numbers(dimensions) = &self.shape else { return self.element_size() };
        dimensions.iter().fold(self.data_type.size(), |size, dimension| {
            let steps = dimension.count.saturating_sub(1) as usize;
            size.saturating_add(steps.saturating_mul(dimension.stride as usize))
        })
    }

    /// The indices of one of them: the last counts fastest.
    pub fn indices(&self, element: u32) -> Vec<u32> {
        let Shape::Numbers(dimensions) = &self.shape else { return Vec::new() };
        let mut left = element;
        let mut indices: Vec<_> = dimensions
            .iter()
            .rev()
            .map(|dimension| {
                let index = left % dimension.count.max(1);
                left /= dimension.count.max(1);
                index
            })
            .collect();
        indices.reverse();
        indices
    }

    /// Which of them has these indices.
    pub fn element(&self, indices: &[u32]) -> Option<u32> {
        let Shape::Numbers(dimensions) = &self.shape else { return None };
        if dimensions.len() != indices.len() || dimensions.is_empty() {
            return None;
        }
        dimensions.iter().zip(indices).try_fold(0_u32, |element, (dimension, index)| {
            (*index < dimension.count).then_some(())?;
            element.checked_mul(dimension.count)?.checked_add(*index)
        })
    }

    /// The name of one of them.
    pub fn element_name(&self, element: u32) -> String {
        let indices = self.indices(element).into_iter().map(|index| format!("[{index}]"));
        indices.fold(self.name.clone(), |name, index| name + &index)
    }

    /// Bytes from the first of them in the memory to this one.
    pub fn element_offset(&self, element: u32) -> u32 {
        let Shape::Numbers(dimensions) = &self.shape else { return 0 };
        let steps = dimensions.iter().zip(self.indices(element)).map(|(dimension, index)| {
            let index = if dimension.is_reversed { dimension.count - 1 - index } else { index };
            index.saturating_mul(dimension.stride)
        });
        steps.fold(0, u32::saturating_add)
    }

    /// The names of the objects that say how many points its axes have now, by axis: what it is depends on them.
    pub fn numbers(&self) -> &[Option<String>] {
        self.part.as_ref().map_or(&[], |part| &part.numbers)
    }

    /// The same, when its axes have so many points (`None` for the most).
    ///
    /// # Errors
    ///
    /// An axis has none, or more than it may have.
    pub fn with_points(&self, counts: &[Option<u32>]) -> Result<Self, &'static str> {
        let Some(part) = &self.part else { return Ok(self.clone()) };
        let now = counts.iter().zip(&part.most).map(|(count, most)| count.unwrap_or(*most));
        let now: Vec<_> = now.collect();
        if now.iter().zip(&part.most).any(|(now, most)| *now == 0 || now > most) {
            return Err("the ECU says that an axis of it has no points, or more than there is room for");
        }
        let place = part.record.place(part.role, &now, &part.most)?;
        let shape = Shape::Numbers(place.dimensions);
        Ok(Self { address: part.address, offset: place.offset, shape, part: None, ..self.clone() })
    }

    /// Whether the first of them is always at the same place, and those that follow too.
    pub(super) fn stays(&self) -> bool {
        let Some(part) = &self.part else { return true };
        let least: Vec<_> = part
            .numbers
            .iter()
            .zip(&part.most)
            .map(|(number, most)| number.as_ref().map_or(*most, |_| 1))
            .collect();
        let place = |counts: &[u32]| {
            let place = part.record.place(part.role, counts, &part.most).ok()?;
            let strides = place.dimensions.iter().map(|one| (one.stride, one.is_reversed && one.count > 1));
            Some((place.offset, strides.collect::<Vec<_>>()))
        };
        place(&least) == place(&part.most)
    }

    /// The number in these bytes.
    fn number(&self, bytes: &[u8], order: ByteOrder) -> Number {
        let raw = order.number(bytes);
        let wide = 64 - 8 * self.data_type.size() as u32;
        if let DataType::Float(size) = self.data_type {
            return Number::Real(match size {
                2 => f16::from_bits(raw as u16).to_f64(),
                4 => f32::from_bits(raw as u32).into(),
                _ => f64::from_bits(raw),
            });
        }
        let Some(bits) = self.bits else {
            return match self.data_type {
                DataType::Signed(_) => Number::Signed((raw << wide) as i64 >> wide),
                _ => Number::Unsigned(raw),
            };
        };
        let mut masked = raw & bits.mask;
        if bits.is_signed && bits.mask != 0 {
            let top = bits.mask.ilog2();
            if masked >> top & 1 == 1 {
                masked |= u64::MAX.checked_shl(top).unwrap_or(0);
            }
            let shifted = if bits.shift >= 0 {
                (masked as i64).checked_shr(bits.shift.unsigned_abs()).unwrap_or(0)
            } else {
                (masked as i64).checked_shl(bits.shift.unsigned_abs()).unwrap_or(0)
            };
            return Number::Signed(shifted);
        }
        let by = bits.shift.unsigned_abs();
        Number::Unsigned(
            if bits.shift >= 0 { masked.checked_shr(by) } else { masked.checked_shl(by) }.unwrap_or(0),
        )
    }

    /// The field for one of its values; the connection's order counts where it has none.
    pub fn field(&self, element: u32, bytes: &[u8], order: Option<ByteOrder>) -> Field {
        let name = self.element_name(element);
        if self.is_text() {
            let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
            let text: String = bytes[..end].iter().map(|byte| char::from(*byte)).collect();
            return Field::text(name, text);
        }
        let order = if bytes.len() == 1 { Some(ByteOrder::Little) } else { self.order.or(order) };
        let Some(order) = order else { return Field::bytes(name, bytes) };
        let number = self.number(bytes, order);
        let real = number.real();
        if let Some(text) = self.status.get(real) {
            return number.field(name).meaning(Some(text.to_owned()));
        }
        match self.conversion.meaning(real) {
            Meaning::Value(_) if self.conversion == Conversion::Identical => {
                number.field(name).unit(self.unit.clone())
            }
            Meaning::Value(value) => Field::real(name, value, self.unit.clone()),
            Meaning::Text(text) => number.field(name).meaning(Some(text.to_owned())),
            Meaning::Nothing if self.conversion == Conversion::Unknown => {
                number.field(name).meaning(Some("as stored; its conversion is not evaluated"))
            }
            Meaning::Nothing => number.field(name).meaning(Some("as stored; it stands for no value")),
        }
    }

    /// The bytes for one of its values, given as a number or one of its texts.
    ///
    /// # Errors
    ///
    /// It is no value of this object, or beyond its limits.
    pub fn bytes(&self, text: &str, order: Option<ByteOrder>) -> Result<Vec<u8>, ValueError> {
        if self.bits.is_some() || self.is_text() {
            return Err(ValueError::NotSingle);
        }
        let of_texts = match &self.conversion {
            Conversion::Texts(texts) => texts.number_of(text),
            _ => None,
        };
        let number = if let Some(number) = of_texts {
            number
        } else {
            let value: f64 = text.parse().map_err(|_| ValueError::NotAValue(text.to_owned()))?;
            let (least, most) = self.limits;
            // A description without limits has the same number twice.
            if least < most && !(least..=most).contains(&value) {
                return Err(ValueError::OutOfLimits(least, most));
            }
            match &self.conversion {
                Conversion::Texts(_) => value,
                conversion => conversion.number(value).ok_or(ValueError::NoNumber)?,
            }
        };
        let size = self.data_type.size();
        let order = if size == 1 { Some(ByteOrder::Little) } else { self.order.or(order) };
        let order = order.ok_or(ValueError::NoOrder)?;
        let whole = number.round();
        let raw = match self.data_type {
            DataType::Float(4) => u64::from((number as f32).to_bits()),
            DataType::Float(8) => number.to_bits(),
            DataType::Float(_) => return Err(ValueError::NotSingle),
            DataType::Unsigned(size) => {
                let bound = 2_f64.powi(8 * i32::from(size));
                if !(0.0..bound).contains(&whole) {
                    return Err(ValueError::NoRoom);
                }
                whole as u64
            }
            DataType::Signed(size) => {
                let bound = 2_f64.powi(8 * i32::from(size) - 1);
                if !(-bound..bound).contains(&whole) {
                    return Err(ValueError::NoRoom);
                }
                whole as i64 as u64
            }
        };
        Ok(order.bytes(raw, size))
    }
}

/// A number as it is stored.
#[derive(Clone, Copy, Debug)]
enum Number {
    Unsigned(u64),
    Signed(i64),
    Real(f64),
}

impl Number {
    const fn real(self) -> f64 {
        match self {
            Self::Unsigned(number) => number as f64,
            Self::Signed(number) => number as f64,
            Self::Real(number) => number,
        }
    }

    fn field(self, name: String) -> Field {
        match self {
            Self::Unsigned(number) => match i64::try_from(number) {
                Ok(number) => Field::number(name, number),
                Err(_) => Field::hex(name, number, 16),
            },
            Self::Signed(number) => Field::number(name, number),
            Self::Real(number) => {
                let mut field = Field::real(name, number, "");
                if !number.is_finite() {
                    field.value = Value::Missing;
                }
                field
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(data_type: DataType, conversion: Conversion) -> MemoryObject {
        MemoryObject {
            name: "N".to_owned(),
            description: String::new(),
            extension: 0,
            address: 0,
            offset: 0,
            data_type,
            order: None,
            bits: None,
            conversion,
            status: Texts::default(),
            unit: "rpm".to_owned(),
            shape: Shape::Numbers(Vec::new()),
            axes: Vec::new(),
            part: None,
            is_parameter: true,
            limits: (0.0, 8000.0),
        }
    }

    fn text(object: &MemoryObject, bytes: &[u8]) -> String {
        object.field(0, bytes, Some(ByteOrder::Little)).to_string()
    }

    #[test]
    fn numbers_become_values_with_units() {
        let speed = object(DataType::Unsigned(2), Conversion::Linear { factor: 0.25, offset: 0.0 });
        assert_eq!(text(&speed, &[0x10, 0x27]), "N 2500 rpm");
        assert_eq!(text(&object(DataType::Signed(1), Conversion::Identical), &[0xFE]), "N -2 rpm");
        assert_eq!(
            text(&object(DataType::Float(4), Conversion::Identical), &1.5_f32.to_le_bytes()),
            "N 1.5 rpm"
        );
        assert_eq!(text(&object(DataType::Float(2), Conversion::Identical), &[0x00, 0x3E]), "N 1.5 rpm");
        let order = MemoryObject { order: Some(ByteOrder::Big), ..speed };
        assert_eq!(text(&order, &[0x27, 0x10]), "N 2500 rpm");
    }

    #[test]
    fn some_bits_are_a_number_of_their_own() {
        let mut flag = object(DataType::Unsigned(1), Conversion::Identical);
        flag.bits = Some(Bits { mask: 0x70, shift: 4, is_signed: false });
        assert_eq!(text(&flag, &[0xAF]), "N 2 rpm");
        flag.bits = Some(Bits { mask: 0x70, shift: 4, is_signed: true });
        assert_eq!(text(&flag, &[0xFF]), "N -1 rpm");
    }

    #[test]
    fn values_become_bytes_within_limits_and_type() {
        let speed = object(DataType::Unsigned(2), Conversion::Linear { factor: 0.25, offset: 0.0 });
        let bytes = |value: &str| speed.bytes(value, Some(ByteOrder::Little));
        assert_eq!(bytes("2500"), Ok(vec![0x10, 0x27]));
        assert_eq!(bytes("9000"), Err(ValueError::OutOfLimits(0.0, 8000.0)));
        assert_eq!(bytes("fast"), Err(ValueError::NotAValue("fast".to_owned())));
        assert_eq!(speed.bytes("1", None), Err(ValueError::NoOrder));
        let narrow = object(DataType::Unsigned(1), Conversion::Identical);
        assert_eq!(narrow.bytes("256", None), Err(ValueError::NoRoom));
        let texts = Texts { ranges: vec![(2.0, 2.0, "on".to_owned())], default: None };
        assert_eq!(object(DataType::Unsigned(1), Conversion::Texts(texts)).bytes("ON", None), Ok(vec![2]));
    }
}
