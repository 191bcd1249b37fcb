//! candump's filters in the device's hardware: whatever it can express saves bandwidth, the rest is left to the
//! host.
//!
//! The hardware never drops anything that the filters accept. If it lets more pass, [`Remainder`] says why,
//! and the host still has to apply the filters to the records.

use cantap_wire::message::{Filter as HardwareFilter, FrameKind, MAX_FILTERS};
use cantap_wire::{Channel, Id, Refusal};

use crate::{Device, DeviceError};
use cantap_trace::filter::{EXTENDED, Filter, IdFilter, REMOTE};

/// Why the device passes more than the filters accept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Remainder {
    /// `ID~MASK`.
    #[error("the hardware has no inverse filters (~), so the computer sorts out what they exclude")]
    Inverse,
    /// The filters accept no frame of this channel, but a controller cannot be set to receive nothing.
    #[error("the filters accept no frame of this channel, so the computer drops them all")]
    Nothing,
    /// More than fit in a request.
    #[error(
        "there are more filters than the device takes ({MAX_FILTERS}; each counts twice, for standard and for extended \
         frames, unless its mask names one kind, as 123:C00007FF does), so the computer does the filtering"
    )]
    TooMany,
    /// More than fit in the hardware.
    #[error("the filters need {needed} hardware banks of {available}, so the computer does the filtering")]
    Banks {
        /// Banks needed.
        needed: u8,
        /// Banks that there are.
        available: u8,
    },
    /// The other channel is open.
    #[error("the other channel is open and would be disturbed, so the computer does the filtering")]
    OtherOpen,
}

/// Filters, as far as the hardware can express them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Compiled {
    /// For the device; if empty, it receives everything.
    pub hardware: Vec<HardwareFilter>,
    /// What is left to the host, if anything.
    pub remainder: Option<Remainder>,
}

impl Compiled {
    fn everything(remainder: Option<Remainder>) -> Self {
        Self { hardware: Vec::new(), remainder }
    }
}

/// Compiles filters for one channel. A frame is accepted if any one of them accepts it.
pub fn compile(filters: &[Filter], channel: Channel) -> Compiled {
    let ours = |filter: &&Filter| filter.channel.is_none_or(|number| number == channel.number());
    let mut hardware = Vec::new();
    let mut remainder = None;
    for filter in filters.iter().filter(ours) {
        let has_inverse = filter.ids.iter().any(|id| id.inverse);
        if filter.ids.is_empty() {
            return Compiled::everything(None);
        }
        if has_inverse {
            remainder = Some(Remainder::Inverse);
        }
        let expressible = filter.ids.iter().filter(|id| !id.inverse).map(alternatives);
        if filter.join {
            let all = expressible.reduce(|all, one| {
                all.iter().flat_map(|a| one.iter().filter_map(move |b| both(a, b))).collect()
            });
            match all {
                Some(all) => hardware.extend(all),
                None => return Compiled::everything(remainder),
            }
        } else if has_inverse {
            return Compiled::everything(remainder);
        } else {
            hardware.extend(expressible.flatten());
        }
    }
    let mut unique = Vec::with_capacity(hardware.len());
    for filter in hardware {
        if !unique.contains(&filter) {
            unique.push(filter);
        }
    }
    match unique.len() {
        0 if filters.is_empty() => Compiled::everything(None),
        0 => Compiled::everything(Some(Remainder::Nothing)),
        1..=MAX_FILTERS => Compiled { hardware: unique, remainder },
        _ => Compiled::everything(Some(Remainder::TooMany)),
    }
}

/// Compiles filters and gives them to a closed channel. If the device has no room for them, it receives
/// everything.
pub fn apply(device: &Device, channel: Channel, filters: &[Filter]) -> Result<Compiled, DeviceError> {
    let compiled = compile(filters, channel);
    let remainder = match device.set_filters(channel, &compiled.hardware) {
        Ok(_) => return Ok(compiled),
        Err(DeviceError::Refused { refusal: Refusal::BanksExhausted { needed, available } }) => {
            Remainder::Banks { needed, available }
        }
        Err(DeviceError::Refused { refusal: Refusal::WouldDisturb }) => Remainder::OtherOpen,
        Err(error) => return Err(error),
    };
    if remainder != Remainder::OtherOpen {
        device.set_filters(channel, &[])?;
    }
    Ok(Compiled::everything(Some(remainder)))
}

/// One element as hardware filters: one for each identifier length that it can accept.
fn alternatives(element: &IdFilter) -> Vec<HardwareFilter> {
    let mask = element.effective_mask();
    let kind = match (mask & REMOTE != 0, element.id & REMOTE != 0) {
        (false, _) => FrameKind::Any,
        (true, true) => FrameKind::Remote,
        (true, false) => FrameKind::Data,
    };
    let wanted = |extended: bool| mask & EXTENDED == 0 || (element.id & EXTENDED != 0) == extended;
    let mut found = Vec::new();
    // A standard identifier's upper bits are zero.
    let standard_possible = element.id & mask & Id::MAX_EXTENDED & !Id::MAX_STANDARD == 0;
    for (extended, widest) in [(false, Id::MAX_STANDARD), (true, Id::MAX_EXTENDED)] {
        if wanted(extended) && (extended || standard_possible) {
            let mask = mask & widest;
            found.push(HardwareFilter { extended, kind, id: element.id & mask, mask });
        }
    }
    found
}

