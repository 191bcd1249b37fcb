//! The values of one ECU: a MODULE.

use std::collections::HashMap;
use std::sync::Arc;

use a2lfile::{
    A2lObjectName as _, ByteOrderEnum, CharacteristicType, ConversionType, DepositMode, IndexMode, Module,
};
use cantap_trace::formula::{Dialect, Formula};

use super::conversion::{Conversion, Texts};
use super::data_type::{DataType, type_of};
use super::description::Description;
use super::if_data::EcuConnection;
use super::object::{Bits, MemoryObject, PartOfRecord, Shape};
use super::record::{LETTERS, Record, Role, in_rows, product};
use super::shown::{MOST_ISSUES, shown};
use super::structures;
use crate::calibration::parts::ByteOrder;

/// Reads a module.
pub(super) struct Loader<'m> {
    module: &'m Module,
    issues: Vec<String>,
    /// Of each axis that stands alone: the most points, and whether its record says how many there are.
    pub(super) axes: HashMap<String, (u32, bool)>,
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

/// The dimensions of an array without those of one at the end.
fn counts(dimensions: Option<&a2lfile::MatrixDim>, number: Option<u32>) -> Vec<u32> {
    let mut counts: Vec<_> = match dimensions {
        Some(dimensions) => dimensions.dim_list.iter().map(|count| u32::from((*count).max(1))).collect(),
        None => number.into_iter().collect(),
    };
    while counts.last().is_some_and(|last| *last <= 1) {
        counts.pop();
    }
    counts
}

impl<'m> Loader<'m> {
    /// For a module, with what was left out before.
    pub(super) fn new(module: &'m Module, issues: Vec<String>) -> Self {
        Self { module, issues, axes: HashMap::new() }
    }

    /// Reads it.
    pub(super) fn load(mut self) -> Description {
        let mut transport = EcuConnection::default();
        for data in self.module.if_data.iter().filter_map(|data| data.ifdata_items.as_ref()) {
            transport.take(data);
        }
        let members = structures::members(self.module, transport.granularity.max(1).into());
        let mut description = Description::new(shown(self.module.get_name()), transport);
        for issue in &members.issues {
            self.issue(issue);
        }
        for axis in self.module.axis_pts.iter().chain(&members.axes) {
            let record = self.record(&axis.deposit_record);
            let has_number = record.as_ref().is_some_and(|record| record.has_number(0));
            let most = record.and_then(|record| record.fixed(0)).unwrap_or(axis.max_axis_points.into());
            self.axes.insert(axis.get_name().to_owned(), (most, has_number));
        }
        for measurement in self.module.measurement.iter().chain(&members.measurements) {
            if let Some(object) = self.measurement(measurement) {
                description.add(object);
            }
        }
        for characteristic in self.module.characteristic.iter().chain(&members.characteristics) {
            for object in self.characteristic(characteristic) {
                description.add(object);
            }
        }
        for axis in self.module.axis_pts.iter().chain(&members.axes) {
            for object in self.axis(axis) {
                description.add(object);
            }
        }
        description.issues = self.issues;
        description
    }

    pub(super) fn record(&self, name: &str) -> Option<Record> {
        let layout = self.module.record_layout.get(name)?;
        Some(Record::new(layout, self.module.mod_common.as_ref()))
    }

    pub(super) fn issue(&mut self, issue: &str) {
        if self.issues.len() < MOST_ISSUES {
            self.issues.push(shown(issue));
        } else if self.issues.len() == MOST_ISSUES {
            self.issues.push("there is more that is left out".to_owned());
        }
    }

    /// The order of an object's bytes; an error if it cannot be read at all.
    pub(super) fn order(
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
        let mode = from.layout.as_ref().map_or(IndexMode::RowDir, |layout| layout.index_mode);
        let counts = counts(from.matrix_dim.as_ref(), array);
        let Some(dimensions) = in_rows(&counts, data_type.size() as u32, mode) else {
            self.issue(&format!("{name}: it is too large"));
            return None;
        };
        Some(MemoryObject {
            name: shown(name),
            description: shown(&from.long_identifier),
            extension: from.ecu_address_extension.as_ref().map_or(0, |extension| extension.extension as u8),
            address,
            offset: 0,
            data_type,
            order,
            bits,
            conversion,
            status,
            unit: from.phys_unit.as_ref().map_or(unit, |unit| shown(&unit.unit)),
            shape: Shape::Numbers(dimensions),
            axes: Vec::new(),
            part: None,
            is_parameter: false,
            limits: (from.lower_limit, from.upper_limit),
        })
    }

