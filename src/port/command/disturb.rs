//! Disturbances: permitted, planned, and ended with their session.

use cantap_wire::{Channel, Refusal, Reply};

use super::Work;
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

/// Work begins that takes channels off their buses, or ends the session.
pub(super) fn end<'q, const N: usize>(work: Work, board: &mut impl Board<'q, N>) {
    board.with_disturber(|disturber, pulse, capture, clock| match work {
        Work::Open(channel, _) | Work::Close(channel) | Work::Recover(channel) => {
            disturber.leave(channel, pulse, capture, clock);
        }
        Work::Retreat => {
            for channel in Channel::ALL {
                disturber.leave(channel, pulse, capture, clock);
            }
            disturber.lock(pulse);
        }
        Work::Keep | Work::Silence | Work::Restart | Work::Bootloader => disturber.lock(pulse),
    });
}
