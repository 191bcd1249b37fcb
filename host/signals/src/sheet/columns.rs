//! Which columns of a table of signals mean what, by the names above them.

/// What a column means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    MessageId,
    MessageName,
    MessageLength,
    Cycle,
    Extended,
    MessageText,
    Name,
    Text,
    Order,
    StartByte,
    StartBit,
    Length,
    Kind,
    Factor,
    /// canmatrix's, of which the first part is the factor.
    FactorAndUnit,
    Offset,
    Min,
    Max,
    /// `0..6553.5`, or the text of the value in the column beside it.
    Range,
    Unit,
    Values,
    /// A value whose text is in the column of ranges, or all values with their texts.
    Value,
    Multiplexing,
}

const ROLES: usize = Role::Multiplexing as usize + 1;

/// The names, of which only letters and digits count, and letters of other alphabets.
const NAMES: [(Role, &[&str]); ROLES] = [
    (
        Role::MessageId,
        &[
            "id",
            "msgid",
            "messageid",
            "canid",
            "frameid",
            "arbitrationid",
            "identifier",
            "canidentifier",
            "报文标识符",
            "报文id",
            "帧id",
            "消息id",
        ],
    ),
    (
        Role::MessageName,
        &[
            "message",
            "messagename",
            "msg",
            "msgname",
            "frame",
            "framename",
            "canmessage",
            "messagesymbolicname",
            "报文名称",
            "报文名",
            "消息名称",
            "帧名称",
        ],
    ),
    (
        Role::MessageLength,
        &[
            "dlc",
            "msglength",
            "messagelength",
            "framelength",
            "msglen",
            "messagedlc",
            "framedlc",
            "messagelengthbyte",
            "messagesize",
            "报文长度",
            "帧长度",
        ],
    ),
    (
        Role::Cycle,
        &[
            "cycle",
            "cycletime",
            "msgcycletime",
            "messagecycletime",
            "cyclems",
            "period",
            "periodms",
            "sendcycle",
            "报文周期时间",
            "报文周期",
            "周期",
        ],
    ),
    (
        Role::Extended,
        &[
            "ide",
            "extended",
            "isextended",
            "isextendedframe",
            "extendedid",
            "frameformat",
            "idformat",
            "idtype",
            "帧格式",
        ],
    ),
    (
        Role::MessageText,
        &[
            "messagecomment",
            "messagedescription",
            "framecomment",
            "framedescription",
            "msgcomment",
            "报文描述",
        ],
    ),
    (
        Role::Name,
        &["signal", "signalname", "sig", "signame", "signalsymbolicname", "name", "信号名称", "信号名"],
    ),
    (
        Role::Text,
        &[
            "signalfunction",
            "description",
            "comment",
            "signaldescription",
            "signalcomment",
            "sigcomment",
            "remark",
            "信号描述",
            "描述",
            "备注",
        ],
    ),
    (
        Role::Order,
        &[
            "byteorder",
            "endian",
            "endianness",
            "endianess",
            "signalbyteorder",
            "bitorder",
            "排列格式",
            "字节序",
            "字节顺序",
            "排列格式intelmotorola",
        ],
    ),
    (
        Role::StartByte,
        &["startbyte", "signalbyteno", "byte", "byteno", "bytepos", "byteposition", "起始字节"],
    ),
    (
        Role::StartBit,
        &[
            "startbit",
            "start",
            "signalbitno",
            "bit",
            "bitno",
            "bitpos",
            "bitposition",
            "bitstart",
            "bitoffset",
            "signalstartbit",
            "起始位",
        ],
    ),
    (
        Role::Length,
        &[
            "length",
            "bitlength",
            "signallength",
            "size",
            "bits",
            "len",
            "lengthbit",
            "lengthbits",
            "signalsize",
            "bitsize",
            "sizebit",
            "numberofbits",
            "signallengthbit",
            "width",
            "bitwidth",
            "信号长度",
            "长度",
            "位长度",
        ],
    ),
    (
        Role::Kind,
        &[
            "type",
            "datatype",
            "datetype",
            "valuetype",
            "signaltype",
            "signed",
            "issigned",
            "sign",
            "signedness",
            "datatypeunsignedsigned",
            "数据类型",
            "符号类型",
        ],
    ),
    (
        Role::Factor,
        &[
            "factor",
            "scale",
            "scaling",
            "resolution",
            "gain",
            "multiplier",
            "scalefactor",
            "精度",
            "因子",
            "比例因子",
            "分辨率",
        ],
    ),
    (Role::FactorAndUnit, &["functionincrementunit"]),
    (Role::Offset, &["offset", "valueoffset", "signaloffset", "偏移量", "偏移"]),
    (
        Role::Min,
        &[
            "min",
            "minimum",
            "minvalue",
            "signalminvaluephys",
            "physmin",
            "physicalmin",
            "minphys",
            "minphysical",
            "lowerlimit",
            "物理最小值",
            "最小值",
        ],
    ),
    (
        Role::Max,
        &[
            "max",
            "maximum",
            "maxvalue",
            "signalmaxvaluephys",
            "physmax",
            "physicalmax",
            "maxphys",
            "maxphysical",
            "upperlimit",
            "物理最大值",
            "最大值",
        ],
    ),
    (Role::Range, &["namephysrange", "range", "physicalrange", "valuerange"]),
    (Role::Unit, &["unit", "units", "physicalunit", "signalunit", "单位"]),
    (
        Role::Values,
        &[
            "values",
            "choices",
            "enum",
            "enumeration",
            "valuetable",
            "valuedescription",
            "valuedescriptions",
            "signalvaluedescription",
            "valuetexts",
            "states",
            "lookup",
            "coding",
            "信号值描述",
            "取值说明",
        ],
    ),
    (Role::Value, &["value"]),
    (
        Role::Multiplexing,
        &[
            "multiplexing",
            "mux",
            "multiplexer",
            "multiplex",
            "muxvalue",
            "multiplexvalue",
            "muxid",
            "muxindicator",
            "multiplexerindicator",
        ],
    ),
];

