//! Values as they are in a message.

/// A name that several things have.
pub type Name = std::sync::Arc<str>;

/// Kinds of values in a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BaseType {
    Int,
    Uint,
    Float32,
    Float64,
    Ascii,
    Utf8,
    Unicode,
    Bytes,
}

/// A value as it is in a message.
#[derive(Clone, Debug, PartialEq)]
pub enum Internal {
    /// An integer.
    Int(i128),
    /// A number.
    Real(f64),
    /// A text.
    Text(String),
    /// Bytes.
    Bytes(Vec<u8>),
}
