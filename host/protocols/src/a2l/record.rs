//! Where the parts of a parameter are: a RECORD_LAYOUT, laid out for so many points of each axis.

use a2lfile::{AddrType, DataTypeSize, IndexMode, IndexOrder, ModCommon, RecordLayout};

use super::data_type::{DataType, Dimension, type_of};

/// The letters of a parameter's axes.
pub const LETTERS: [&str; 5] = ["X", "Y", "Z", "4", "5"];

/// A part of a record.
#[derive(Clone, Copy, Debug, PartialEq)]
enum PartKind {
    /// How many points an axis has.
    Number(usize),
    /// The points of an axis.
    Points { axis: usize, is_reversed: bool },
    /// Pairs of a rescaled axis, at most so many.
    Pairs(u32),
    /// The values.
    Values(IndexMode),
    /// Something else, of so many bytes.
    Other(u32),
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Part {
    position: u16,
    kind: PartKind,
    data_type: DataType,
}

/// Numbers of one type in a record.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Location {
    /// Bytes from the record's beginning.
    pub offset: u32,
    /// How each number is stored.
    pub data_type: DataType,
    /// How they follow each other.
    pub dimensions: Vec<Dimension>,
}

/// What of a record is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The values.
    Values,
    /// The points of this axis.
    Points(usize),
    /// How many points this axis has.
    Number(usize),
    /// The pairs of a rescaled axis.
    Pairs,
}

/// A RECORD_LAYOUT.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    parts: Vec<Part>,
    alignments: [u32; 7],
    /// Parts begin where they do with the most points.
    is_static: bool,
    /// And each of their elements is where it is then.
    has_static_elements: bool,
    /// The number of points that the layout itself names, by axis.
    fixed: [Option<u32>; LETTERS.len()],
    /// Where parts are that are not understood.
    unclear: Option<&'static str>,
}

/// The place of a type's alignment.
const fn alignment_of(data_type: DataType) -> usize {
    match data_type {
        DataType::Unsigned(1) | DataType::Signed(1) => 0,
        DataType::Unsigned(2) | DataType::Signed(2) => 1,
        DataType::Unsigned(4) | DataType::Signed(4) => 2,
        DataType::Unsigned(_) | DataType::Signed(_) => 3,
        DataType::Float(2) => 4,
        DataType::Float(4) => 5,
        DataType::Float(_) => 6,
    }
}

/// The product of an array's dimensions.
pub fn product(dimensions: Option<&a2lfile::MatrixDim>) -> Option<u32> {
    let dimensions = dimensions?.dim_list.iter().map(|one| u32::from((*one).max(1)));
    dimensions.into_iter().try_fold(1_u32, u32::checked_mul)
}

/// How numbers in so many dimensions follow each other without gaps, the first dimension in a row.
pub fn in_rows(counts: &[u32], size: u32, mode: IndexMode) -> Option<Vec<Dimension>> {
    let mut order: Vec<_> = (0..counts.len()).collect();
    if mode == IndexMode::ColumnDir && counts.len() > 1 {
        order.swap(0, 1);
    }
    let mut dimensions: Vec<_> =
        counts.iter().map(|count| Dimension { count: *count, stride: 0, is_reversed: false }).collect();
    let mut stride = size;
    for axis in order {
        dimensions[axis].stride = stride;
        stride = stride.checked_mul(counts[axis].max(1))?;
    }
    Some(dimensions)
}

