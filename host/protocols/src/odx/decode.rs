//! A message's bytes as values, by its parameters.

mod lengths;
mod tables;

use std::fmt::Write as _;

use super::coded::Stop;
use super::compu::{Compu, Physical, is_between};
use super::layer::View;
use super::model::{
    BaseType, Case, Coded, Data, DopKind, Internal, Item, Length, Link, Model, Mux, Name, Param, ParamKind,
    Place,
};
use super::xml;

/// Structures in structures.
const DEEPEST: usize = 16;
/// Values of a message: a field of one bit each would be no more in the longest one that is kept.
const MOST_VALUES: usize = 32_768;
/// Parameters of a message, with those in its structures: those without a value would be no fewer the deeper they are in each other.
const MOST_PARAMS: usize = 4 * MOST_VALUES;

/// A value of a message.
#[derive(Clone, Debug, PartialEq)]
pub struct Decoded {
    /// The parameter, with those that contain it in front: `status.list[0].code`.
    pub path: String,
    /// Its value.
    pub value: Physical,
    /// The unit; empty without one.
    pub unit: Name,
    /// What is to be said about the value.
    pub note: Option<String>,
    /// It is usually written in hexadecimal, with so many digits.
    pub hex_digits: Option<u8>,
    /// It says which message this is, and is the same in each.
    pub is_constant: bool,
}

/// What the bytes of a message come to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reading {
    /// In order.
    pub values: Vec<Decoded>,
    /// Bytes that no parameter describes.
    pub undescribed: Vec<u8>,
    /// Where it was given up, and why.
    pub stop: Option<(String, Stop)>,
}

impl Reading {
    /// Whether it is another message.
    pub fn differs(&self) -> bool {
        matches!(self.stop, Some((_, Stop::Differs)))
    }

    /// The lower, the better the message fits.
    pub fn misfit(&self) -> u8 {
        match (&self.stop, self.undescribed.is_empty()) {
            (None, true) => 0,
            (None, false) => 1,
            (Some((_, Stop::NotEvaluated(_))), _) => 2,
            (Some((_, Stop::Ends)), _) => 3,
            (Some((_, Stop::Differs)), _) => 4,
        }
    }
}

/// Reads a message by its parameters.
pub fn read(model: &Model, view: &View, params: &[Param], data: &[u8], request: Option<&[u8]>) -> Reading {
    let mut reader = Reader {
        model,
        view,
        data,
        request,
        values: Vec::new(),
        covered: vec![false; data.len()],
        origin: 0,
        cursor: 0,
        keys: Vec::new(),
        path: String::new(),
        depth: 0,
        left: MOST_VALUES,
        params_left: MOST_PARAMS,
    };
    let stop = reader.params(params).err();
    let stop = stop.map(|stop| (std::mem::take(&mut reader.path), stop));
    let undescribed =
        data.iter().zip(&reader.covered).filter(|(_, covered)| !**covered).map(|(byte, _)| *byte);
    Reading { undescribed: undescribed.collect(), values: reader.values, stop }
}

/// What a parameter said for those behind it.
#[derive(Clone, Copy)]
enum Key {
    Bits(u64),
    Row(u32, u32),
}

struct Reader<'a> {
    model: &'a Model,
    view: &'a View,
    data: &'a [u8],
    request: Option<&'a [u8]>,
    values: Vec<Decoded>,
    covered: Vec<bool>,
    /// Where the structure begins.
    origin: usize,
    cursor: usize,
    keys: Vec<(Name, Key)>,
    /// Stays where it was if reading stops.
    path: String,
    depth: usize,
    left: usize,
    params_left: usize,
}

impl<'a> Reader<'a> {
    fn params(&mut self, params: &'a [Param]) -> Result<(), Stop> {
        let before = std::mem::replace(&mut self.origin, self.cursor);
        for param in params {
            self.params_left = self
                .params_left
                .checked_sub(1)
                .ok_or_else(|| Stop::not_evaluated("more parameters than are read"))?;
            let length = self.path.len();
            if length > 0 {
                self.path.push('.');
            }
            self.path.push_str(&param.name);
            if let Some(byte) = param.byte {
                self.cursor = self.origin.saturating_add(byte as usize);
            }
            self.param(param)?;
            self.path.truncate(length);
        }
        self.origin = before;
        Ok(())
    }