/// The filter that accepts what both accept, if such a frame exists.
fn both(a: &HardwareFilter, b: &HardwareFilter) -> Option<HardwareFilter> {
    let kind = match (a.kind, b.kind) {
        (FrameKind::Any, kind) | (kind, FrameKind::Any) => kind,
        (one, other) if one == other => one,
        _ => return None,
    };
    let agree = a.extended == b.extended && (a.id ^ b.id) & a.mask & b.mask == 0;
    agree.then_some(HardwareFilter {
        extended: a.extended,
        kind,
        id: a.id & a.mask | b.id & b.mask,
        mask: a.mask | b.mask,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_wire::Frame;
    use proptest::prelude::*;

    fn compiled(text: &str) -> Compiled {
        compile(&[text.parse().unwrap()], Channel::Can1)
    }

    fn hardware_passes(compiled: &Compiled, frame: &Frame) -> bool {
        compiled.hardware.is_empty() || compiled.hardware.iter().any(|filter| filter.matches(frame))
    }

    #[test]
    fn an_id_is_a_list_entry_where_candump_names_its_format() {
        let filter =
            HardwareFilter { extended: false, kind: FrameKind::Data, id: 0x123, mask: Id::MAX_STANDARD };
        assert_eq!(compiled("can0,123:C00007FF"), Compiled { hardware: vec![filter], remainder: None });
        // Without the format, a 29-bit frame with these low bits passes too.
        assert_eq!(compiled("can0,123:7FF").hardware.len(), 2);
    }

    #[test]
    fn what_hardware_cannot_do_is_reported() {
        assert_eq!(compiled("can0,123~7FF").remainder, Some(Remainder::Inverse));
        assert_eq!(compiled("can1,123:7FF").remainder, Some(Remainder::Nothing));
        assert_eq!(compiled("can0,100:C00007FF,200:C00007FF,j").remainder, Some(Remainder::Nothing));
        let many: Vec<String> = (0..60).map(|id| format!("{id:03X}:C00007FF")).collect();
        assert_eq!(compiled(&many.join(",")).remainder, Some(Remainder::TooMany));
        // If they do not name their format, half as many are too many, and the message says why.
        let both_kinds = |count| {
            let ids: Vec<String> = (0..count).map(|id| format!("{id:03X}:7FF")).collect();
            compiled(&ids.join(","))
        };
        assert_eq!((both_kinds(28).hardware.len(), both_kinds(28).remainder), (56, None));
        let sentence = both_kinds(29).remainder.unwrap().to_string();
        assert!(sentence.contains("(56; each counts twice"), "{sentence}");
        assert_eq!(compiled("can0"), Compiled::everything(None));
        assert_eq!(compiled("can0,#1FF"), Compiled::everything(None));
    }

    #[test]
    fn a_joined_inverse_still_narrows_the_hardware() {
        let compiled = compiled("can0,100:C0000700,123~7FF,j");
        assert_eq!((compiled.hardware.len(), compiled.remainder), (1, Some(Remainder::Inverse)));
    }

    fn element() -> impl Strategy<Value = String> {
        let id = prop_oneof![
            (0..0x800_u32).prop_map(|id| format!("{id:03X}")),
            (0..0x2000_0000_u32).prop_map(|id| format!("{id:08X}")),
        ];
        let ids = 0..8_u32;
        let small = ids.prop_map(|id| format!("{id:03X}"));
        let mask = prop_oneof![any::<u32>(), Just(0xC000_07FF), Just(0x7FF), Just(7), 0..8_u32];
        (prop_oneof![id, small], prop_oneof![4 => Just(':'), 1 => Just('~')], mask)
            .prop_map(|(id, sign, mask)| format!("{id}{sign}{mask:X}"))
    }

    fn frame() -> impl Strategy<Value = Frame> {
        let id = prop_oneof![
            (0..0x10_u32).prop_map(|id| Id::standard(id).unwrap()),
            (0..=Id::MAX_STANDARD).prop_map(|id| Id::standard(id).unwrap()),
            (0..0x10_u32).prop_map(|id| Id::extended(id).unwrap()),
            (0..=Id::MAX_EXTENDED).prop_map(|id| Id::extended(id).unwrap()),
        ];
        (id, any::<bool>()).prop_map(|(id, remote)| Frame::from_bus(id, remote, 0, [0; 8]))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(4000))]
        #[test]
        fn hardware_passes_all_that_is_accepted_and_no_more_unless_it_says_so(
            elements in prop::collection::vec(element(), 0..4), join: bool, frame in frame()
        ) {
            let text = format!("can0,{}{}", elements.join(","), if join { ",j" } else { "" });
            let text = text.replace(",,", ",").trim_end_matches(',').to_owned();
            let filter: Filter = text.parse().unwrap();
            let compiled = compile(std::slice::from_ref(&filter), Channel::Can1);
            let accepted = filter.accepts_frame(&frame.into());
            let passed = hardware_passes(&compiled, &frame);
            prop_assert!(passed || !accepted, "{text} drops {frame}");
            if compiled.remainder.is_none() {
                prop_assert_eq!(passed, accepted, "{} and {}", text, frame);
            }
        }
    }
}
