//! The board's stream: records go to the clients, answers to the client that sent the request.

use std::ops::ControlFlow;
use std::sync::Arc;

use cantap::DeviceError;
use cantap::device::PIECE_BYTES;
use cantap::session::{Pass, SessionOver, Sink};
use cantap_wire::message::EndReason;
use cantap_wire::record::{LossStage, Record};
use cantap_wire::{Channel, Corruption, Decoded, Decoder, Event, Reply};

use crate::lock::lock;
use crate::outbox::Item;
use crate::shared::Shared;
use crate::state::{State, Then};
use crate::stream::Entry;
use crate::to_send;

/// Takes the stream of one session with the board.
pub struct Upstream {
    shared: Arc<Shared>,
    decoder: Box<Decoder>,
}

impl Upstream {
    pub fn new(shared: Arc<Shared>) -> Self {
        Self { shared, decoder: Box::new(Decoder::new()) }
    }
}

impl Sink for Upstream {
    type Note = Then;

    fn take(&mut self, bytes: &[u8], pass: &mut Pass<'_, Then>) -> ControlFlow<()> {
        for piece in bytes.chunks(PIECE_BYTES) {
            let mut state = self.shared.state();
            take(&mut state, &mut self.decoder, piece, pass);
            let again = std::mem::take(&mut state.again);
            drop(state);
            for (channel, frame) in again {
                let then = Then::SentAgain(frame.tag());
                self.shared.send_unattended(to_send::command(channel, &[frame]), then);
            }
        }
        if !bytes.is_empty() {
            self.shared.changed.notify_all();
        }
        ControlFlow::Continue(())
    }

    fn over(&mut self, reason: Option<DeviceError>) {
        let reason = if reason.is_some() { EndReason::BoardLost } else { EndReason::ServerEnded };
        end_sessions(&self.shared, reason);
    }
}

fn take(state: &mut State, decoder: &mut Decoder, piece: &[u8], pass: &mut Pass<'_, Then>) {
    let mut chunk: Vec<Entry> = Vec::new();
    decoder.push(piece, |decoded| match decoded {
        Decoded::Record { .. } | Decoded::BatchesLost { .. } if !pass.is_in_session() => {}
        Decoded::Record { ticks, record: Record::Event(Event::Stopped { channel }) } => {
            state.deliver(&mut chunk);
            state.stopped(channel, ticks);
        }
        Decoded::Record { ticks, record } => chunk.extend(state.take(ticks, record)),
        Decoded::BatchesLost { frames, .. } => {
            for (channel, count) in Channel::ALL.into_iter().zip(frames).filter(|(_, count)| *count > 0) {
                let event = Event::Lost { channel, stage: LossStage::Link, count, at_least: false };
                chunk.push(Entry::event(state.latest_ticks, event));
            }
        }
        Decoded::Response(response) => {
            let Some(mut waiting) = pass.response(response) else { return };
            // What came before the answer belongs to the time before it.
            state.deliver(&mut chunk);
            match (std::mem::take(&mut waiting.note), &response.result) {
                (Then::Opened { client, channel }, Ok(Reply::Opened(config))) => {
                    state.opened(channel, *config);
                    if let Some((client, config)) = client {
                        state.attach(client, channel, config);
                    }
                }
                (Then::SentAgain(tag), Err(_)) => chunk.extend(state.give_up(tag)),
                _ => {}
            }
            waiting.answer(response.result.clone());
        }
        Decoded::Ended { reason, .. } => pass.end_by_device(reason.into()),
        Decoded::Corrupt(Corruption::OutOfOrder { .. }) if pass.is_in_session() => {
            pass.end(SessionOver::StreamWentBack);
        }
        Decoded::OtherProtocol(version) => pass.other_protocol(version),
        Decoded::Corrupt(_) => {}
    });
    state.deliver(&mut chunk);
}

/// Reports to every client that its session is over, after everything sent to it before.
pub fn end_sessions(shared: &Shared, reason: EndReason) {
    *lock(&shared.requests) = None;
    let mut state = shared.state();
    let ticks = state.latest_ticks;
    for member in state.clients.values_mut().filter(|member| member.in_session) {
        member.in_session = false;
        member.views.iter_mut().for_each(|view| view.config = None);
        member.outbox.push(Item::Ended(reason, ticks));
    }
    state.forget_board();
    drop(state);
    shared.changed.notify_all();
}