    fn param(&mut self, param: &'a Param) -> Result<(), Stop> {
        match &param.kind {
            ParamKind::Constant { coded, value } => {
                let found = self.internal(coded, param.bit)?;
                if !same(coded, &found, value) {
                    return Err(Stop::Differs);
                }
                self.constant(found)
            }
            ParamKind::OneOf { coded, values } => {
                let found = self.internal(coded, param.bit)?;
                if !values.iter().any(|value| same(coded, &found, value)) {
                    return Err(Stop::Differs);
                }
                self.constant(found)
            }
            ParamKind::Physical { dop, value } => {
                let before = self.values.len();
                self.dop(*dop, param.bit)?;
                match &mut self.values[before..] {
                    [one] if one.note.is_none() && is_written(&one.value, value) => {
                        one.is_constant = true;
                        Ok(())
                    }
                    _ => Err(Stop::Differs),
                }
            }
            ParamKind::Value { dop } => self.dop(*dop, param.bit),
            ParamKind::Length { dop } => {
                let before = self.values.len();
                self.dop(*dop, param.bit)?;
                let bits = self.count_since(before)?;
                self.keys.push((param.name.clone(), Key::Bits(bits)));
                Ok(())
            }
            ParamKind::FromRequest { byte, length } => self.repeated(*byte, *length),
            ParamKind::Reserved { bits } => {
                let length = (param.bit as usize).saturating_add(*bits as usize).div_ceil(8);
                self.cover(length)
            }
            ParamKind::TableKey { table } => self.table_key(param, *table),
            ParamKind::TableStruct { key } => self.table_struct(key),
            ParamKind::NotEvaluated(what) => Err(Stop::not_evaluated(&**what)),
        }
    }

    fn cover(&mut self, length: usize) -> Result<(), Stop> {
        let end = self.cursor.checked_add(length).ok_or(Stop::Ends)?;
        self.covered.get_mut(self.cursor..end).ok_or(Stop::Ends)?.fill(true);
        self.cursor = end;
        Ok(())
    }

    fn push(&mut self, value: Physical, hex_digits: Option<u8>) -> Result<&mut Decoded, Stop> {
        self.left =
            self.left.checked_sub(1).ok_or_else(|| Stop::not_evaluated("more values than are kept"))?;
        let path = self.path.clone();
        let (unit, note, is_constant) = ("".into(), None, false);
        self.values.push(Decoded { path, value, unit, note, hex_digits, is_constant });
        self.values.last_mut().ok_or(Stop::Ends)
    }

    fn constant(&mut self, value: Internal) -> Result<(), Stop> {
        self.push(plain(value), None)?.is_constant = true;
        Ok(())
    }

    /// The last values, if that is one integer that can be a count.
    fn count_since(&self, before: usize) -> Result<u64, Stop> {
        match &self.values[before..] {
            [Decoded { value: Physical::Int(count), .. }] => {
                u64::try_from(*count).map_err(|_| Stop::not_evaluated("a length below zero"))
            }
            _ => Err(Stop::not_evaluated("a length that is no number")),
        }
    }

    /// Bytes as they were in the request. A negative position counts from its end.
    fn repeated(&mut self, byte: i64, length: u32) -> Result<(), Stop> {
        let (from, length) = (self.cursor, length as usize);
        self.cover(length)?;
        let found = &self.data[from..from + length];
        if let Some(request) = self.request {
            let from = match usize::try_from(byte) {
                Ok(from) => Some(from),
                Err(_) => usize::try_from(-byte).ok().and_then(|back| request.len().checked_sub(back)),
            };
            let asked = from.and_then(|from| request.get(from..from.checked_add(length)?));
            // Inside a structure it may be that of an earlier request.
            if self.depth == 0 && asked.is_some_and(|asked| asked != found) {
                return Err(Stop::Differs);
            }
        }
        let value = match found.len() {
            0..=8 => Physical::Int(found.iter().fold(0, |number, byte| number << 8 | i128::from(*byte))),
            _ => Physical::Bytes(found.to_vec()),
        };
        self.push(value, None)?.is_constant = true;
        Ok(())
    }