/// Which columns a table has.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Columns {
    places: [Option<usize>; ROLES],
    /// Whether the name above the identifiers says how they are written.
    pub id_is_hex: Option<bool>,
}

/// A name without marks, units in brackets, and what is not of a language's letters.
fn plain(name: &str) -> String {
    let letters = name.chars().filter(|each| each.is_alphanumeric());
    letters.flat_map(char::to_lowercase).collect()
}

fn role_of(name: &str) -> Option<Role> {
    // Where several languages or a unit stand in a cell, each of its parts may be the name.
    let whole = plain(name);
    let parts = name.split(['\n', '(', '[', '（', '/']).map(plain);
    // Headers such as `Msg Name\n报文名称`, of which the Latin letters alone are a name.
    let latin: String = whole.chars().filter(char::is_ascii).collect();
    let candidates = std::iter::once(whole).chain(parts.take(1)).chain([latin]);
    let known =
        |name: &String| NAMES.iter().find(|(_, names)| names.contains(&name.as_str())).map(|(role, _)| *role);
    candidates.filter(|name| !name.is_empty()).find_map(|name| known(&name))
}

impl Columns {
    /// From the names above the columns; `None` if these are none.
    pub fn of(cells: &[String]) -> Option<Self> {
        let mut columns = Self::default();
        for (at, cell) in cells.iter().enumerate() {
            let lower = plain(cell);
            let (bare, is_hex) = match (lower.strip_suffix("hex"), lower.strip_suffix("dec")) {
                (Some(bare), _) => (bare.to_owned(), Some(true)),
                (_, Some(bare)) => (bare.to_owned(), Some(false)),
                _ => (cell.clone(), None),
            };
            let Some(role) = role_of(cell).or_else(|| role_of(&bare)) else { continue };
            let place = &mut columns.places[role as usize];
            if place.is_none() {
                *place = Some(at);
                if role == Role::MessageId {
                    columns.id_is_hex = is_hex.or_else(|| lower.contains("hex").then_some(true));
                }
            }
        }
        if !columns.are_of_signals() && !columns.has(Role::MessageName) {
            // A sheet of messages alone.
            columns.places.swap(Role::Name as usize, Role::MessageName as usize);
        }
        // A table of signals, or of the messages that another sheet has the signals of.
        let (has_id, has_name) = (columns.has(Role::MessageId), columns.has(Role::MessageName));
        let is_of_signals = columns.are_of_signals() && (has_id || has_name);
        (is_of_signals || has_id && has_name).then_some(columns)
    }

    pub fn has(&self, role: Role) -> bool {
        self.places[role as usize].is_some()
    }

    /// Whether the rows are signals.
    pub fn are_of_signals(&self) -> bool {
        self.has(Role::Name)
            && self.has(Role::Length)
            && (self.has(Role::StartBit) || self.has(Role::StartByte))
    }

    /// A row's cell; empty if there is none.
    pub fn cell<'a>(&self, cells: &'a [String], role: Role) -> &'a str {
        self.places[role as usize].and_then(|at| cells.get(at)).map_or("", String::as_str)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_known_in_several_languages_and_with_units() {
        for (name, role) in [
            ("Signal Length [Bit]", Some(Role::Length)),
            ("Msg Name\n报文名称", Some(Role::MessageName)),
            ("Bit Length (Bit)\n信号长度", Some(Role::Length)),
            ("Cycle Time [ms]", Some(Role::Cycle)),
            ("Function / Increment Unit", Some(Role::FactorAndUnit)),
            ("Signal Min. Value (phys)\n物理最小值", Some(Role::Min)),
            ("start_bit", Some(Role::StartBit)),
            ("Data Type", Some(Role::Kind)),
            ("speed", None),
            ("", None),
        ] {
            assert_eq!(role_of(name), role, "{name}");
        }
        let cells = |names: &str| names.split(',').map(str::to_owned).collect::<Vec<_>>();
        let columns = Columns::of(&cells("CAN ID (hex),Signal,Start bit,Length")).unwrap();
        assert!(columns.are_of_signals() && columns.id_is_hex == Some(true));
        assert_eq!(Columns::of(&cells("Time,ID,Data")), None);
        assert_eq!(Columns::of(&cells("Name,Start,Length")), None);
    }
}
