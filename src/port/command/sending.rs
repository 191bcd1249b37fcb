//! What a host asks to be sent: once, periodically, or in reply.

#[cfg(not(target_os = "none"))]
use cantap_wire::message::TxFdFrame;
use cantap_wire::message::{DEVICE_TAG, MAX_SEND, Periodic, Trigger, TxFrame};
use cantap_wire::{Channel, Refusal, Reply};
use heapless::Vec;

use crate::TICK_HZ;
use crate::bus::periodic::{self, PERIODIC_SLOTS};
use crate::bus::transmit::TRIGGER_SLOTS;
use crate::port::board::Board;

/// How far ahead target times may be: a day.
const MAX_AHEAD_TICKS: u64 = 24 * 3600 * TICK_HZ as u64;

/// Frames that are queued at a time while the tasks of priority 4 are held up: two microseconds'
/// worth.
const QUEUED_AT_ONCE: usize = 5;

/// Checks that a channel can send.
fn can_send<'q, const N: usize>(channel: Channel, board: &mut impl Board<'q, N>) -> Result<(), Refusal> {
    let config = board.with_capture(|capture, _, _| capture.config(channel).copied());
    let config = config.ok_or(Refusal::ChannelClosed)?;
    if config.mode.transmits() { Ok(()) } else { Err(Refusal::ListenOnly) }
}

/// Queues frames, all or none, and returns how many places are free afterwards.
pub fn send<'q, const N: usize>(
    channel: Channel,
    frames: &Vec<TxFrame, MAX_SEND>,
    board: &mut impl Board<'q, N>,
) -> Result<u16, Refusal> {
    let all = frames.iter().map(|frame| (frame.tag, frame.at_ticks));
    can_queue(channel, all, board)?;
    for frames in frames.chunks(QUEUED_AT_ONCE) {
        board.with_capture(|capture, _, _| {
            for frame in frames {
                capture.transmitter(channel).enqueue(frame);
            }
        });
    }
    Ok(kick(channel, board))
}

/// The same for CAN FD frames, which only other makers' adapters send.
#[cfg(not(target_os = "none"))]
pub(super) fn send_fd<'q, const N: usize>(
    channel: Channel,
    frames: &[TxFdFrame],
    board: &mut impl Board<'q, N>,
) -> Result<u16, Refusal> {
    let all = frames.iter().map(|frame| (frame.tag, frame.at_ticks));
    can_queue(channel, all, board)?;
    board.with_capture(|capture, _, _| {
        for frame in frames {
            capture.transmitter(channel).enqueue_fd(frame);
        }
    });
    Ok(kick(channel, board))
}

/// Checks that frames with these tags and target times can be queued, all of them.
#[inline]
fn can_queue<'q, const N: usize>(
    channel: Channel,
    frames: impl ExactSizeIterator<Item = (u32, Option<u64>)> + Clone,
    board: &mut impl Board<'q, N>,
) -> Result<(), Refusal> {
    can_send(channel, board)?;
    if frames.clone().any(|(tag, _)| tag >= DEVICE_TAG) {
        return Err(Refusal::BadTag);
    }
    let now = board.with_capture(|capture, _, clock| capture.now(clock));
    let count = frames.len();
    let mut frames = frames;
    if frames.any(|(_, at)| at.is_some_and(|at| at > now + MAX_AHEAD_TICKS)) {
        return Err(Refusal::TooFarAhead);
    }
    let free = board.with_capture(|capture, _, _| capture.transmitter(channel).free());
    if free < count { Err(Refusal::QueueFull { free: free as u16 }) } else { Ok(()) }
}

/// Sends what is queued as soon as it can be. Returns how many places are free.
#[inline]
fn kick<'q, const N: usize>(channel: Channel, board: &mut impl Board<'q, N>) -> u16 {
    board.with_capture(|capture, traffic, clock| {
        capture.kick(channel, &mut traffic[channel.index()], clock);
        capture.transmitter(channel).free() as u16
    })
}

pub(super) fn set_periodic<'q, const N: usize>(
    channel: Channel,
    slot: u8,
    entry: Option<Periodic>,
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    if slot as usize >= PERIODIC_SLOTS {
        return Err(Refusal::BadSlot);
    }
    if let Some(entry) = &entry {
        can_send(channel, board)?;
        if !periodic::is_valid(entry) {
            return Err(Refusal::BadEntry);
        }
    }
    // Two locks: each takes a while.
    board.with_capture(|capture, _, clock| {
        let now = capture.now(clock);
        capture.transmitter(channel).set_periodic(slot as usize, entry, now);
    });
    board.with_capture(|capture, traffic, clock| {
        capture.kick(channel, &mut traffic[channel.index()], clock);
    });
    Ok(Reply::Done)
}

pub(super) fn set_trigger<'q, const N: usize>(
    channel: Channel,
    slot: u8,
    entry: Option<Trigger>,
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    if slot as usize >= TRIGGER_SLOTS {
        return Err(Refusal::BadSlot);
    }
    if let Some(entry) = &entry {
        can_send(channel, board)?;
        if !entry.filter.is_valid() {
            return Err(Refusal::BadId);
        }
    }
    board.with_capture(|capture, _, _| capture.transmitter(channel).set_trigger(slot as usize, entry));
    Ok(Reply::Done)
}
