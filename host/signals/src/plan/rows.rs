//! Many frames of one message decoded at once, signal by signal: a loop over a column needs no branch, call or allocation per value.

use super::{Conversion, MessagePlan, Payload, SignalPlan, SignalValue};
use crate::layout::ByteOrder;
use crate::model::Message;

/// Frames of one message that are decoded together, made by [`super::super::Decoder::rows`].
#[derive(Clone, Debug)]
pub struct MessageRows {
    message: Message,
    plan: MessagePlan,
    /// Each frame's data bytes, the first one lowest, with zeros beyond its length.
    words: Vec<u64>,
    lens: Vec<u8>,
    shortest: u8,
    raw: Vec<u64>,
    value: Vec<f64>,
    there: Vec<bool>,
}

/// A signal in the frames of a [`MessageRows`], in their order.
#[derive(Clone, Copy, Debug)]
pub struct SignalRows<'a> {
    /// The signal's index in [`Message::signals`].
    pub signal: u32,
    /// Like [`SignalValue::raw`]; meaningless where the signal is not present.
    pub raw: &'a [u64],
    /// Like [`SignalValue::value`]; meaningless where the signal is not present.
    pub value: &'a [f64],
    /// Which frames have the signal; `None` if all do.
    pub there: Option<&'a [bool]>,
}

impl MessageRows {
    pub(crate) fn new(message: Message, plan: MessagePlan) -> Self {
        let (words, lens, raw, value, there) = (vec![], vec![], vec![], vec![], vec![]);
        Self { message, plan, words, lens, shortest: u8::MAX, raw, value, there }
    }

    /// The message.
    pub fn message(&self) -> &Message {
        &self.message
    }

    /// The number of frames waiting to be decoded.
    pub fn len(&self) -> usize {
        self.words.len()
    }

    /// Whether no frame is waiting.
    pub fn is_empty(&self) -> bool {
        self.words.is_empty()
    }

    /// Adds a frame's data. Returns false and adds nothing if it has more than eight bytes: use [`Self::one`] for those.
    #[inline]
    pub fn push(&mut self, data: &[u8]) -> bool {
        let mut padded = [0; 8];
        let Some(bytes) = padded.get_mut(..data.len()) else { return false };
        bytes.copy_from_slice(data);
        let len = data.len() as u8;
        self.words.push(u64::from_le_bytes(padded));
        self.lens.push(len);
        self.shortest = self.shortest.min(len);
        true
    }

    /// Decodes a single frame's data of any length, appending to `values`.
    pub fn one(&self, data: &[u8], values: &mut Vec<SignalValue>) {
        self.plan.decode(&self.message, data, values);
    }

    /// Whether data of this length always contain one of the chosen signals, whatever the bytes.
    pub fn is_certain(&self, len: usize) -> bool {
        let fits = |plan: &SignalPlan| usize::from(plan.field.needed) <= len && plan.field.needed < u8::MAX;
        self.plan.groups.iter().any(|group| group.conditions.is_empty() && group.signals.iter().any(fits))
    }

    /// Decodes the waiting frames and forgets them. `each` gets each of the chosen signals once; if some frames do not have it,
    /// [`SignalRows::there`] says which do.
    pub fn decode(&mut self, mut each: impl FnMut(&Message, SignalRows<'_>)) {
        if self.is_empty() {
            return;
        }
        let Self { message, plan, words, lens, shortest, raw, value, there } = self;
        for group in &plan.groups {
            for signal in &group.signals {
                raw.clear();
                value.clear();
                let is_always_there =
                    group.conditions.is_empty() && signal.field.needed <= *shortest && !signal.indicates;
                if is_always_there && signal.column(words, raw, value) {
                    each(message, SignalRows { signal: signal.index, raw, value, there: None });
                    continue;
                }
                there.clear();
                for (word, len) in words.iter().zip(lens.iter()) {
                    let payload = Payload::Frame { little: *word, big: word.swap_bytes(), len: *len };
                    let found = if group.holds(payload) { signal.decode(message, payload) } else { None };
                    raw.push(found.map_or(0, |found| found.raw));
                    value.push(found.map_or(f64::NAN, |found| found.value));
                    there.push(found.is_some());
                }
                each(message, SignalRows { signal: signal.index, raw, value, there: Some(there) });
            }
        }
        words.clear();
        lens.clear();
        *shortest = u8::MAX;
    }
}

impl SignalPlan {
    /// Decodes it from frames that all have it; false, with nothing appended, for the rare kinds.
    fn column(&self, words: &[u64], raw: &mut Vec<u64>, value: &mut Vec<f64>) -> bool {
        let (shift, mask) = (self.field.shift, self.field.mask);
        if matches!(self.conversion, Conversion::Other) {
            return false;
        }
        match self.field.order {
            ByteOrder::Little => raw.extend(words.iter().map(|word| word >> shift & mask)),
            ByteOrder::Big => raw.extend(words.iter().map(|word| word.swap_bytes() >> shift & mask)),
        }
        let scale = self.scale;
        match self.conversion {
            // Values that fit in a signed number are converted by a single instruction.
            Conversion::Unsigned if i64::try_from(mask).is_ok() => {
                scale.apply_all(raw.iter().map(|raw| *raw as i64 as f64), value);
            }
            Conversion::Unsigned => scale.apply_all(raw.iter().map(|raw| *raw as f64), value),
            Conversion::Signed(unused) => {
                scale.apply_all(raw.iter().map(|raw| ((raw << unused) as i64 >> unused) as f64), value);
            }
            Conversion::Single(left) => {
                scale.apply_all(raw.iter().map(|raw| f32::from_bits((*raw as u32) << left).into()), value);
            }
            Conversion::Double(left) => {
                scale.apply_all(raw.iter().map(|raw| f64::from_bits(raw << left)), value);
            }
            Conversion::Other => {}
        }
        true
    }
}
