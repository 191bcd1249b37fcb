//! Edges of a receive pin, for a host looking for a bit rate: meanwhile the controller is off the bus, and nothing is driven.

use cantap_wire::message::{Edge, Edges};
use cantap_wire::{Channel, Refusal, Reply};
use heapless::Vec;

use crate::port::board::Board;
use crate::ports::EdgeMeter;

/// The meter's 32-bit times are extended to 64 bits when a host asks, which works for edges younger than half their range. An edge may
/// have to wait for four answers (each has [`cantap_wire::message::MAX_EDGES`] of the 256 that a meter keeps), so the pause between
/// two answers may be an eighth of that half: 22 s.
const MOST_PAUSE_TICKS: u64 = 1 << 28;

/// A measurement under way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Measuring {
    pub(super) channel: Channel,
    /// The time of the last reported edge, or of the beginning.
    last: u64,
    /// When the host last asked.
    asked: u64,
    /// Something may be missing before the next edge.
    unsure: bool,
}

/// Watches a channel's pin, or none.
pub(super) fn measure<'q, const N: usize>(
    measuring: &mut Option<Measuring>,
    channel: Option<Channel>,
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    if channel.is_some_and(|channel| board.is_open(channel)) {
        return Err(Refusal::ChannelOpen);
    }
    *measuring = channel.map(|channel| begin(channel, false, board));
    if channel.is_none() {
        board.meter().watch(None);
    }
    Ok(Reply::Done)
}

fn begin<'q, const N: usize>(channel: Channel, unsure: bool, board: &mut impl Board<'q, N>) -> Measuring {
    let now = board.with_capture(|capture, _, clock| capture.now(clock));
    board.meter().watch(Some(channel));
    Measuring { channel, last: now, asked: now, unsure }
}

/// What has been measured since the last answer.
///
/// Not inlined, like the other functions that put an answer on the stack.
#[inline(never)]
pub(super) fn edges<'q, const N: usize>(
    measuring: &mut Option<Measuring>,
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    let measuring = measuring.as_mut().ok_or(Refusal::NotMeasuring)?;
    // Before the edges are taken, so that all up to now are among them.
    let now = board.with_capture(|capture, _, clock| capture.now(clock));
    if now.saturating_sub(measuring.asked) > MOST_PAUSE_TICKS {
        *measuring = begin(measuring.channel, true, board);
    }
    measuring.asked = now;
    let mut edges = Vec::new();
    while !edges.is_full()
        && let Some(edge) = board.meter().next()
    {
        // An edge that came after `now` was read lies slightly ahead of it.
        let distance = edge.at.wrapping_sub(now as u32) as i32;
        let at = now.saturating_add_signed(i64::from(distance)).max(measuring.last);
        let ticks = u32::try_from(at - measuring.last).unwrap_or(u32::MAX);
        measuring.last = at;
        let unsure = core::mem::take(&mut measuring.unsure) || edge.unsure;
        // Cannot fail: there is room.
        let _ = edges.push(Edge { ticks, dominant: edge.dominant, unsure });
    }
    Ok(Reply::Edges(Edges { ticks: now, dominant: board.meter().is_dominant(), edges }))
}
