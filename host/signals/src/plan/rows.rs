//! Many frames of one message decoded at once, signal by signal: a loop over a column needs no branch, call or allocation per value.

use super::{Conversion, MessagePlan, Payload, SignalPlan, SignalValue};
use crate::layout::ByteOrder;
use crate::model::Message;

/// So many frames are decoded at once: their columns stay in the processor's nearest memory, and what is done once for each signal
/// counts for nothing.
const ROWS_AT_ONCE: usize = 512;

/// Frames of one message that are decoded together. [`super::super::Decoder::rows`] makes it.
#[derive(Clone, Debug)]
pub struct MessageRows {
    message: Message,
    plan: MessagePlan,
    /// Each frame's data bytes, the first one lowest, with zeros beyond its length.
    words: Vec<u64>,
    lens: Vec<u8>,
    raw: Vec<u64>,
    value: Vec<f64>,
    /// Of a group: in which frames its signals are.
    holds: Vec<bool>,
    there: Vec<bool>,
    indicators: Vec<bool>,
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
    /// In which frames its bits say that there is no value, as [`Message::indicator`] does; `None` if in none. Meaningless where
    /// the signal is not present.
    pub indicators: Option<&'a [bool]>,
}

impl MessageRows {
    pub(crate) fn new(message: Message, plan: MessagePlan) -> Self {
        let (words, lens, raw, value) = (vec![], vec![], vec![], vec![]);
        let (holds, there, indicators) = (vec![], vec![], vec![]);
        Self { message, plan, words, lens, raw, value, holds, there, indicators }
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

    /// Adds a frame's data. Returns false and adds nothing if it has more than eight bytes or contains PDUs: use [`Self::one`] for those.
    #[inline]
    pub fn push(&mut self, data: &[u8]) -> bool {
        if self.message.container.is_some() {
            return false;
        }
        let mut padded = [0; 8];
        let Some(bytes) = padded.get_mut(..data.len()) else { return false };
        bytes.copy_from_slice(data);
        self.words.push(u64::from_le_bytes(padded));
        self.lens.push(data.len() as u8);
        true
    }

    /// Adds the data of frames that contain no PDUs: the first byte lowest, zeros beyond the length of at most eight; and the length.
    #[inline]
    pub fn push_words(&mut self, frames: impl ExactSizeIterator<Item = (u64, u8)> + Clone) {
        self.words.extend(frames.clone().map(|(word, _)| word));
        self.lens.extend(frames.map(|(_, len)| len));
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

    /// Decodes the frames that wait and forgets them. `each` gets the signals that were chosen, some frames at a time, in their
    /// order; where a frame has none of a signal, [`SignalRows::there`] says so.
    pub fn decode(&mut self, mut each: impl FnMut(&Message, SignalRows<'_>)) {
        let Self { message, plan, words, lens, raw, value, holds, there, indicators } = self;
        let payload =
            |(word, len): (&u64, &u8)| Payload::Frame { little: *word, big: word.swap_bytes(), len: *len };
        for (words, lens) in words.chunks(ROWS_AT_ONCE).zip(lens.chunks(ROWS_AT_ONCE)) {
            let shortest = lens.iter().copied().min().unwrap_or(0);
            for group in &plan.groups {
                let is_in_all = group.conditions.is_empty();
                if !is_in_all {
                    holds.clear();
                    holds.extend(words.iter().zip(lens).map(|frame| group.holds(payload(frame))));
                }
                for signal in &group.signals {
                    raw.clear();
                    value.clear();
                    if !signal.column(words, raw, value) {
                        for frame in words.iter().zip(lens) {
                            let found = signal.decode(message, payload(frame));
                            raw.push(found.map_or(0, |found| found.raw));
                            value.push(found.map_or(f64::NAN, |found| found.value));
                        }
                    }
                    let needed = signal.field.needed;
                    there.clear();
                    if !is_in_all {
                        there.extend(holds.iter().zip(lens).map(|(holds, len)| *holds && needed <= *len));
                    } else if needed > shortest {
                        there.extend(lens.iter().map(|len| needed <= *len));
                    }
                    indicators.clear();
                    if let Some(first) = signal.first_indicator
                        && raw.iter().any(|raw| *raw >= first)
                    {
                        let of = &message.signals[signal.index as usize];
                        indicators
                            .extend(raw.iter().map(|raw| *raw >= first && of.indicator(*raw).is_some()));
                        for (value, _) in value.iter_mut().zip(&*indicators).filter(|(_, is)| **is) {
                            *value = f64::NAN;
                        }
                    }
                    let there = Some(&**there).filter(|there| !there.is_empty());
                    let indicators = Some(&**indicators).filter(|indicators| !indicators.is_empty());
                    each(message, SignalRows { signal: signal.index, raw, value, there, indicators });
                }
            }
        }
        words.clear();
        lens.clear();
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
