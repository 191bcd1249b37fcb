//! Instances of types (INSTANCE, version 1.7).
//!
//! Each member of a structure becomes a measurement, a parameter or an axis of its own, named by its path, as `Engine.Cylinder[2].Pressure`.

use a2lfile::{
    A2lObjectName as _, AddrType, AxisPts, Characteristic, CharacteristicType, Conversion, EcuAddress,
    IndexMode, Instance, MatrixDim, Measurement, Module, Overwrite,
};

use super::data_type::type_of;
use super::record::{in_rows, product};
use super::shown::MOST_ISSUES;

/// The most members of all structures of a file, those that are structures themselves among them.
const MOST_MEMBERS: usize = 1 << 18;
/// How deep structures may be in each other.
const DEEPEST: usize = 32;

/// The members of all instances, each as if it stood alone.
#[derive(Default)]
pub struct Members {
    pub measurements: Vec<Measurement>,
    pub characteristics: Vec<Characteristic>,
    pub axes: Vec<AxisPts>,
    /// What was left out, and why.
    pub issues: Vec<String>,
}

/// A place in an instance.
struct Spot<'a> {
    instance: &'a Instance,
    /// The name with all before it, and that of the structure which it is in.
    path: String,
    parent: String,
    address: u32,
    dimensions: Option<&'a MatrixDim>,
    mode: IndexMode,
    depth: usize,
}

/// Reads all instances.
pub fn members(module: &Module, granularity: u32) -> Members {
    let mut walk = Walk { module, granularity, seen: 0, members: Members::default() };
    for instance in module.instance.iter() {
        if instance.address_type.as_ref().is_some_and(|kind| kind.address_type != AddrType::Direct) {
            walk.issue(instance.get_name(), "it is behind a pointer");
            continue;
        }
        let path = instance.get_name().to_owned();
        let spot = Spot {
            instance,
            parent: path.clone(),
            path,
            address: instance.start_address,
            dimensions: instance.matrix_dim.as_ref(),
            mode: instance.layout.as_ref().map_or(IndexMode::RowDir, |layout| layout.index_mode),
            depth: 0,
        };
        walk.take(&instance.type_ref, spot);
    }
    walk.members
}

struct Walk<'m> {
    module: &'m Module,
    granularity: u32,
    seen: usize,
    members: Members,
}

impl<'m> Walk<'m> {
    fn issue(&mut self, path: &str, why: &str) {
        self.members.issues.push(format!("{path}: {why}"));
    }

    fn take(&mut self, type_name: &str, spot: Spot<'m>) {
        self.seen += 1;
        if spot.depth > DEEPEST || self.seen > MOST_MEMBERS {
            if self.members.issues.len() < MOST_ISSUES {
                self.issue(&spot.path, "there are too many structures, or too deep in each other");
            }
            return;
        }
        let module = self.module;
        if let Some(structure) = module.typedef_structure.get(type_name) {
            for spot in self.elements(spot, structure.total_size) {
                for component in structure.structure_component.iter() {
                    let path = format!("{}.{}", spot.path, component.get_name());
                    if component
                        .address_type
                        .as_ref()
                        .is_some_and(|kind| kind.address_type != AddrType::Direct)
                    {
                        self.issue(&path, "it is behind a pointer");
                        continue;
                    }
                    let Some(address) = spot.address.checked_add(component.address_offset) else { continue };
                    let inner = Spot {
                        instance: spot.instance,
                        path,
                        parent: spot.path.clone(),
                        address,
                        dimensions: component.matrix_dim.as_ref(),
                        mode: component.layout.as_ref().map_or(IndexMode::RowDir, |layout| layout.index_mode),
                        depth: spot.depth + 1,
                    };
                    self.take(&component.component_type, inner);
                }
            }
        } else if let Some(one) = module.typedef_measurement.get(type_name) {
            let size = type_of(one.datatype).size() as u32;
            let is_array = one.matrix_dim.is_some();
            let own = product(one.matrix_dim.as_ref()).unwrap_or(1);
            let spots = if is_array { self.elements(spot, size.saturating_mul(own)) } else { vec![spot] };
            for spot in spots {
                let mut measurement = Measurement::new(
                    spot.path.clone(),
                    one.long_identifier.clone(),
                    one.datatype,
                    one.conversion.clone(),
                    one.resolution,
                    one.accuracy,
                    one.lower_limit,
                    one.upper_limit,
                );
                measurement.ecu_address = Some(EcuAddress::new(spot.address));
                measurement.ecu_address_extension.clone_from(&spot.instance.ecu_address_extension);
                measurement.bit_mask.clone_from(&one.bit_mask);
                measurement.bit_operation.clone_from(&one.bit_operation);
                measurement.byte_order.clone_from(&one.byte_order);
                measurement.phys_unit.clone_from(&one.phys_unit);
                measurement.matrix_dim = one.matrix_dim.clone().or_else(|| spot.dimensions.cloned());
                measurement.layout.clone_from(&one.layout);
                if !is_array && spot.mode != IndexMode::RowDir {
                    measurement.layout = Some(a2lfile::Layout::new(spot.mode));
                }
                if let Some(over) = overwrite(&spot) {
                    replace(
                        over,
                        &mut measurement.conversion,
                        &mut measurement.lower_limit,
                        &mut measurement.upper_limit,
                    );
                    if over.phys_unit.is_some() {
                        measurement.phys_unit.clone_from(&over.phys_unit);
                    }
                }
                self.members.measurements.push(measurement);
            }
        } else if let Some(one) = module.typedef_characteristic.get(type_name) {
            self.characteristics(one, spot);
        } else if let Some(one) = module.typedef_axis.get(type_name) {
            if spot.dimensions.is_some() {
                self.issue(&spot.path, "arrays of axes are left out");
                return;
            }
            let mut axis = AxisPts::new(
                spot.path.clone(),
                one.long_identifier.clone(),
                spot.address,
                one.input_quantity.clone(),
                one.record_layout.clone(),
                one.max_diff,
                one.conversion.clone(),
                one.max_axis_points,
                one.lower_limit,
                one.upper_limit,
            );
            axis.ecu_address_extension.clone_from(&spot.instance.ecu_address_extension);
            axis.byte_order.clone_from(&one.byte_order);
            axis.deposit.clone_from(&one.deposit);
            axis.phys_unit.clone_from(&one.phys_unit);
            if let Some(over) = overwrite(&spot) {
                replace(over, &mut axis.conversion, &mut axis.lower_limit, &mut axis.upper_limit);
            }
            self.members.axes.push(axis);
        } else if module.typedef_blob.get(type_name).is_some() {
            self.issue(&spot.path, "bytes without a meaning (BLOB) are read by their address");
        } else {
            self.issue(&spot.path, &format!("there is no type {type_name}"));
        }
    }

