//! Reads A2L files with the crate a2lfile.

use a2lfile::{A2lFile, A2lObjectName as _, ByteOrderEnum, CharacteristicType, ConversionType, Module};
use cantap_trace::clean;
use cantap_trace::formula::{Dialect, Formula};
use encoding_rs::{UTF_16BE, UTF_16LE, WINDOWS_1252};

use super::conversion::{Conversion, Texts};
use super::description::Description;
use super::if_data::EcuConnection;
use super::nesting::{TooDeep, bounded};
use super::object::{Bits, DataType, MemoryObject};
use crate::calibration::parts::ByteOrder;

/// The largest file that is read, with what it includes, in bytes.
const MOST_BYTES: usize = 512 << 20;
/// How many things that are left out are listed by name.
const MOST_ISSUES: usize = 1000;

/// How deep files may include each other.
const DEEPEST: usize = 8;
/// How many files may be included altogether: those that include each other twice would never end.
const MOST_INCLUDED: usize = 1000;

/// Why a file cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum A2lError {
    /// With all that it includes, it is too large.
    #[error("with what it includes, it is larger than 512 MiB")]
    TooLarge,
    /// Its blocks are in each other deeper than in any file of a tool.
    #[error("more than 64 of its blocks are in each other; is it damaged?")]
    TooDeep,
    /// It is no A2L.
    #[error("it is no A2L file: {0}")]
    Malformed(String),
    /// There is no ECU in it.
    #[error("there is no MODULE in it")]
    Empty,
}

/// The bytes of a file that is included under this name, if there is one.
pub type Include<'f> = dyn FnMut(&str) -> Option<Vec<u8>> + 'f;

impl Description {
    /// Reads a file, and those that it includes. One description for each module. What is missing is left out.
    ///
    /// # Errors
    ///
    /// It is no A2L, larger than 512 MiB, or has blocks in each other that are too deep.
    pub fn read(bytes: &[u8], include: &mut Include<'_>) -> Result<Vec<Self>, A2lError> {
        let mut issues = Vec::new();
        let text = expanded(&decode(bytes), include, (0, &mut 0), &mut issues)?;
        let (text, without_grammar) = bounded(text).map_err(|TooDeep| A2lError::TooDeep)?;
        if without_grammar {
            issues.push("its A2ML, which comes to more than is read, is left out".to_owned());
        }
        match a2lfile::load_from_string(&text, None, false) {
            Ok((file, _)) => of_file(&file, &issues),
            Err(error) => Self::parse_bare(&text, &format!("without its A2ML: {error}"), issues),
        }
    }

    /// Reads the text of a file, or of what is within its MODULE. What it includes is left out.
    ///
    /// # Errors
    ///
    /// It is no A2L.
    pub fn parse(text: &str) -> Result<Vec<Self>, A2lError> {
        Self::read(text.as_bytes(), &mut |_| None)
    }

    /// Without all that is not needed, and more often wrong than the rest: the grammar of IF_DATA, the project's name.
    fn parse_bare(text: &str, issue: &str, mut issues: Vec<String>) -> Result<Vec<Self>, A2lError> {
        let bare = without_project_name(&without_a2ml(text));
        issues.push(shown(issue));
        let error = match a2lfile::load_from_string(&bare, None, false) {
            Ok((file, _)) => return of_file(&file, &issues),
            Err(error) => error,
        };
        if !bare.contains("/begin PROJECT")
            && let Ok(module) = a2lfile::load_fragment(&bare, None)
        {
            let one = Loader { module: &module, issues }.load();
            // A file of something else is a fragment without anything in it.
            if !one.objects().is_empty() {
                return Ok(vec![one]);
            }
        }
        Err(A2lError::Malformed(shown(&error.to_string())))
    }
}

/// A text of the file, as it can be shown.
fn shown(text: &str) -> String {
    clean::line(text).into_owned()
}

/// The text of a file, in whichever of the usual encodings.
fn decode(bytes: &[u8]) -> String {
    let encoding = match bytes {
        [0xFF, 0xFE, ..] => Some(UTF_16LE),
        [0xFE, 0xFF, ..] => Some(UTF_16BE),
        _ => None,
    };
    match (encoding, std::str::from_utf8(bytes)) {
        (Some(encoding), _) => encoding.decode(bytes).0.into_owned(),
        (None, Ok(text)) => text.trim_start_matches('\u{FEFF}').to_owned(),
        (None, Err(_)) => WINDOWS_1252.decode(bytes).0.into_owned(),
    }
}

