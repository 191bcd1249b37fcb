//! The gateway's rules, its start, its end and its counts.

use cantap_wire::message::{GatewayRule, GatewayState};
use cantap_wire::{Channel, Refusal, Reply};

use crate::port::board::Board;

pub(super) fn set_rule<'q, const N: usize>(
    from: Channel,
    slot: u8,
    rule: Option<GatewayRule>,
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    if let Some(rule) = &rule {
        if !rule.has_valid_ids() {
            return Err(Refusal::BadId);
        }
        if !rule.has_valid_changes() {
            return Err(Refusal::BadEntry);
        }
    }
    board.with_capture(|capture, _, _| capture.set_rule(from, slot.into(), rule))?;
    Ok(Reply::Done)
}

pub(super) fn rule<'q, const N: usize>(
    from: Channel,
    slot: u8,
    board: &mut impl Board<'q, N>,
) -> Result<Reply, Refusal> {
    let rule = board.with_capture(|capture, _, _| capture.rule(from, slot.into()));
    rule.map(Reply::GatewayRule).ok_or(Refusal::BadSlot)
}

pub(super) fn start<'q, const N: usize>(board: &mut impl Board<'q, N>) -> Result<Reply, Refusal> {
    board.with_capture(|capture, _, _| capture.start_gateway(false))?;
    Ok(Reply::Done)
}

pub(super) fn stop<'q, const N: usize>(board: &mut impl Board<'q, N>) -> Reply {
    board.with_capture(|capture, _, _| capture.end_gateway(GatewayState::Off));
    Reply::Done
}

pub(super) fn status<'q, const N: usize>(from: Channel, first: u8, board: &mut impl Board<'q, N>) -> Reply {
    Reply::Gateway(board.with_capture(|capture, _, _| capture.gateway_status(from, first.into())))
}