    fn dop(&mut self, link: Link, bit: u32) -> Result<(), Stop> {
        let model = self.model;
        let dop = model
            .dop(self.view, link)
            .ok_or_else(|| Stop::not_evaluated("a type that is not in the file"))?;
        if self.depth == DEEPEST {
            return Err(Stop::not_evaluated("structures that contain themselves"));
        }
        self.depth += 1;
        match &model.dops[dop as usize].kind {
            DopKind::Data(data) => self.simple(data, bit)?,
            DopKind::Dtcs(dtcs) => {
                let internal = self.internal(&dtcs.coded, bit)?;
                let code = dtcs.compu.convert(internal, BaseType::Uint);
                let Ok(Physical::Int(code)) = code else {
                    return Err(Stop::not_evaluated("a trouble code that is no number"));
                };
                let known = u32::try_from(code).ok().and_then(|code| model.dtc_of(dop, code));
                let value = match known {
                    Some(dtc) => Physical::Meaning(Internal::Int(code), dtc.description()),
                    None => Physical::Int(code),
                };
                self.push(value, Some(6))?;
            }
            DopKind::Structure { params, byte_size } => {
                let from = self.cursor;
                self.params(params)?;
                if let Some(size) = byte_size {
                    if self.cursor.saturating_sub(from) > *size as usize {
                        return Err(Stop::not_evaluated("a structure longer than its BYTE-SIZE"));
                    }
                    self.pad_to(from, *size as usize)?;
                }
            }
            DopKind::ToEnd { item } => {
                let mut at = 0;
                while self.cursor < self.data.len() {
                    self.item(*item, at)?;
                    at += 1;
                }
            }
            DopKind::Static { item, count, item_bytes } => {
                for at in 0..*count as usize {
                    let from = self.cursor;
                    self.item(*item, at)?;
                    if self.cursor - from > *item_bytes as usize {
                        return Err(Stop::not_evaluated("an item longer than its ITEM-BYTE-SIZE"));
                    }
                    self.pad_to(from, *item_bytes as usize)?;
                }
            }
            DopKind::Counted { item, offset, count } => {
                let from = self.cursor;
                let count = self.at(from, *count)?;
                let count = usize::try_from(count).map_err(|_| Stop::Ends)?;
                self.cursor = from.saturating_add(*offset as usize);
                for at in 0..count {
                    self.item(*item, at)?;
                }
            }
            DopKind::Marked { item, end, value } => self.marked(*item, *end, value)?,
            DopKind::Mux(mux) => self.mux(mux)?,
            DopKind::NotEvaluated(what) => return Err(Stop::not_evaluated(&**what)),
        }
        self.depth -= 1;
        Ok(())
    }

    /// Goes on where something of this size ends, whose last bytes have no meaning.
    fn pad_to(&mut self, from: usize, size: usize) -> Result<(), Stop> {
        let length = (from + size).saturating_sub(self.cursor);
        self.cover(length)
    }

    fn item(&mut self, item: Link, at: usize) -> Result<(), Stop> {
        let (length, from) = (self.path.len(), self.cursor);
        // Writing to a String cannot fail.
        let _ = write!(self.path, "[{at}]");
        self.dop(item, 0)?;
        if self.cursor <= from {
            return Err(Stop::not_evaluated("items without a length"));
        }
        self.path.truncate(length);
        Ok(())
    }

    /// The number at a place, of which only what follows from it is shown.
    fn at(&mut self, from: usize, place: Place) -> Result<u64, Stop> {
        self.cursor = from.saturating_add(place.byte as usize);
        let before = self.values.len();
        self.dop(place.dop, place.bit)?;
        let count = match &self.values[before..] {
            [Decoded { value: Physical::Meaning(Internal::Int(count), _), .. }] => u64::try_from(*count).ok(),
            _ => self.count_since(before).ok(),
        };
        self.values.truncate(before);
        count.ok_or_else(|| Stop::not_evaluated("a count or switch that is no number"))
    }