/// Without the blocks that describe IF_DATA.
fn without_a2ml(text: &str) -> String {
    let (mut out, mut rest) = (String::with_capacity(text.len()), text);
    while let Some(at) = rest.find("/begin A2ML") {
        let Some(end) = rest[at..].find("/end A2ML") else { break };
        out.push_str(&rest[..at]);
        rest = &rest[at + end + "/end A2ML".len()..];
    }
    out.push_str(rest);
    out
}

/// With the texts of the files that it includes.
fn expanded(
    text: &str,
    include: &mut Include<'_>,
    (depth, included): (usize, &mut usize),
    issues: &mut Vec<String>,
) -> Result<String, A2lError> {
    let (mut out, mut rest) = (String::with_capacity(text.len()), text);
    let is_next = |rest: &[u8]| rest.starts_with(b"/include") || rest.starts_with(b"/INCLUDE");
    let next =
        |rest: &str| rest.match_indices('/').map(|(at, _)| at).find(|at| is_next(&rest.as_bytes()[*at..]));
    while let Some(at) = next(rest) {
        out.push_str(&rest[..at]);
        // What stands on both sides of it is not to become another one.
        out.push(' ');
        let after = rest[at + "/include".len()..].trim_start();
        let (name, behind) = match after.strip_prefix('"') {
            Some(quoted) => quoted.split_once('"').unwrap_or((quoted, "")),
            None => after.split_at(after.find(char::is_whitespace).unwrap_or(after.len())),
        };
        rest = behind;
        *included += 1;
        let is_one_more = depth < DEEPEST && *included <= MOST_INCLUDED;
        match is_one_more.then(|| include(name)).flatten() {
            Some(bytes) => {
                out.push_str(&expanded(&decode(&bytes), include, (depth + 1, included), issues)?);
                out.push(' ');
            }
            None if issues.len() < MOST_ISSUES => {
                issues.push(shown(&format!("{name}, which it includes, is left out")));
            }
            None => {}
        }
        if out.len() > MOST_BYTES {
            return Err(A2lError::TooLarge);
        }
    }
    out.push_str(rest);
    if out.len() > MOST_BYTES { Err(A2lError::TooLarge) } else { Ok(out) }
}

/// With another name for the project: nobody needs it, and it is where names are that the standard does not allow.
fn without_project_name(text: &str) -> String {
    let begin = "/begin PROJECT";
    let Some(at) = text.find(begin) else { return text.to_owned() };
    let (before, after) = text.split_at(at + begin.len());
    let name = after.trim_start();
    let end =
        name.find(|character: char| character.is_whitespace() || character == '"').unwrap_or(name.len());
    format!("{before} Project {}", &name[end..])
}

fn of_file(file: &A2lFile, issues: &[String]) -> Result<Vec<Description>, A2lError> {
    let all: Vec<_> =
        file.project.module.iter().map(|module| Loader { module, issues: issues.to_vec() }.load()).collect();
    if all.is_empty() { Err(A2lError::Empty) } else { Ok(all) }
}

/// Reads a module.
struct Loader<'m> {
    module: &'m Module,
    issues: Vec<String>,
}

fn order_of(order: Option<&a2lfile::ByteOrder>) -> Order {
    match order.map(|order| order.byte_order) {
        None => Order::Unsaid,
        Some(ByteOrderEnum::MsbLast) => Order::Known(ByteOrder::Little),
        Some(ByteOrderEnum::MsbFirst) => Order::Known(ByteOrder::Big),
        // These two have been used in both meanings.
        Some(ByteOrderEnum::LittleEndian | ByteOrderEnum::BigEndian) => Order::Unclear,
        Some(_) => Order::Mixed,
    }
}

/// What a file says about the order of bytes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Order {
    Unsaid,
    Unclear,
    /// Of words otherwise than of their bytes.
    Mixed,
    Known(ByteOrder),
}

const fn type_of(data_type: a2lfile::DataType) -> DataType {
    use a2lfile::DataType as Type;
    match data_type {
        Type::Ubyte => DataType::Unsigned(1),
        Type::Sbyte => DataType::Signed(1),
        Type::Uword => DataType::Unsigned(2),
        Type::Sword => DataType::Signed(2),
        Type::Ulong => DataType::Unsigned(4),
        Type::Slong => DataType::Signed(4),
        Type::AUint64 => DataType::Unsigned(8),
        Type::AInt64 => DataType::Signed(8),
        Type::Float16Ieee => DataType::Float(2),
        Type::Float32Ieee => DataType::Float(4),
        Type::Float64Ieee => DataType::Float(8),
    }
}

/// The product of an array's dimensions.
fn product(dimensions: Option<&a2lfile::MatrixDim>) -> Option<u32> {
    let dimensions = dimensions?.dim_list.iter().map(|one| u32::from((*one).max(1)));
    dimensions.into_iter().try_fold(1_u32, u32::checked_mul)
}

