//! What a server has counted since it started, for whoever watches it.

use cantap::TraceFrame;
use cantap_wire::record::{LossStage, Record};
use cantap_wire::{CHANNELS, Event};

use crate::stream::Entry;

/// Of one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ChannelTotals {
    /// Frames received.
    pub received: u64,
    /// Frames that the board sent.
    pub transmitted: u64,
    /// Bits of both on the bus, with stuff bits and the space after a frame, without those of data phases with a bit rate of their own.
    pub bits: u64,
    /// Frames that the board could not send.
    pub transmit_failures: u64,
    /// Bus errors.
    pub bus_errors: u64,
    /// Frames lost in the controller; at least so many.
    pub lost_controller: u64,
    /// Frames lost in the board's queue.
    pub lost_queue: u64,
    /// Frames lost on the way from the board.
    pub lost_link: u64,
    /// Frames lost in front of slow clients, all clients together.
    pub lost_host: u64,
    /// How often the board was off the bus while somebody listened.
    pub off_bus: u64,
}

/// Of a board's channels.
pub type Totals = [ChannelTotals; CHANNELS];

/// Counts a record of the board's stream.
pub fn count(totals: &mut Totals, entry: &Entry) {
    match entry.record {
        Record::Received(received) => {
            let of = &mut totals[received.channel.index()];
            of.received += 1;
            of.bits += u64::from(cantap::bits_on_bus(&received.frame));
        }
        Record::ReceivedFd(received) => {
            let of = &mut totals[received.channel.index()];
            of.received += 1;
            // Those of the data phase have a rate of their own, so that a load of them all would be too high.
            of.bits += u64::from(TraceFrame::from(received.frame).bus_bits().nominal);
        }
        Record::Event(Event::Transmitted { channel, frame, .. }) => {
            let of = &mut totals[channel.index()];
            of.transmitted += 1;
            of.bits += u64::from(cantap::bits_on_bus(&frame));
        }
        Record::TransmittedFd(sent) => {
            let of = &mut totals[sent.channel.index()];
            of.transmitted += 1;
            of.bits += u64::from(TraceFrame::from(sent.frame).bus_bits().nominal);
        }
        Record::Event(Event::TransmitFailed { channel, .. }) => {
            totals[channel.index()].transmit_failures += 1;
        }
        Record::Event(Event::BusError { channel, .. }) => totals[channel.index()].bus_errors += 1,
        Record::Event(Event::ErrorsSuppressed { channel, count }) => {
            totals[channel.index()].bus_errors += u64::from(count);
        }
        Record::Event(Event::Lost { channel, stage, count, .. }) => {
            let of = &mut totals[channel.index()];
            match (stage, count) {
                (LossStage::Link, 0) => of.off_bus += 1,
                (LossStage::Controller, count) => of.lost_controller += u64::from(count),
                (LossStage::Queue, count) => of.lost_queue += u64::from(count),
                (LossStage::Link, count) => of.lost_link += u64::from(count),
                (LossStage::Host, count) => of.lost_host += u64::from(count),
                // No client can start one, but the board may have one of its own.
                (LossStage::Gateway, count) => of.transmit_failures += u64::from(count),
            }
        }
        Record::Event(_) => {}
    }
}