    fn characteristics(&mut self, one: &a2lfile::TypedefCharacteristic, spot: Spot<'m>) {
        let mut kind = one.characteristic_type;
        let is_value = kind == CharacteristicType::Value;
        let spots = match (kind, spot.dimensions) {
            (_, None) | (CharacteristicType::Value, _) => vec![spot],
            (CharacteristicType::Ascii, Some(_)) => {
                let number = one.number.as_ref().map(|number| u32::from(number.number));
                let length = product(one.matrix_dim.as_ref()).or(number).unwrap_or(1);
                self.elements(spot, length)
            }
            _ => {
                self.issue(&spot.path, "arrays of curves and maps are left out");
                return;
            }
        };
        for spot in spots {
            if is_value && spot.dimensions.is_some() {
                kind = CharacteristicType::ValBlk;
            }
            let mut parameter = Characteristic::new(
                spot.path.clone(),
                one.long_identifier.clone(),
                kind,
                spot.address,
                one.record_layout.clone(),
                one.max_diff,
                one.conversion.clone(),
                one.lower_limit,
                one.upper_limit,
            );
            parameter.ecu_address_extension.clone_from(&spot.instance.ecu_address_extension);
            parameter.axis_descr.clone_from(&one.axis_descr);
            parameter.bit_mask.clone_from(&one.bit_mask);
            parameter.byte_order.clone_from(&one.byte_order);
            parameter.number.clone_from(&one.number);
            parameter.phys_unit.clone_from(&one.phys_unit);
            parameter.matrix_dim = if is_value { spot.dimensions.cloned() } else { one.matrix_dim.clone() };
            // A member of the same structure is meant.
            for axis in &mut parameter.axis_descr {
                if let Some(points) = &mut axis.axis_pts_ref
                    && let Some(member) = points.axis_points.strip_prefix("THIS.")
                {
                    points.axis_points = format!("{}.{member}", spot.parent);
                }
            }
            if let Some(over) = overwrite(&spot) {
                replace(
                    over,
                    &mut parameter.conversion,
                    &mut parameter.lower_limit,
                    &mut parameter.upper_limit,
                );
                if over.phys_unit.is_some() {
                    parameter.phys_unit.clone_from(&over.phys_unit);
                }
            }
            self.members.characteristics.push(parameter);
        }
    }

    /// Each element of an array, of so many bytes.
    fn elements(&mut self, spot: Spot<'m>, size: u32) -> Vec<Spot<'m>> {
        let Some(dimensions) = spot.dimensions else { return vec![spot] };
        let counts: Vec<_> = dimensions.dim_list.iter().map(|count| u32::from((*count).max(1))).collect();
        let all = product(Some(dimensions)).filter(|all| *all as usize <= MOST_MEMBERS);
        let units = if size.is_multiple_of(self.granularity) { size / self.granularity } else { 0 };
        let (Some(all), Some(strides), 1..) = (all, in_rows(&counts, units, spot.mode), units) else {
            self.issue(&spot.path, "it is too large, or not as long as its addresses");
            return Vec::new();
        };
        // Dimensions of one at the end say nothing.
        let named = counts.iter().rposition(|count| *count > 1).map_or(1, |last| last + 1);
        self.seen += all as usize;
        let mut spots = Vec::new();
        for element in 0..all {
            let mut left = element;
            let mut names = vec![String::new(); named];
            let mut offset = 0_u32;
            for (at, dimension) in strides.iter().enumerate().rev() {
                let index = left % dimension.count;
                left /= dimension.count;
                offset = offset.saturating_add(index.saturating_mul(dimension.stride));
                if let Some(name) = names.get_mut(at) {
                    *name = format!("[{index}]");
                }
            }
            let Some(address) = spot.address.checked_add(offset) else { break };
            spots.push(Spot {
                path: format!("{}{}", spot.path, names.concat()),
                parent: spot.parent.clone(),
                address,
                dimensions: None,
                ..spot
            });
        }
        spots
    }
}

/// What the instance says otherwise about this member.
fn overwrite<'a>(spot: &Spot<'a>) -> Option<&'a Overwrite> {
    let name = spot.instance.get_name();
    let member = spot.path.strip_prefix(name).and_then(|rest| rest.strip_prefix('.')).unwrap_or(name);
    spot.instance.overwrite.iter().find(|over| over.axis_number == 0 && over.get_name() == member)
}

fn replace(over: &Overwrite, conversion: &mut String, lower: &mut f64, upper: &mut f64) {
    if let Some(Conversion { name, .. }) = &over.conversion {
        conversion.clone_from(name);
    }
    if let Some(limits) = &over.limits {
        (*lower, *upper) = (limits.lower_limit, limits.upper_limit);
    }
}
