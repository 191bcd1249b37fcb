//! Disturbances: permitted, planned, and ended with their session.

use cantap_wire::{Channel, Refusal, Reply};

use crate::port::board::Board;

pub(super) fn unlock<'q, const N: usize>(word: u32, board: &mut impl Board<'q, N>) -> Result<Reply, Refusal> {
    let unlocked = board.with_disturber(|disturber, _, _, _| disturber.unlock(word));
    unlocked.unwrap_or(Err(Refusal::Unsupported)).map(|()| Reply::Done)
}

pub(super) fn plan<'q, const N: usize>(
    channel: Channel,
    at_ticks: u64,
    bits: u8,
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    let planned = board.with_disturber(|disturber, pulse, capture, clock| {
        let now = capture.now(clock);
        disturber.plan((channel, capture.config(channel)), at_ticks, bits, pulse, now)
    });
    planned.unwrap_or(Err(Refusal::Unsupported)).map(|()| Reply::Done)
}

/// Channels are about to leave their buses.
pub(super) fn leave<'q, const N: usize>(channels: &[Channel], board: &mut impl Board<'q, N>) {
    board.with_disturber(|disturber, pulse, capture, clock| {
        for channel in channels {
            disturber.leave(*channel, pulse, capture, clock);
        }
    });
}

/// The session is about to end.
pub(super) fn lock<'q, const N: usize>(board: &mut impl Board<'q, N>) {
    board.with_disturber(|disturber, pulse, _, _| disturber.lock(pulse));
}
