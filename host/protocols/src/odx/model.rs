//! What a file describes, in tables that refer to each other by number: references may form circles, which cost nothing until a
//! message is decoded, and that is bounded.

use std::collections::BTreeMap;

use super::compu::Compu;
pub use super::internal::{BaseType, Internal, Name};

/// A number in [`Model::links`].
pub type Link = u32;

/// Everything that was read.
#[derive(Clone, Debug, Default)]
pub struct Model {
    pub layers: Vec<Layer>,
    pub dops: Vec<Dop>,
    pub tables: Vec<OdxTable>,
    pub messages: Vec<Message>,
    pub services: Vec<DiagService>,
    pub links: Vec<Target>,
    /// The names of units, as they are shown.
    pub units: Vec<Name>,
    /// The names of parameters that others refer to.
    pub names: Vec<Name>,
    /// The parts of complex communication parameters, by the number of their name.
    pub complex: BTreeMap<u32, Vec<Name>>,
}

/// What a reference leads to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Target {
    /// The thing itself.
    Item(Item),
    /// Whatever has this name in the layer from which it is looked at.
    Name(Name),
    /// Nothing: the file does not have it.
    Missing,
}

/// A thing with an identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Item {
    Layer(u32),
    Dop(u32),
    Table(u32),
    Row(u32, u32),
    Message(u32),
    Service(u32),
    Unit(u32),
    /// A parameter that others refer to: its name, in a table of names.
    Key(u32),
    /// A communication parameter: its name, in the same table.
    Comparam(u32),
    /// By its type and its number.
    Dtc(u32, u32),
    /// Something that has no part in reading messages.
    Other,
}

/// The kinds of layers, those that override others last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum LayerKind {
    /// Shared data (ECU-SHARED-DATA).
    SharedData,
    /// A protocol (PROTOCOL).
    Protocol,
    /// A functional group (FUNCTIONAL-GROUP).
    FunctionalGroup,
    /// An ECU (BASE-VARIANT).
    BaseVariant,
    /// A variant of an ECU (ECU-VARIANT).
    EcuVariant,
}

/// A diagnostic layer, as it is written.
#[derive(Clone, Debug)]
pub struct Layer {
    pub kind: LayerKind,
    pub name: Name,
    pub long_name: Name,
    pub parents: Vec<Parent>,
    pub imports: Vec<Link>,
    /// Services, and references to some.
    pub services: Vec<ServiceEntry>,
    pub dops: Vec<u32>,
    pub tables: Vec<u32>,
    pub global_refusals: Vec<u32>,
    pub comparams: Vec<Comparam>,
}

#[derive(Clone, Copy, Debug)]
pub enum ServiceEntry {
    Own(u32),
    Shared(Link),
}

/// A layer's parent, and what is not inherited from it.
#[derive(Clone, Debug, Default)]
pub struct Parent {
    pub layer: Link,
    pub without_services: Vec<Name>,
    pub without_dops: Vec<Name>,
    pub without_tables: Vec<Name>,
    pub without_refusals: Vec<Name>,
}

/// The value of a communication parameter.
#[derive(Clone, Debug)]
pub struct Comparam {
    /// What it refers to.
    pub link: Link,
    /// The identifier of what it refers to, of which the last part is usually the name.
    pub id: Name,
    /// The protocol for which it is valid.
    pub protocol: Option<Name>,
    /// Its simple values in order; one if it is not complex.
    pub values: Vec<Name>,
}

/// A service.
#[derive(Clone, Debug)]
pub struct DiagService {
    pub name: Name,
    pub long_name: Name,
    pub request: Option<Link>,
    pub responses: Vec<Link>,
    pub refusals: Vec<Link>,
}

/// A request or response.
#[derive(Clone, Debug, Default)]
pub struct Message {
    pub name: Name,
    pub params: Vec<Param>,
}

/// A parameter.
#[derive(Clone, Debug)]
pub struct Param {
    pub name: Name,
    /// From the beginning of its structure; without one, where the one before ended.
    pub byte: Option<u32>,
    /// From the least significant bit.
    pub bit: u32,
    pub kind: ParamKind,
}

