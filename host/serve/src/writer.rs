//! The thread that writes to one client: whatever is waiting, encoded for the client's view of the channels.

use std::io::Write;
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap::responder::StreamEncoder;
use cantap_wire::message::EndReason;
use cantap_wire::{CHANNELS, Channel, Event};

use crate::outbox::{Item, Outbox};
use crate::stream::{ClientId, Gap, Views, shown};

/// How often to check whether the connection is over while there is nothing to write.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// A client that takes nothing for this long is gone: a peer that was switched off sends nothing.
pub const PATIENCE: Duration = Duration::from_secs(30);
/// The same for one that may send: the board acknowledges for it.
pub const SENDER_PATIENCE: Duration = Duration::from_secs(5);

/// Why a client that took nothing for this long is dropped.
pub fn took_nothing(patience: Duration) -> String {
    format!("it took nothing for {} s", patience.as_secs())
}

/// Writes until nothing follows; `patience` is asked for how long a client may take nothing. An error says why the client is dropped.
pub fn run(
    outbox: &Outbox,
    output: &mut dyn Write,
    client: ClientId,
    patience: &dyn Fn() -> Duration,
) -> Result<(), String> {
    let mut encoder = Encoder::new(client);
    let mut moved = Instant::now();
    loop {
        let work = outbox.take(LOOK_EVERY);
        for answer in &work.answers {
            encoder.stream.answer(answer);
        }
        if !work.given_up.is_empty() {
            outbox.give_up(encoder.give_up(work.given_up, outbox));
        }
        for item in work.items {
            encoder.take(item);
        }
        encoder.stream.finish();
        let bytes = encoder.stream.bytes();
        if !bytes.is_empty() || !outbox.is_held_up() {
            moved = Instant::now();
        } else {
            check(moved, patience)?;
        }
        write(output, bytes, outbox, patience)?;
        outbox.wrote(bytes.len());
        encoder.stream.clear_bytes();
        if work.is_last {
            return Ok(());
        }
    }
}

fn check(moved: Instant, patience: &dyn Fn() -> Duration) -> Result<(), String> {
    let patience = patience();
    if moved.elapsed() >= patience { Err(took_nothing(patience)) } else { Ok(()) }
}

fn write(
    output: &mut dyn Write,
    mut bytes: &[u8],
    outbox: &Outbox,
    patience: &dyn Fn() -> Duration,
) -> Result<(), String> {
    let mut moved = Instant::now();
    let mut closing: Option<Instant> = None;
    while !bytes.is_empty() {
        match output.write(bytes) {
            Ok(0) => return Ok(()),
            Ok(len) => {
                bytes = &bytes[len..];
                moved = Instant::now();
            }
            Err(error) if is_idle(&error) => {
                check(moved, patience)?;
                // At the end, a client that does not read is not waited for.
                let is_late = |since: &mut Instant| since.elapsed() >= Duration::from_secs(1);
                if outbox.is_closed() && is_late(closing.get_or_insert_with(Instant::now)) {
                    return Ok(());
                }
            }
            // It has left, which the other thread notices too.
            Err(_) => return Ok(()),
        }
    }
    // Whether it arrives shows at the next write.
    let _ = output.flush();
    Ok(())
}

/// Encodes what is waiting.
struct Encoder {
    stream: StreamEncoder,
    views: Views,
    client: ClientId,
}

impl Encoder {
    fn new(client: ClientId) -> Self {
        Self { stream: StreamEncoder::new(), views: Views::default(), client }
    }

    fn take(&mut self, item: Item) {
        match item {
            Item::Restart(answer, ticks) => {
                self.stream.begin(&answer, ticks);
                self.views = Views::default();
            }
            Item::Attach(channel, view, ticks) => {
                self.views[channel.index()] = view;
                self.stream.event(ticks, Event::Started { channel });
            }
            Item::Detach(channel, ticks, _) => self.stop(channel, ticks),
            Item::Chunk(chunk) => {
                for entry in chunk.iter() {
                    if let Some(record) = shown(entry, self.client, &self.views) {
                        self.stream.record(entry.ticks, &record);
                    }
                }
            }
            Item::Gap(gap) => {
                for (ticks, record) in gap.records() {
                    self.stream.record(ticks, &record);
                }
            }
            Item::Answer(answer) => {
                self.stream.finish();
                self.stream.answer(&answer);
            }
            Item::Ended(reason, ticks) => self.end(reason, ticks),
        }
    }

    /// What is not sent any more is a loss where it would have stood. Returns the frames of each channel that count as such only by
    /// being lost: those that others sent.
    fn give_up(&mut self, items: Vec<Item>, outbox: &Outbox) -> [u32; CHANNELS] {
        let mut others = [0; CHANNELS];
        let mut lost = Gap::default();
        for item in items {
            match item {
                Item::Chunk(chunk) => {
                    for entry in chunk.iter() {
                        let Some(record) = shown(entry, self.client, &self.views) else { continue };
                        let channel = lost.absorb(entry.ticks, &record);
                        if let Some(channel) = channel {
                            outbox.count_lost(channel);
                        }
                        if let Some(channel) = channel.filter(|_| record.received_on().is_none()) {
                            others[channel.index()] += 1;
                        }
                    }
                }
                Item::Gap(gap) => lost.join(gap),
                other => {
                    self.take(Item::Gap(std::mem::take(&mut lost)));
                    self.take(other);
                }
            }
        }
        others
    }

    fn stop(&mut self, channel: Channel, ticks: u64) {
        if self.views[channel.index()].config.take().is_some() {
            self.stream.event(ticks.max(self.stream.last_ticks()), Event::Stopped { channel });
        }
    }

    fn end(&mut self, reason: EndReason, ticks: u64) {
        for channel in Channel::ALL {
            self.stop(channel, ticks);
        }
        self.stream.end(reason, ticks);
    }
}
