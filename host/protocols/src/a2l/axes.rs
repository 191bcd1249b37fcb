//! The axes of curves and maps: where their points are, and what says how many there are.

use std::sync::Arc;

use a2lfile::{A2lObjectName as _, AxisDescr, AxisDescrAttribute, AxisPts, DepositMode};

use super::conversion::{Conversion, Meaning, Texts};
use super::data_type::DataType;
use super::module::Loader;
use super::object::{Axis, MemoryObject, PartOfRecord, Shape};
use super::record::{LETTERS, Record, Role};
use super::shown::shown;
use crate::Field;

/// The name of what says how many points an axis has.
fn number_name(of: &str, axis: usize) -> String {
    format!("{of}.NO_AXIS_PTS_{}", LETTERS[axis])
}

impl Loader<'_> {
    /// How many points an axis has at most, what says how many it has now, where they are, and whether with the values.
    pub(super) fn axis_of(
        &mut self,
        name: &str,
        at: usize,
        axis: &AxisDescr,
        record: &Record,
    ) -> (u32, Option<String>, Axis, bool) {
        let most = u32::from(axis.max_axis_points);
        let fixed = record.fixed(at);
        match axis.attribute {
            AxisDescrAttribute::StdAxis => {
                let number = record.has_number(at).then(|| number_name(&shown(name), at));
                let place = Axis::Stored(format!("{}.AXIS_PTS_{}", shown(name), LETTERS[at]));
                (fixed.unwrap_or(most), number, place, true)
            }
            AxisDescrAttribute::ComAxis | AxisDescrAttribute::ResAxis => {
                let points = axis.axis_pts_ref.as_ref().map(|points| points.axis_points.as_str());
                let known = points.and_then(|points| self.axes.get(points).copied());
                let place = points.map_or(Axis::Unknown, |points| Axis::Stored(shown(points)));
                match (known, points) {
                    // Pairs of a rescaled axis are fewer than the points.
                    (Some((count, has_number)), Some(points))
                        if axis.attribute == AxisDescrAttribute::ComAxis =>
                    {
                        let number = has_number.then(|| number_name(&shown(points), 0));
                        (fixed.unwrap_or(count), number, place, false)
                    }
                    (None, Some(points)) => {
                        self.issue(&format!("{name}: there is no AXIS_PTS {points}"));
                        (fixed.unwrap_or(most), None, Axis::Unknown, false)
                    }
                    _ => (fixed.unwrap_or(most), None, place, false),
                }
            }
            AxisDescrAttribute::FixAxis => {
                let numbers: Vec<f64> = if let Some(par) = &axis.fix_axis_par {
                    (0..par.number_apo).map(|at| par.offset + f64::from(at) * par.shift.exp2()).collect()
                } else if let Some(par) = &axis.fix_axis_par_dist {
                    (0..par.number_apo).map(|at| par.offset + f64::from(at) * par.distance).collect()
                } else if let Some(list) = &axis.fix_axis_par_list {
                    list.axis_pts_value_list.clone()
                } else {
                    return (fixed.unwrap_or(most), None, Axis::Unknown, false);
                };
                let (conversion, _, unit) = self.conversion(name, &axis.conversion);
                let unit = axis.phys_unit.as_ref().map_or(unit, |unit| shown(&unit.unit));
                let field = |(index, number): (usize, &f64)| {
                    let name = format!("{}.AXIS_PTS_{}[{index}]", shown(name), LETTERS[at]);
                    match conversion.meaning(*number) {
                        Meaning::Value(value) => Field::real(name, value, unit.clone()),
                        Meaning::Text(text) => Field::real(name, *number, "").meaning(Some(text.to_owned())),
                        Meaning::Nothing => Field::real(name, *number, ""),
                    }
                };
                let fields = numbers.iter().enumerate().map(field).collect();
                (numbers.len() as u32, None, Axis::Fixed(fields), false)
            }
            AxisDescrAttribute::CurveAxis => (fixed.unwrap_or(most), None, Axis::Unknown, false),
        }
    }

    /// The points of an axis in a record, and what says how many there are.
    pub(super) fn axis_points(
        &mut self,
        name: &str,
        template: MemoryObject,
        record: &Arc<Record>,
        role: Role,
        (most, numbers): (&[u32], &[Option<String>]),
        order: Option<&a2lfile::ByteOrder>,
    ) -> Vec<MemoryObject> {
        let mut objects = Vec::new();
        let place = match record.place(role, most, most) {
            Ok(place) => place,
            Err(why) => {
                self.issue(&format!("{}: {why}", template.name));
                return objects;
            }
        };
        let at = if let Role::Points(at) = role { at } else { 0 };
        let own = number_name(&shown(name), at);
        if record.has_number(at)
            && let Ok(place) = record.place(Role::Number(at), most, most)
        {
            objects.push(MemoryObject {
                name: own,
                offset: place.offset,
                data_type: place.data_type,
                order: self.order(order, place.data_type.size()).unwrap_or_default(),
                conversion: Conversion::Identical,
                status: Texts::default(),
                unit: String::new(),
                shape: Shape::Numbers(Vec::new()),
                part: None,
                // Another number of points would be another map.
                is_parameter: false,
                limits: (1.0, most.get(at).copied().unwrap_or(1).into()),
                ..template.clone()
            });
        }
        let order = match self.order(order, place.data_type.size()) {
            Ok(order) => order,
            Err(why) => {
                self.issue(&format!("{}: {why}", template.name));
                return objects;
            }
        };
        let part = numbers.iter().any(Option::is_some).then(|| PartOfRecord {
            record: Arc::clone(record),
            role,
            address: template.address,
            most: most.to_vec(),
            numbers: numbers.to_vec(),
        });
        objects.push(MemoryObject {
            offset: place.offset,
            data_type: place.data_type,
            order,
            shape: Shape::Numbers(place.dimensions),
            part,
            ..template
        });
        objects
    }

    /// An axis that stands alone.
    pub(super) fn axis(&mut self, from: &AxisPts) -> Vec<MemoryObject> {
        let name = from.get_name();
        let Some(record) = self.record(&from.deposit_record).map(Arc::new) else {
            self.issue(&format!("{name}: there is no RECORD_LAYOUT {}", from.deposit_record));
            return Vec::new();
        };
        if from.deposit.as_ref().is_some_and(|deposit| deposit.mode == DepositMode::Difference) {
            self.issue(&format!("{name}: its points are stored as differences"));
            return Vec::new();
        }
        let (most, has_number) = self.axes.get(name).copied().unwrap_or((from.max_axis_points.into(), false));
        let (conversion, status, unit) = self.conversion(name, &from.conversion);
        let template = MemoryObject {
            name: shown(name),
            description: shown(&from.long_identifier),
            extension: from.ecu_address_extension.as_ref().map_or(0, |extension| extension.extension as u8),
            address: from.address,
            offset: 0,
            data_type: DataType::Unsigned(1),
            order: None,
            bits: None,
            conversion,
            status,
            unit: from.phys_unit.as_ref().map_or(unit, |unit| shown(&unit.unit)),
            shape: Shape::Numbers(Vec::new()),
            axes: Vec::new(),
            part: None,
            is_parameter: from.read_only.is_none(),
            limits: (from.lower_limit, from.upper_limit),
        };
        let numbers = [has_number.then(|| number_name(&shown(name), 0))];
        let role = if record.place(Role::Pairs, &[], &[]).is_ok() { Role::Pairs } else { Role::Points(0) };
        self.axis_points(name, template, &record, role, (&[most.max(1)], &numbers), from.byte_order.as_ref())
    }
}
