//! Replies that a device sends by itself, in place of a script's function.

use cantap::hw_filter;
use cantap::wire::message::Filter as HardwareFilter;
use cantap_can::Channel;
use cantap_trace::filter::{Filter, REMOTE};

use crate::handlers::Selector;

/// The replies of a device on the only channel on which scripts are, for a script that is alone there: a device does not reply to what it has
/// sent itself, so that one of several scripts would get no reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceReplies {
    /// The channel.
    pub channel: Channel,
    /// How many there are.
    pub slots: u8,
}

impl DeviceReplies {
    /// What selects the same frames as a script's selector, and none of them twice, if the device has that.
    pub fn filters(self, selector: &Selector) -> Option<Vec<HardwareFilter>> {
        let ids = match selector {
            Selector::All => {
                return (EVERYTHING.len() <= usize::from(self.slots)).then(|| Vec::from(EVERYTHING));
            }
            Selector::Ids { channel, ids } if channel.is_none_or(|channel| channel == self.channel) => {
                ids.filters()
            }
            Selector::Ids { .. } | Selector::Message(_) => return None,
        };
        // Scripts do not tell data frames from remote ones.
        if ids.iter().any(|id| id.effective_mask() & REMOTE != 0) {
            return None;
        }
        let filter = Filter { channel: None, ids: ids.to_vec(), errors: None, join: false };
        let compiled = hw_filter::compile(&[filter], self.channel);
        let hardware = compiled.hardware;
        let is_apart = |at: usize| !hardware[..at].iter().any(|other| overlap(other, &hardware[at]));
        let is_exact = compiled.remainder.is_none() && !hardware.is_empty();
        (is_exact && hardware.len() <= usize::from(self.slots) && (0..hardware.len()).all(is_apart))
            .then_some(hardware)
    }
}

/// All frames, with identifiers of either length.
const EVERYTHING: [HardwareFilter; 2] = [every(false), every(true)];

const fn every(extended: bool) -> HardwareFilter {
    HardwareFilter { extended, kind: cantap::wire::message::FrameKind::Any, id: 0, mask: 0 }
}

const fn overlap(a: &HardwareFilter, b: &HardwareFilter) -> bool {
    a.extended == b.extended && (a.id ^ b.id) & a.mask & b.mask == 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_can::{Frame, Id};

    #[test]
    fn a_device_s_filters_select_what_the_script_s_selector_does() {
        let replies = DeviceReplies { channel: Channel::Can1, slots: 8 };
        let ids: Vec<Id> = (0..0x800)
            .map(|raw| Id::standard(raw).unwrap())
            .chain((0..0x800).map(|raw| Id::extended(raw | 0x18FE_F100).unwrap()))
            .collect();
        for (text, count) in
            [("123", 1), ("12?", 1), ("100-107", 1), ("101-103", 2), ("18FEF1??", 1), ("120:7F0", 2)]
        {
            let pattern: cantap_trace::grammar::IdPattern = text.parse().unwrap();
            let filters = replies.filters(&Selector::Ids { channel: None, ids: pattern.clone() }).unwrap();
            assert_eq!(filters.len(), count, "{text}");
            for id in &ids {
                for frame in [Frame::data_frame(*id, &[]).unwrap(), Frame::remote_frame(*id, 0).unwrap()] {
                    let matches = filters.iter().filter(|filter| filter.matches(&frame)).count();
                    assert_eq!(matches, usize::from(pattern.matches(*id)), "{text} {frame}");
                }
            }
        }
        let of = |text: &str, channel| {
            replies
                .filters(&Selector::Ids { channel, ids: text.parse().unwrap() })
                .map(|filters| filters.len())
        };
        assert_eq!(of("001-7FE", None), None, "more than there are");
        assert_eq!((of("123", Some(Channel::Can1)), of("123", Some(Channel::Can2))), (Some(1), None));
        assert_eq!(replies.filters(&Selector::All).map(|filters| filters.len()), Some(2));
    }
}
