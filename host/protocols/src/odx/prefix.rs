//! By which bytes messages begin: of thousands of services, one is found by what is the same in each of its messages.

use super::layer::View;
use super::model::{BaseType, Coded, Coding, DopKind, Internal, Length, Message, Model, ParamKind};

/// So many bytes in front are compared.
const BYTES: usize = 8;

/// The first bytes of a message, as far as they are constant; the first one is the highest.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Prefix {
    pub mask: u64,
    pub value: u64,
}

impl Prefix {
    /// Those of a response may be its request's.
    pub fn of(model: &Model, view: &View, message: &Message, request: Option<Self>) -> Self {
        let mut prefix = Self::default();
        let mut cursor = Some(0_usize);
        for param in &message.params {
            let at = param.byte.map(|byte| byte as usize).or(cursor);
            let length = match &param.kind {
                ParamKind::Constant { coded, value } => {
                    let bits = bits_of(coded);
                    if let (Some(at), Some(bits), Internal::Int(value)) = (at, bits, value) {
                        prefix.put(coded, at, param.bit, bits, *value);
                    }
                    bits
                }
                ParamKind::OneOf { coded, .. } => bits_of(coded),
                ParamKind::Physical { dop, .. }
                | ParamKind::Value { dop, .. }
                | ParamKind::Length { dop } => {
                    model.dop(view, *dop).and_then(|dop| match &model.dops[dop as usize].kind {
                        DopKind::Data(data) => bits_of(&data.coded),
                        DopKind::Dtcs(dtcs) => bits_of(&dtcs.coded),
                        DopKind::Structure { byte_size, .. } => {
                            byte_size.and_then(|bytes| bytes.checked_mul(8))
                        }
                        _ => None,
                    })
                }
                ParamKind::FromRequest { byte, length } => {
                    if let (Some(at), Some(request), Ok(from)) = (at, request, usize::try_from(*byte)) {
                        for place in 0..*length as usize {
                            prefix.copy(at.saturating_add(place), request, from.saturating_add(place));
                        }
                    }
                    length.checked_mul(8)
                }
                ParamKind::Reserved { bits } => Some(*bits),
                _ => None,
            };
            cursor = at.zip(length).map(|(at, bits)| {
                at.saturating_add((param.bit as usize).saturating_add(bits as usize).div_ceil(8))
            });
        }
        prefix
    }

    fn put(&mut self, coded: &Coded, at: usize, bit: u32, bits: u32, value: i128) {
        let length = (bit as usize + bits as usize).div_ceil(8);
        if at.saturating_add(length) > BYTES || bit > 7 || bits == 0 || coded.coding != Coding::Plain {
            return;
        }
        let wanted = match coded.length {
            Length::Bits { mask: Some(mask), .. } => mask,
            _ => u64::MAX,
        };
        // The lowest 64 bits are those of a negative number as well.
        let field = (u64::MAX >> (64 - bits)) & wanted;
        let (mask, value) = (u128::from(field) << bit, u128::from(value as u64 & field) << bit);
        for place in 0..length {
            let shift = if coded.big_endian { length - 1 - place } else { place } * 8;
            let to = (BYTES - 1 - at - place) * 8;
            self.mask |= u64::from((mask >> shift) as u8) << to;
            self.value |= u64::from((value >> shift) as u8) << to;
        }
    }

    fn copy(&mut self, to: usize, request: Self, from: usize) {
        if to < BYTES && from < BYTES {
            let (to, from) = ((BYTES - 1 - to) * 8, (BYTES - 1 - from) * 8);
            self.mask |= (request.mask >> from & 0xFF) << to;
            self.value |= (request.value >> from & 0xFF) << to;
        }
    }

    /// Whether a message may be this one: if it is too short for it, what it has is enough.
    pub fn fits(self, data: &[u8]) -> bool {
        let (mut bytes, mut there) = ([0; BYTES], [0; BYTES]);
        let length = data.len().min(BYTES);
        bytes[..length].copy_from_slice(&data[..length]);
        there[..length].fill(0xFF);
        (u64::from_be_bytes(bytes) ^ self.value) & self.mask & u64::from_be_bytes(there) == 0
    }

    /// The bytes in front that are constant as a whole.
    pub fn bytes(self) -> Vec<u8> {
        let whole = self.mask.to_be_bytes().iter().take_while(|mask| **mask == 0xFF).count();
        self.value.to_be_bytes()[..whole].to_vec()
    }

    /// The first byte, if it is constant.
    pub fn first(self) -> Option<u8> {
        (self.mask >> 56 == 0xFF).then_some((self.value >> 56) as u8)
    }
}

/// The number of bits of an integer that always has the same.
fn bits_of(coded: &Coded) -> Option<u32> {
    match coded.length {
        Length::Bits { bits, .. } if bits <= 64 || !matches!(coded.base, BaseType::Int | BaseType::Uint) => {
            Some(bits)
        }
        _ => None,
    }
}
