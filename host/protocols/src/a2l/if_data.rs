//! What IF_DATA says about the connection: identifiers, the order of bytes, events. Only what stands in it under the standards' names is
//! looked for, so that it does not matter by which A2ML it was written.

use a2lfile::GenericIfData;
use cantap_trace::{Id, clean};

use crate::calibration::connection::MasterSlave;
use crate::calibration::parts::ByteOrder;

/// An event with which lists can be sampled.
#[derive(Clone, Debug, PartialEq)]
pub struct DaqEvent {
    /// Its number.
    pub number: u16,
    /// Its name.
    pub name: String,
    /// Its period in seconds, if it has one.
    pub period_s: Option<f64>,
}

/// What an ECU's connection is like.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EcuConnection {
    /// XCP's identifiers.
    pub xcp: Option<MasterSlave>,
    /// CCP's identifiers.
    pub ccp: Option<MasterSlave>,
    /// CCP's station address.
    pub station: u16,
    /// The order of CCP's numbers.
    pub ccp_order: Option<ByteOrder>,
    /// XCP's events.
    pub events: Vec<DaqEvent>,
    /// Bytes of one of XCP's address units; 0 if it is not said.
    pub granularity: u8,
}

/// A word of IF_DATA.
#[derive(Clone, Debug, PartialEq)]
enum Token<'a> {
    Begin(&'a str),
    End,
    Word(&'a str),
    Text(&'a str),
    Number(i64),
    Real,
}

/// How deep blocks may be in each other.
const DEEPEST: usize = 64;

fn flatten<'a>(data: &'a GenericIfData, depth: usize, out: &mut Vec<Token<'a>>) {
    use GenericIfData as Data;
    if depth > DEEPEST {
        return;
    }
    match data {
        Data::None => {}
        Data::Char(_, (number, _)) => out.push(Token::Number((*number).into())),
        Data::Int(_, (number, _)) => out.push(Token::Number((*number).into())),
        Data::Long(_, (number, _)) => out.push(Token::Number((*number).into())),
        Data::Int64(_, (number, _)) => out.push(Token::Number(*number)),
        Data::UChar(_, (number, _)) => out.push(Token::Number((*number).into())),
        Data::UInt(_, (number, _)) => out.push(Token::Number((*number).into())),
        Data::ULong(_, (number, _)) => out.push(Token::Number((*number).into())),
        Data::UInt64(_, (number, _)) => out.push(Token::Number(*number as i64)),
        Data::Float(..) | Data::Double(..) => out.push(Token::Real),
        Data::String(_, text) => out.push(Token::Text(text)),
        Data::EnumItem(_, word) => out.push(Token::Word(word)),
        Data::Array(items)
        | Data::Sequence(items)
        | Data::Struct(_, _, items)
        | Data::Block { items, .. } => {
            for item in items {
                flatten(item, depth + 1, out);
            }
        }
        Data::TaggedStruct(tags) | Data::TaggedUnion(tags) => {
            let mut items: Vec<_> = tags.values().flatten().collect();
            items.sort_by_key(|item| (item.line, item.uid));
            for item in items {
                out.push(if item.is_block { Token::Begin(&item.tag) } else { Token::Word(&item.tag) });
                flatten(&item.data, depth + 1, out);
                if item.is_block {
                    out.push(Token::End);
                }
            }
        }
    }
}

/// The contents of the blocks with this name.
fn blocks<'t, 'a>(tokens: &'t [Token<'a>], name: &str) -> Vec<&'t [Token<'a>]> {
    let mut found = Vec::new();
    for (at, token) in tokens.iter().enumerate() {
        if *token != Token::Begin(name) {
            continue;
        }
        let mut depth = 1;
        let end = tokens[at + 1..].iter().position(|token| {
            depth += match token {
                Token::Begin(_) => 1,
                Token::End => -1,
                _ => 0,
            };
            depth == 0
        });
        found.push(&tokens[at + 1..end.map_or(tokens.len(), |end| at + 1 + end)]);
    }
    found
}

/// The number that follows a word.
fn number_after(tokens: &[Token<'_>], word: &str) -> Option<i64> {
    tokens.windows(2).find_map(|two| match two {
        [Token::Word(found), Token::Number(number)] if *found == word => Some(*number),
        _ => None,
    })
}

/// An identifier; the highest bit says that it has 29.
fn identifier(number: i64) -> Id {
    let raw = number as u32;
    if raw >> 31 != 0 { Id::extended_truncated(raw) } else { id_of_plain(raw) }
}

fn id_of_plain(raw: u32) -> Id {
    if raw > 0x7FF { Id::extended_truncated(raw) } else { Id::standard_truncated(raw) }
}

/// The period of an event: so many times ten to the power of the unit, in nanoseconds.
fn period(cycle: i64, unit: i64) -> Option<f64> {
    let exponent = match unit {
        0..=9 => unit as i32 - 9,
        10..=12 => unit as i32 - 22,
        _ => return None,
    };
    (cycle > 0).then(|| cycle as f64 * 10_f64.powi(exponent))
}

impl EcuConnection {
    /// Takes an IF_DATA of a module.
    pub fn take(&mut self, data: &GenericIfData) {
        let mut tokens = Vec::new();
        flatten(data, 0, &mut tokens);
        for on_can in blocks(&tokens, "XCP_ON_CAN") {
            let ids = (number_after(on_can, "CAN_ID_MASTER"), number_after(on_can, "CAN_ID_SLAVE"));
            if let (Some(master), Some(slave), None) = (ids.0, ids.1, self.xcp) {
                self.xcp = Some(MasterSlave { master: identifier(master), slave: identifier(slave) });
            }
        }
        let units = [("BYTE", 1), ("WORD", 2), ("DWORD", 4)];
        let unit = tokens.iter().find_map(|token| {
            let Token::Word(word) = token else { return None };
            let unit = word.strip_prefix("ADDRESS_GRANULARITY_")?;
            units.iter().find(|(name, _)| *name == unit).map(|(_, size)| *size)
        });
        if let (Some(size), 0) = (unit, self.granularity) {
            self.granularity = size;
        }
        for event in blocks(&tokens, "EVENT") {
            let [Token::Text(name), Token::Text(_), Token::Number(number), rest @ ..] = event else {
                continue;
            };
            // The kind of list, how many lists, then period, unit, priority.
            let period_s = match rest {
                [Token::Word(_), Token::Number(_), Token::Number(cycle), Token::Number(unit), ..] => {
                    period(*cycle, *unit)
                }
                _ => None,
            };
            let (Ok(number), name) = (u16::try_from(*number), clean::line(name).into_owned()) else {
                continue;
            };
            if self.events.iter().all(|known| known.number != number) {
                self.events.push(DaqEvent { number, name, period_s });
            }
        }
        if !matches!(tokens.first(), Some(Token::Word("ASAP1B_CCP") | Token::Begin("ASAP1B_CCP"))) {
            return;
        }
        for blob in blocks(&tokens, "TP_BLOB") {
            let [
                Token::Number(_),
                Token::Number(_),
                Token::Number(master),
                Token::Number(slave),
                Token::Number(station),
                Token::Number(order),
                ..,
            ] = blob
            else {
                continue;
            };
            self.ccp = Some(MasterSlave { master: identifier(*master), slave: identifier(*slave) });
            self.station = *station as u16;
            self.ccp_order = match order {
                1 => Some(ByteOrder::Big),
                2 => Some(ByteOrder::Little),
                _ => None,
            };
        }
    }
}
