//! Internal values where the reading is: of their length, or up to their end.

use super::super::coded::{Stop, extract};
use super::super::model::{BaseType, Coded, End, Internal, Item, KeyName, Length};
use super::{Key, Reader};

impl Reader<'_> {
    pub(super) fn internal(&mut self, coded: &Coded, bit: u32) -> Result<Internal, Stop> {
        let data = self.data;
        let take = |this: &mut Self, coded: &Coded, bit, bits| {
            let (value, length) = extract(coded, data, this.cursor, bit, bits)?;
            this.cover(length)?;
            Ok(value)
        };
        match &coded.length {
            Length::Bits { bits, mask } => {
                let value = take(self, coded, bit, (*bits).into())?;
                let Some(mask) = *mask else { return Ok(value) };
                match value {
                    Internal::Int(value) => Ok(Internal::Int(value & i128::from(mask))),
                    _ => Err(Stop::not_evaluated("a bit mask on what is no integer")),
                }
            }
            Length::Leading { bits } => {
                let length = Coded {
                    base: BaseType::Uint,
                    length: Length::Bits { bits: *bits, mask: None },
                    ..coded.clone()
                };
                let Internal::Int(bytes) = take(self, &length, bit, (*bits).into())? else {
                    return Err(Stop::Ends);
                };
                let bits =
                    u64::try_from(bytes).ok().and_then(|bytes| bytes.checked_mul(8)).ok_or(Stop::Ends)?;
                take(self, coded, 0, bits)
            }
            Length::MinMax { min, max, end } => self.min_max(coded, *min as usize, *max, *end),
            Length::Key(key) => match self.key(key) {
                Some(Key::Bits(bits)) => take(self, coded, bit, bits),
                _ => Err(Stop::not_evaluated("a length that no parameter before it says")),
            },
            Length::NotEvaluated(what) => Err(Stop::not_evaluated(&**what)),
        }
    }

    fn min_max(&mut self, coded: &Coded, min: usize, max: Option<u32>, end: End) -> Result<Internal, Stop> {
        let rest = self.data.get(self.cursor..).ok_or(Stop::Ends)?;
        if rest.len() < min {
            return Err(Stop::Ends);
        }
        let most = max.map_or(rest.len(), |max| rest.len().min(max as usize));
        let mark: &[u8] = match (end, coded.base) {
            (End::OfMessage, _) => &[],
            (End::Zero, BaseType::Unicode) => &[0, 0],
            (End::HexFf, BaseType::Unicode) => &[0xFF, 0xFF],
            (End::Zero, _) => &[0],
            (End::HexFf, _) => &[0xFF],
        };
        // A mark of two bytes begins where a letter does.
        let ends = |at: &usize| rest.get(*at..at + mark.len()) == Some(mark) && at + mark.len() <= most;
        let marked = (!mark.is_empty()).then(|| (min..most).step_by(mark.len()).find(ends)).flatten();
        let length = marked.unwrap_or(most);
        let (value, length) = extract(coded, self.data, self.cursor, 0, 8 * length as u64)?;
        self.cover(length)?;
        if marked.is_some() {
            self.cover(mark.len())?;
        }
        Ok(value)
    }

    pub(super) fn key(&self, key: &KeyName) -> Option<Key> {
        let name = match key {
            KeyName::Name(name) => name,
            KeyName::Link(link) => match self.model.item(*link)? {
                Item::Key(number) => &self.model.names[number as usize],
                _ => return None,
            },
        };
        self.keys.iter().rev().find(|(known, _)| known == name).map(|(_, key)| *key)
    }
}