impl Record {
    /// From the file.
    pub fn new(layout: &RecordLayout, common: Option<&ModCommon>) -> Self {
        let mut parts = Vec::new();
        let mut unclear = None;
        let mut add = |position: u16, kind, data_type| parts.push(Part { position, kind, data_type });
        macro_rules! numbered {
            ($($axis:literal $number:ident $points:ident)*) => {$(
                if let Some(number) = &layout.$number {
                    add(number.position, PartKind::Number($axis), type_of(number.datatype));
                }
                if let Some(points) = &layout.$points {
                    if points.addressing != AddrType::Direct {
                        unclear = Some("points behind pointers");
                    }
                    let is_reversed = points.index_incr == IndexOrder::IndexDecr;
                    add(points.position, PartKind::Points { axis: $axis, is_reversed }, type_of(points.datatype));
                }
            )*};
        }
        numbered!(0 no_axis_pts_x axis_pts_x 1 no_axis_pts_y axis_pts_y 2 no_axis_pts_z axis_pts_z
            3 no_axis_pts_4 axis_pts_4 4 no_axis_pts_5 axis_pts_5);
        macro_rules! others {
            ($($field:ident)*) => {$(
                if let Some(other) = &layout.$field {
                    let data_type = type_of(other.datatype);
                    add(other.position, PartKind::Other(data_type.size() as u32), data_type);
                }
            )*};
        }
        others!(identification no_rescale_x no_rescale_y no_rescale_z no_rescale_4 no_rescale_5
            offset_x offset_y offset_z offset_4 offset_5 dist_op_x dist_op_y dist_op_z dist_op_4 dist_op_5
            shift_op_x shift_op_y shift_op_z shift_op_4 shift_op_5 src_addr_x src_addr_y src_addr_z src_addr_4
            src_addr_5 rip_addr_w rip_addr_x rip_addr_y rip_addr_z rip_addr_4 rip_addr_5);
        for reserved in &layout.reserved {
            let size = match reserved.data_size {
                DataTypeSize::Byte => 1,
                DataTypeSize::Word => 2,
                DataTypeSize::Long => 4,
            };
            add(reserved.position, PartKind::Other(size.into()), DataType::Unsigned(size));
        }
        if let Some(pairs) = &layout.axis_rescale_x {
            let most = u32::from(pairs.max_number_of_rescale_pairs);
            add(pairs.position, PartKind::Pairs(most), type_of(pairs.datatype));
        }
        if let Some(values) = &layout.fnc_values {
            if values.address_type != AddrType::Direct {
                unclear = Some("values behind pointers");
            }
            add(values.position, PartKind::Values(values.index_mode), type_of(values.datatype));
        }
        parts.sort_by_key(|part| part.position);
        macro_rules! alignments {
            ($($field:ident $natural:literal)*) => {[$(
                layout.$field.as_ref().map(|own| own.alignment_border)
                    .or_else(|| common?.$field.as_ref().map(|own| own.alignment_border))
                    .map_or($natural, |border| u32::from(border).max(1)),
            )*]};
        }
        let alignments = alignments!(alignment_byte 1 alignment_word 2 alignment_long 4 alignment_int64 8
            alignment_float16_ieee 2 alignment_float32_ieee 4 alignment_float64_ieee 8);
        macro_rules! fixed {
            ($($field:ident)*) => {[$(
                layout.$field.as_ref().map(|own| u32::from(own.number_of_axis_points)),
            )*]};
        }
        let fixed = fixed!(fix_no_axis_pts_x fix_no_axis_pts_y fix_no_axis_pts_z fix_no_axis_pts_4
            fix_no_axis_pts_5);
        let has_static_elements = layout.static_address_offsets.is_some();
        let is_static = has_static_elements || layout.static_record_layout.is_some();
        Self { parts, alignments, is_static, has_static_elements, fixed, unclear }
    }

    /// How many points an axis has by the layout itself.
    pub fn fixed(&self, axis: usize) -> Option<u32> {
        self.fixed.get(axis).copied().flatten()
    }

    /// Whether the record says itself how many points an axis has.
    pub fn has_number(&self, axis: usize) -> bool {
        self.parts.iter().any(|part| part.kind == PartKind::Number(axis))
    }

