//! Channels' settings, in a session and over a power cycle.

use cantap_wire::message::{ChannelConfig, Defaults, Filter, MAX_FILTERS};
use cantap_wire::{CHANNELS, Channel, Refusal, Reply};
use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::port::board::Board;
use crate::ports::Chip;

/// Most bytes that [`Chip::save`] must hold: for each channel a configuration of 12 bytes and its filters, 12 bytes each; and
/// slcan's byte.
pub const MAX_SAVED: usize = CHANNELS * (16 + MAX_FILTERS * 12) + 1;

/// slcan's byte, if present, follows the channels' settings: older firmware leaves it unread, and without it nothing is reported.
/// Bit 0: `K1`.
const REPORTS: u8 = 1 << 0;

/// One channel's settings, applied or saved.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct ChannelSettings {
    pub(super) config: Option<ChannelConfig>,
    pub(super) filters: Vec<Filter, MAX_FILTERS>,
}

/// What is stored for a channel: the channels' settings follow one another.
///
/// Not inlined, like the others here: each keeps bytes on the stack that the next no longer needs.
#[inline(never)]
pub(super) fn saved<'q, const N: usize>(channel: Channel, board: &mut impl Board<'q, N>) -> Option<Defaults> {
    let mut bytes = [0; MAX_SAVED];
    let len = board.chip().load(&mut bytes);
    let mut rest = bytes.get(..len)?;
    for at in Channel::ALL {
        let (ChannelSettings { config, filters }, behind) = postcard::take_from_bytes(rest).ok()?;
        if at == channel {
            return Some(Defaults { config: config?, filters });
        }
        rest = behind;
    }
    None
}

/// Whether the saved settings ask for slcan's reports (`K1`).
#[inline(never)]
pub(super) fn saved_reports<'q, const N: usize>(board: &mut impl Board<'q, N>) -> bool {
    let mut bytes = [0; MAX_SAVED];
    let len = board.chip().load(&mut bytes);
    let mut rest = bytes.get(..len).unwrap_or_default();
    for _ in Channel::ALL {
        let Ok((_, behind)) = postcard::take_from_bytes::<ChannelSettings>(rest) else { return false };
        rest = behind;
    }
    rest.first().is_some_and(|flags| flags & REPORTS != 0)
}

/// Adds slcan's byte after `len` bytes of the channels' settings. Returns the new length.
pub(super) fn add_reports(reports: bool, len: usize, bytes: &mut [u8; MAX_SAVED]) -> usize {
    match bytes.get_mut(len).filter(|_| reports) {
        Some(at) => {
            *at = REPORTS;
            len + 1
        }
        None => len,
    }
}

/// Writing flash stops the processor for up to two seconds, so no channel may be open.
pub(super) fn store<'q, const N: usize>(
    bytes: &[u8],
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    if Channel::ALL.iter().any(|&channel| board.is_open(channel)) {
        return Err(Refusal::ChannelOpen);
    }
    if board.chip().save(bytes) { Ok(Reply::Done) } else { Err(Refusal::Hardware) }
}
