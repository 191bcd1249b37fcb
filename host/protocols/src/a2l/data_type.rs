//! How numbers are stored, and how they follow each other.

/// How a number is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DataType {
    /// Without a sign, of 1, 2, 4 or 8 bytes.
    Unsigned(u8),
    /// In two's complement, of 1, 2, 4 or 8 bytes.
    Signed(u8),
    /// IEEE 754, of 2, 4 or 8 bytes.
    Float(u8),
}

impl DataType {
    /// Bytes of a number.
    pub const fn size(self) -> usize {
        match self {
            Self::Unsigned(size) | Self::Signed(size) | Self::Float(size) => size as usize,
        }
    }
}

/// How many values there are in one direction, and how they follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dimension {
    /// How many.
    pub count: u32,
    /// Bytes from one to the next.
    pub stride: u32,
    /// The first index is the last in the memory.
    pub is_reversed: bool,
}

/// The type that the file names.
pub(super) const fn type_of(data_type: a2lfile::DataType) -> DataType {
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