    /// Where this is with so many points of each axis, of at most so many; without axes, so many values.
    ///
    /// # Errors
    ///
    /// It is not there, or it is not known where.
    pub fn place(&self, role: Role, counts: &[u32], most: &[u32]) -> Result<Location, &'static str> {
        let mut place = self.without_gaps(role, counts)?;
        if self.is_static {
            let fixed = self.without_gaps(role, most)?;
            place.offset = fixed.offset;
            if self.has_static_elements {
                for (dimension, fixed) in place.dimensions.iter_mut().zip(&fixed.dimensions) {
                    dimension.stride = fixed.stride;
                }
            }
        }
        Ok(place)
    }

    fn without_gaps(&self, role: Role, counts: &[u32]) -> Result<Location, &'static str> {
        const TOO_LARGE: &str = "it is too large";
        if let Some(unclear) = self.unclear {
            return Err(unclear);
        }
        let mut offset = 0_u32;
        let mut parts = self.parts.iter().copied().peekable();
        while let Some(part) = parts.next() {
            let size = part.data_type.size() as u32;
            offset = self.aligned(offset, part.data_type).ok_or(TOO_LARGE)?;
            // Points and values in turn stand where the first of them does.
            if let (PartKind::Points { axis, is_reversed }, Some(next)) = (part.kind, parts.peek().copied())
                && let PartKind::Values(mode) = next.kind
                && [IndexMode::AlternateWithX, IndexMode::AlternateWithY].get(axis) == Some(&mode)
            {
                let width = next.data_type.size() as u32;
                if counts.len() > 2 || (width != size && self.alignments.iter().any(|border| *border > 1)) {
                    return Err("its points and values in turn are not understood");
                }
                let others: u32 = counts
                    .iter()
                    .enumerate()
                    .filter(|(at, _)| *at != axis)
                    .map(|(_, count)| *count)
                    .product();
                let group =
                    width.checked_mul(others).and_then(|all| all.checked_add(size)).ok_or(TOO_LARGE)?;
                if role == Role::Points(axis) {
                    let count = counts.get(axis).copied().unwrap_or(1);
                    let dimensions = vec![Dimension { count, stride: group, is_reversed }];
                    return Ok(Location { offset, data_type: part.data_type, dimensions });
                }
                if role == Role::Values {
                    let dimension = |(at, count): (usize, &u32)| Dimension {
                        count: *count,
                        stride: if at == axis { group } else { width },
                        is_reversed: false,
                    };
                    let dimensions = counts.iter().enumerate().map(dimension).collect();
                    return Ok(Location { offset: offset + size, data_type: next.data_type, dimensions });
                }
                parts.next();
                let count = counts.get(axis).copied().unwrap_or(1);
                offset = group.checked_mul(count).and_then(|all| offset.checked_add(all)).ok_or(TOO_LARGE)?;
                continue;
            }
            let (found, dimensions) = match part.kind {
                PartKind::Number(axis) => (Some(Role::Number(axis)), Vec::new()),
                PartKind::Other(_) => (None, Vec::new()),
                PartKind::Points { axis, is_reversed } => {
                    let count = counts.get(axis).copied().unwrap_or(1);
                    (Some(Role::Points(axis)), vec![Dimension { count, stride: size, is_reversed }])
                }
                PartKind::Pairs(most) => {
                    let pair = Dimension { count: 2, stride: size, is_reversed: false };
                    (Some(Role::Pairs), vec![Dimension { count: most, stride: 2 * size, ..pair }, pair])
                }
                PartKind::Values(mode @ (IndexMode::RowDir | IndexMode::ColumnDir)) => {
                    (Some(Role::Values), in_rows(counts, size, mode).ok_or(TOO_LARGE)?)
                }
                // Beside an axis that is elsewhere, there is nothing in turn.
                PartKind::Values(_) if counts.len() <= 1 => {
                    (Some(Role::Values), in_rows(counts, size, IndexMode::RowDir).ok_or(TOO_LARGE)?)
                }
                PartKind::Values(_) => return Err("the order of its values is not understood"),
            };
            if found == Some(role) {
                return Ok(Location { offset, data_type: part.data_type, dimensions });
            }
            let count = dimensions.iter().try_fold(1_u32, |all, one| all.checked_mul(one.count));
            let used = count.and_then(|count| count.checked_mul(size)).ok_or(TOO_LARGE)?;
            offset = offset.checked_add(used).ok_or(TOO_LARGE)?;
        }
        Err("its RECORD_LAYOUT has no such part")
    }

    fn aligned(&self, offset: u32, data_type: DataType) -> Option<u32> {
        offset.checked_next_multiple_of(self.alignments[alignment_of(data_type)])
    }
}
