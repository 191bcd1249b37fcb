//! Channels' settings, in a session and over a power cycle.

use cantap_wire::message::{
    ChannelConfig, Defaults, Filter, GatewayRule, MAX_FILTERS, MAX_GATEWAY_RULES, Mode,
};
use cantap_wire::{CHANNELS, Channel, Refusal, Reply};
use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::port::board::Board;
use crate::ports::Chip;

/// Most bytes of the channels' settings: for each a configuration of 12 bytes and its filters, 12 bytes each; and a byte of flags.
pub(super) const MAX_SETTINGS: usize = CHANNELS * (16 + MAX_FILTERS * 12) + 1;
/// Most bytes of a gateway: for each channel the number of rules, and the rules, 61 bytes each.
const MAX_GATEWAY: usize = CHANNELS * (1 + MAX_GATEWAY_RULES * 61);
/// Most bytes that [`Chip::save`] must hold.
pub const MAX_SAVED: usize = MAX_SETTINGS + MAX_GATEWAY;

/// The flags, if present, follow the channels' settings: older firmware leaves them unread. Bit 0: slcan's reports (`K1`).
const REPORTS: u8 = 1 << 0;
/// Bit 1: a gateway's rules follow, which is started without a host.
const GATEWAY: u8 = 1 << 1;

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
    let mut bytes = [0; MAX_SETTINGS];
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
    let mut bytes = [0; MAX_SETTINGS];
    let len = board.chip().load(&mut bytes);
    let mut rest = bytes.get(..len).unwrap_or_default();
    for _ in Channel::ALL {
        let Ok((_, behind)) = postcard::take_from_bytes::<ChannelSettings>(rest) else { return false };
        rest = behind;
    }
    rest.first().is_some_and(|flags| flags & REPORTS != 0)
}

/// Adds slcan's byte after `len` bytes of the channels' settings. Returns the new length.
pub(super) fn add_reports(reports: bool, len: usize, bytes: &mut [u8; MAX_SETTINGS]) -> usize {
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

/// Stores both channels' settings and the gateway's rules of this session.
#[inline(never)]
pub(super) fn store_gateway<'q, const N: usize>(
    settings: &[ChannelSettings; CHANNELS],
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    if settings.iter().any(|settings| settings.config.is_none_or(|config| config.mode != Mode::Normal)) {
        return Err(Refusal::NotNormal);
    }
    let mut bytes = [0; MAX_SAVED];
    let mut len = 0;
    // Cannot fail: there is room for the most there can be.
    let full = |_| Refusal::Hardware;
    for settings in settings {
        len += postcard::to_slice(settings, &mut bytes[len..]).map_err(full)?.len();
    }
    bytes[len] = GATEWAY;
    len += 1;
    for from in Channel::ALL {
        let rules = board.with_capture(|capture, _, _| capture.rules(from));
        bytes[len] = rules as u8;
        len += 1;
        for slot in 0..rules {
            let Some(rule) = board.with_capture(|capture, _, _| capture.rule(from, slot)) else { continue };
            len += postcard::to_slice(&rule, &mut bytes[len..]).map_err(full)?.len();
        }
    }
    store(&bytes[..len], board)
}

/// Sets the rules of the gateway that is stored, if there is one. Returns whether there is.
#[inline(never)]
pub(super) fn load_gateway<'q, const N: usize>(board: &mut impl Board<'q, N>) -> bool {
    let mut bytes = [0; MAX_SAVED];
    let len = board.chip().load(&mut bytes);
    set_stored(bytes.get(..len).unwrap_or_default(), board).is_some()
}

fn set_stored<'q, const N: usize>(mut rest: &[u8], board: &mut impl Board<'q, N>) -> Option<()> {
    for _ in Channel::ALL {
        rest = postcard::take_from_bytes::<ChannelSettings>(rest).ok()?.1;
    }
    let (flags, mut rest) = rest.split_first()?;
    if flags & GATEWAY == 0 {
        return None;
    }
    for from in Channel::ALL {
        let (rules, behind) = rest.split_first()?;
        rest = behind;
        for slot in 0..usize::from(*rules) {
            let (rule, behind) = postcard::take_from_bytes::<GatewayRule>(rest).ok()?;
            board.with_capture(|capture, _, _| capture.set_rule(from, slot, Some(rule))).ok()?;
            rest = behind;
        }
    }
    Some(())
}