    /// A parameter, and the axes that are stored with it.
    fn characteristic(&mut self, from: &a2lfile::Characteristic) -> Vec<MemoryObject> {
        let name = from.get_name();
        if from.virtual_characteristic.is_some() {
            return Vec::new();
        }
        let is_text = from.characteristic_type == CharacteristicType::Ascii;
        let record = self.record(&from.deposit).map(Arc::new);
        let number = from.number.as_ref().map(|number| u32::from(number.number));
        let mut most = match from.characteristic_type {
            CharacteristicType::Ascii => {
                vec![product(from.matrix_dim.as_ref()).or(number).unwrap_or(1).max(1)]
            }
            CharacteristicType::ValBlk => counts(from.matrix_dim.as_ref(), number),
            _ => Vec::new(),
        };
        let mut numbers = vec![None; most.len()];
        let mut axes = Vec::new();
        let mut fallible = Vec::new();
        let is_array =
            matches!(from.characteristic_type, CharacteristicType::Value | CharacteristicType::ValBlk);
        if !is_text && !is_array {
            let Some(record) = &record else {
                self.issue(&format!("{name}: there is no RECORD_LAYOUT {}", from.deposit));
                return Vec::new();
            };
            for (at, axis) in from.axis_descr.iter().enumerate().take(LETTERS.len()) {
                let (count, number, kind, is_own) = self.axis_of(name, at, axis, record);
                most.push(count.max(1));
                numbers.push(number);
                axes.push(kind);
                if is_own {
                    fallible.push((at, axis));
                }
            }
        }
        let role = Role::Values;
        let placed = match &record {
            _ if is_text => None,
            None => Some(Err("its RECORD_LAYOUT is not there")),
            Some(record) => Some(record.place(role, &most, &most)),
        };
        let (offset, data_type, shape) = match placed {
            None => {
                let place = record.as_ref().and_then(|record| record.place(role, &[], &[]).ok());
                let offset = place.as_ref().map_or(0, |place| place.offset);
                (offset, DataType::Unsigned(1), Shape::Text(most[0]))
            }
            Some(Ok(place)) => (place.offset, place.data_type, Shape::Numbers(place.dimensions)),
            Some(Err(why)) => {
                self.issue(&format!("{name}: {why}"));
                return Vec::new();
            }
        };
        let order = match self.order(from.byte_order.as_ref(), data_type.size()) {
            Ok(order) => order,
            Err(why) => {
                self.issue(&format!("{name}: {why}"));
                return Vec::new();
            }
        };
        let (conversion, status, unit) = self.conversion(name, &from.conversion);
        let part = record.clone().filter(|_| numbers.iter().any(Option::is_some)).map(|record| {
            PartOfRecord { record, role, address: from.address, most: most.clone(), numbers: numbers.clone() }
        });
        let object = MemoryObject {
            name: shown(name),
            description: shown(&from.long_identifier),
            extension: from.ecu_address_extension.as_ref().map_or(0, |extension| extension.extension as u8),
            address: from.address,
            offset,
            data_type,
            order,
            bits: bits_of(from.bit_mask.as_ref().map(|mask| mask.mask), None),
            conversion,
            status,
            unit: from.phys_unit.as_ref().map_or(unit, |unit| shown(&unit.unit)),
            shape,
            axes,
            part,
            is_parameter: from.read_only.is_none(),
            limits: (from.lower_limit, from.upper_limit),
        };
        let mut objects = vec![object];
        for (at, axis) in fallible {
            if axis.deposit.as_ref().is_some_and(|deposit| deposit.mode == DepositMode::Difference) {
                self.issue(&format!("{name}: the points of an axis are stored as differences"));
                continue;
            }
            let (conversion, status, unit) = self.conversion(name, &axis.conversion);
            let template = MemoryObject {
                name: format!("{}.AXIS_PTS_{}", shown(name), LETTERS[at]),
                description: String::new(),
                bits: None,
                conversion,
                status,
                unit: axis.phys_unit.as_ref().map_or(unit, |unit| shown(&unit.unit)),
                axes: Vec::new(),
                is_parameter: from.read_only.is_none() && axis.read_only.is_none(),
                limits: (axis.lower_limit, axis.upper_limit),
                ..objects[0].clone()
            };
            let order = axis.byte_order.as_ref().or(from.byte_order.as_ref());
            let Some(record) = &record else { continue };
            let sizes = (&most[..], &numbers[..]);
            objects.extend(self.axis_points(name, template, record, Role::Points(at), sizes, order));
        }
        objects
    }

    /// A conversion, texts beside it, and its unit.
    pub(super) fn conversion(&mut self, object: &str, name: &str) -> (Conversion, Texts, String) {
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