#[derive(Clone, Debug)]
pub enum ParamKind {
    /// CODED-CONST: always this.
    Constant { coded: Coded, value: Internal },
    /// NRC-CONST: one of these.
    OneOf { coded: Coded, values: Vec<Internal> },
    /// PHYS-CONST: always this, as its type writes it.
    Physical { dop: Link, value: Name },
    /// VALUE and SYSTEM.
    Value { dop: Link },
    /// LENGTH-KEY.
    Length { dop: Link },
    /// MATCHING-REQUEST-PARAM: bytes of the request.
    FromRequest { byte: i64, length: u32 },
    /// RESERVED.
    Reserved { bits: u32 },
    /// TABLE-KEY: which row of a table; the row itself if it is fixed.
    TableKey { table: Link },
    /// TABLE-STRUCT: what the row has, by the name of its key.
    TableStruct { key: KeyName },
    /// TABLE-ENTRY, DYNAMIC, and whatever is not known.
    NotEvaluated(Name),
}

/// How a parameter refers to another one.
#[derive(Clone, Debug)]
pub enum KeyName {
    Link(Link),
    Name(Name),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coding {
    /// What the type has by itself.
    Plain,
    BcdPacked,
    BcdUnpacked,
    OnesComplement,
    SignMagnitude,
    Utf8,
    Ucs2,
    Latin1,
    Latin2,
    Windows1252,
}

/// How a value is laid out in a message.
#[derive(Clone, Debug)]
pub struct Coded {
    pub base: BaseType,
    pub coding: Coding,
    pub big_endian: bool,
    pub length: Length,
}

#[derive(Clone, Debug)]
pub enum Length {
    /// So many bits, of which the mask may leave some out.
    Bits { bits: u32, mask: Option<u64> },
    /// A number of bytes of so many bits stands in front.
    Leading { bits: u32 },
    /// Up to an end.
    MinMax { min: u32, max: Option<u32>, end: End },
    /// A number of bits that another parameter says.
    Key(KeyName),
    /// What is not understood.
    NotEvaluated(Name),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    OfMessage,
    Zero,
    HexFf,
}

/// A type of values (a data object property), or of something that is made of such.
#[derive(Clone, Debug)]
pub struct Dop {
    pub name: Name,
    pub kind: DopKind,
}

#[derive(Clone, Debug)]
pub enum DopKind {
    Data(Box<Data>),
    Dtcs(Box<Dtcs>),
    Structure {
        params: Vec<Param>,
        byte_size: Option<u32>,
    },
    /// END-OF-PDU-FIELD.
    ToEnd {
        item: Link,
    },
    /// STATIC-FIELD.
    Static {
        item: Link,
        count: u32,
        item_bytes: u32,
    },
    /// DYNAMIC-LENGTH-FIELD.
    Counted {
        item: Link,
        offset: u32,
        count: Place,
    },
    /// DYNAMIC-ENDMARKER-FIELD.
    Marked {
        item: Link,
        end: Link,
        value: Name,
    },
    Mux(Box<Mux>),
    NotEvaluated(Name),
}

/// A value at a place.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub byte: u32,
    pub bit: u32,
    pub dop: Link,
}

#[derive(Clone, Debug)]
pub struct Mux {
    pub byte: u32,
    pub switch: Place,
    pub cases: Vec<Case>,
    pub default: Option<Case>,
}

#[derive(Clone, Debug)]
pub struct Case {
    pub name: Name,
    pub limits: (Option<super::compu::Limit>, Option<super::compu::Limit>),
    pub structure: Option<Link>,
}

/// A simple value.
#[derive(Clone, Debug)]
pub struct Data {
    pub coded: Coded,
    pub compu: Compu,
    /// The type of the physical value.
    pub physical: BaseType,
    pub is_hex: bool,
    pub unit: Option<Link>,
    /// Ranges of the internal value that mean something else than a value.
    pub invalid: Vec<(super::compu::Limit, super::compu::Limit, Name)>,
}

/// Trouble codes.
#[derive(Clone, Debug)]
pub struct Dtcs {
    pub coded: Coded,
    pub compu: Compu,
    pub codes: BTreeMap<u32, OdxDtc>,
    /// Those that other types have.
    pub others: Vec<Link>,
}

/// A trouble code.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct OdxDtc {
    /// Its short name.
    pub name: Name,
    /// As a person knows it: P0123.
    pub display: Name,
    /// What it means.
    pub text: Name,
}

/// A table, from whose rows a key chooses.
#[derive(Clone, Debug)]
pub struct OdxTable {
    pub name: Name,
    pub key: Option<Link>,
    pub rows: Vec<Row>,
    /// Rows of other tables.
    pub shared: Vec<Link>,
}

#[derive(Clone, Debug)]
pub struct Row {
    pub name: Name,
    pub long_name: Name,
    /// As the key's type writes it.
    pub key: Name,
    pub content: Option<Link>,
}