    fn marked(&mut self, item: Link, end: Link, value: &str) -> Result<(), Stop> {
        let mut at = 0;
        while self.cursor < self.data.len() {
            let (from, before, depth, origin) = (self.cursor, self.values.len(), self.depth, self.origin);
            let (path, covered) = (self.path.clone(), self.covered.clone());
            let is_end = self.dop(end, 0).is_ok()
                && matches!(&self.values[before..], [one] if is_written(&one.value, value));
            self.values.truncate(before);
            // The mark belongs to what comes behind the field (ISO 22901-1, 7.3.6.10.5).
            (self.cursor, self.depth, self.origin, self.path) = (from, depth, origin, path);
            if is_end {
                return Ok(());
            }
            self.covered = covered;
            self.item(item, at)?;
            at += 1;
        }
        Ok(())
    }

    fn mux(&mut self, mux: &'a Mux) -> Result<(), Stop> {
        let from = self.cursor;
        let before = std::mem::replace(&mut self.origin, from);
        let switch = Internal::Int(self.at(from, mux.switch)?.into());
        let fits = |case: &&Case| is_between(&switch, case.limits.0.as_ref(), case.limits.1.as_ref(), true);
        let case = mux.cases.iter().find(fits).or(mux.default.as_ref());
        let case = case.ok_or_else(|| Stop::not_evaluated("a switch without a case"))?;
        self.cursor = from.saturating_add(mux.byte as usize);
        match case.structure {
            Some(structure) => self.inside(&case.name, structure)?,
            None => self.push(Physical::Text(case.name.to_string()), None).map(drop)?,
        }
        self.origin = before;
        Ok(())
    }

    fn inside(&mut self, name: &str, dop: Link) -> Result<(), Stop> {
        let length = self.path.len();
        self.path.push('.');
        self.path.push_str(name);
        self.dop(dop, 0)?;
        self.path.truncate(length);
        Ok(())
    }

    fn simple(&mut self, data: &Data, bit: u32) -> Result<(), Stop> {
        let internal = self.internal(&data.coded, bit)?;
        let invalid =
            data.invalid.iter().find(|(low, high, _)| is_between(&internal, Some(low), Some(high), false));
        let unit = match data.unit.and_then(|unit| self.model.item(unit)) {
            Some(Item::Unit(unit)) => self.model.units[unit as usize].clone(),
            _ => "".into(),
        };
        let digits = match data.coded.length {
            Length::Bits { bits, .. } if data.is_hex => u8::try_from(bits.div_ceil(4)).ok(),
            _ => data.is_hex.then_some(2),
        };
        if let Some((_, _, meaning)) = invalid {
            let note = Some(meaning.to_string());
            self.push(plain(internal), digits)?.note = note;
            return Ok(());
        }
        let is_plain = matches!(data.compu, Compu::Identical);
        let (value, note, unit) = match data.compu.convert(internal.clone(), data.physical) {
            Ok(value) => (value, None, unit),
            // It is still known how long it is: those behind it can be read.
            Err(why) => (plain(internal), Some(why), "".into()),
        };
        let decoded = self.push(value, digits.filter(|_| is_plain || note.is_some()))?;
        (decoded.note, decoded.unit) = (note, unit);
        Ok(())
    }
}

/// A value without a conversion.
fn plain(internal: Internal) -> Physical {
    match internal {
        Internal::Int(value) => Physical::Int(value),
        Internal::Real(value) => Physical::Real(value),
        Internal::Text(value) => Physical::Text(value),
        Internal::Bytes(value) => Physical::Bytes(value),
    }
}

/// Whether a value is a constant, of which the file may have more bits than the message.
fn same(coded: &Coded, found: &Internal, constant: &Internal) -> bool {
    match (found, constant, &coded.length) {
        (Internal::Int(found), Internal::Int(constant), Length::Bits { mask: Some(mask), .. }) => {
            *found == constant & i128::from(*mask)
        }
        _ => found == constant,
    }
}

/// Whether a physical value is what a file writes so.
pub fn is_written(value: &Physical, text: &str) -> bool {
    match value {
        Physical::Int(value) => {
            xml::integer(text) == Some(*value) || text.trim().parse() == Ok(*value as f64)
        }
        Physical::Real(value) => text.trim().parse() == Ok(*value),
        Physical::Text(value) | Physical::Meaning(_, value) => value == text,
        Physical::Bytes(value) => xml::bytes(text).as_ref() == Some(value),
    }
}