impl Loader<'_> {
    fn load(mut self) -> Description {
        let mut transport = EcuConnection::default();
        for data in self.module.if_data.iter().filter_map(|data| data.ifdata_items.as_ref()) {
            transport.take(data);
        }
        let mut description = Description::new(shown(self.module.get_name()), transport);
        for measurement in self.module.measurement.iter() {
            if let Some(object) = self.measurement(measurement) {
                description.add(object);
            }
        }
        for characteristic in self.module.characteristic.iter() {
            if let Some(object) = self.characteristic(characteristic) {
                description.add(object);
            }
        }
        let instances = self.module.instance.len();
        if instances > 0 {
            self.issue(&format!("{instances} instances of structures are left out"));
        }
        description.issues = self.issues;
        description
    }

    fn issue(&mut self, issue: &str) {
        if self.issues.len() < MOST_ISSUES {
            self.issues.push(shown(issue));
        } else if self.issues.len() == MOST_ISSUES {
            self.issues.push("there is more that is left out".to_owned());
        }
    }

    /// The order of an object's bytes; an error if it cannot be read at all.
    fn order(
        &self,
        own: Option<&a2lfile::ByteOrder>,
        size: usize,
    ) -> Result<Option<ByteOrder>, &'static str> {
        let common = self.module.mod_common.as_ref().and_then(|common| common.byte_order.as_ref());
        match (order_of(own.or(common)), size) {
            (Order::Known(order), _) => Ok(Some(order)),
            (Order::Unsaid | Order::Unclear, _) | (Order::Mixed, 1 | 2) => Ok(None),
            (Order::Mixed, _) => Err("words in one order, their bytes in another"),
        }
    }

    fn measurement(&mut self, from: &a2lfile::Measurement) -> Option<MemoryObject> {
        let name = from.get_name();
        // Some are computed by the tool, and have no address.
        let address = from.ecu_address.as_ref()?.address;
        let data_type = type_of(from.datatype);
        let order = match self.order(from.byte_order.as_ref(), data_type.size()) {
            Ok(order) => order,
            Err(why) => {
                self.issue(&format!("{name}: {why}"));
                return None;
            }
        };
        let mask = from.bit_mask.as_ref().map(|mask| mask.mask);
        let bits = bits_of(mask, from.bit_operation.as_ref());
        let (conversion, status, unit) = self.conversion(name, &from.conversion);
        let array = from.array_size.as_ref().map(|size| u32::from(size.number));
        Some(MemoryObject {
            name: shown(name),
            description: shown(&from.long_identifier),
            extension: from.ecu_address_extension.as_ref().map_or(0, |extension| extension.extension as u8),
            address,
            data_type,
            order,
            bits,
            conversion,
            status,
            unit: from.phys_unit.as_ref().map_or(unit, |unit| shown(&unit.unit)),
            count: product(from.matrix_dim.as_ref()).or(array).unwrap_or(1).max(1),
            is_text: false,
            is_parameter: false,
            limits: (from.lower_limit, from.upper_limit),
        })
    }

    fn characteristic(&mut self, from: &a2lfile::Characteristic) -> Option<MemoryObject> {
        let name = from.get_name();
        let is_text = from.characteristic_type == CharacteristicType::Ascii;
        let is_single = from.characteristic_type == CharacteristicType::Value;
        if !is_text && !is_single && from.characteristic_type != CharacteristicType::ValBlk {
            self.issue(&format!("{name}: curves and maps are left out"));
            return None;
        }
        if from.virtual_characteristic.is_some() {
            return None;
        }
        let values =
            self.module.record_layout.get(&from.deposit).and_then(|layout| layout.fnc_values.as_ref());
        let data_type = match values {
            Some(values) if values.position <= 1 => type_of(values.datatype),
            _ if is_text => DataType::Unsigned(1),
            _ => {
                self.issue(&format!("{name}: its RECORD_LAYOUT does not begin with its values"));
                return None;
            }
        };
        let order = match self.order(from.byte_order.as_ref(), data_type.size()) {
            Ok(order) => order,
            Err(why) => {
                self.issue(&format!("{name}: {why}"));
                return None;
            }
        };
        let (conversion, status, unit) = self.conversion(name, &from.conversion);
        let number = from.number.as_ref().map(|number| u32::from(number.number));
        let count = if is_single { None } else { product(from.matrix_dim.as_ref()).or(number) };
        Some(MemoryObject {
            name: shown(name),
            description: shown(&from.long_identifier),
            extension: from.ecu_address_extension.as_ref().map_or(0, |extension| extension.extension as u8),
            address: from.address,
            data_type,
            order,
            bits: bits_of(from.bit_mask.as_ref().map(|mask| mask.mask), None),
            conversion,
            status,
            unit: from.phys_unit.as_ref().map_or(unit, |unit| shown(&unit.unit)),
            count: count.unwrap_or(1).max(1),
            is_text,
            is_parameter: from.read_only.is_none(),
            limits: (from.lower_limit, from.upper_limit),
        })
    }

    /// A conversion, texts beside it, and its unit.
    fn conversion(&mut self, object: &str, name: &str) -> (Conversion, Texts, String) {
        if name == "NO_COMPU_METHOD" {
            return (Conversion::Identical, Texts::default(), String::new());
        }
        let Some(method) = self.module.compu_method.get(name) else {
            self.issue(&format!("{object}: there is no COMPU_METHOD {name}"));
            return (Conversion::Unknown, Texts::default(), String::new());
        };
        let table = method.compu_tab_ref.as_ref().map(|table| table.conversion_table.as_str());
        let conversion = match method.conversion_type {
            ConversionType::Identical => Some(Conversion::Identical),
            ConversionType::Linear => method
                .coeffs_linear
                .as_ref()
                .map(|linear| Conversion::Linear { factor: linear.a, offset: linear.b }),
            ConversionType::RatFunc => {
                method.coeffs.as_ref().map(|c| Conversion::Rational([c.a, c.b, c.c, c.d, c.e, c.f]))
            }
            ConversionType::TabIntp => table.and_then(|table| self.points(table, true)),
            ConversionType::TabNointp => table.and_then(|table| self.points(table, false)),
            ConversionType::TabVerb => table.and_then(|table| self.texts(table)).map(Conversion::Texts),
            ConversionType::Form => method.formula.as_ref().and_then(|formula| {
                let inverse =
                    formula.formula_inv.as_ref().and_then(|inverse| Formula::read(&inverse.gx, Dialect::A2l));
                Some(Conversion::Formula(Formula::read(&formula.fx, Dialect::A2l)?, inverse))
            }),
        };
        let status = method.status_string_ref.as_ref().and_then(|table| self.texts(&table.conversion_table));
        if conversion.is_none() {
            let kind = if method.conversion_type == ConversionType::Form {
                "formula"
            } else {
                "table or coefficients"
            };
            self.issue(&format!("{object}: the {kind} of {name} is not evaluated"));
        }
        let unit = if method.unit == "-" { String::new() } else { shown(&method.unit) };
        // A default for all other numbers would hide every value.
        let status = status.map_or_else(Texts::default, |status| Texts { default: None, ..status });
        (conversion.unwrap_or(Conversion::Unknown), status, unit)
    }

    fn points(&self, table: &str, is_interpolated: bool) -> Option<Conversion> {
        let table = self.module.compu_tab.get(table)?;
        let mut points: Vec<_> = table.tab_entry.iter().map(|entry| (entry.in_val, entry.out_val)).collect();
        points.sort_by(|one, other| one.0.total_cmp(&other.0));
        let default = table.default_value_numeric.as_ref().map(|default| default.display_value);
        (!points.is_empty()).then_some(Conversion::Points { points, is_interpolated, default })
    }

    fn texts(&self, table: &str) -> Option<Texts> {
        if let Some(table) = self.module.compu_vtab.get(table) {
            let pairs = table.value_pairs.iter();
            let ranges = pairs.map(|pair| (pair.in_val, pair.in_val, shown(&pair.out_val))).collect();
            let default = table.default_value.as_ref().map(|default| shown(&default.display_string));
            return Some(Texts { ranges, default });
        }
        let table = self.module.compu_vtab_range.get(table)?;
        let triples = table.value_triples.iter();
        let ranges = triples.map(|one| (one.in_val_min, one.in_val_max, shown(&one.out_val))).collect();
        let default = table.default_value.as_ref().map(|default| shown(&default.display_string));
        Some(Texts { ranges, default })
    }
}

/// Which bits are meant: those of the mask, moved as the operation says, or otherwise to the right end.
fn bits_of(mask: Option<u64>, operation: Option<&a2lfile::BitOperation>) -> Option<Bits> {
    if mask.is_none() && operation.is_none() {
        return None;
    }
    let mask = mask.unwrap_or(u64::MAX);
    let right =
        operation.and_then(|operation| operation.right_shift.as_ref()).map(|shift| shift.bitcount as i32);
    let left =
        operation.and_then(|operation| operation.left_shift.as_ref()).map(|shift| -(shift.bitcount as i32));
    let is_signed = operation.is_some_and(|operation| operation.sign_extend.is_some());
    let shift = right.or(left).unwrap_or(if mask == 0 { 0 } else { mask.trailing_zeros() as i32 });
    Some(Bits { mask, shift, is_signed })
}
