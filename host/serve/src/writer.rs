//! The thread that writes to one client: whatever is waiting, encoded for the client's view of the channels.

use std::io::Write;
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::MAX_ENCODED;
use cantap_wire::message::EndReason;
use cantap_wire::record::{MAX_RECORD, Record, encode_event, encode_received};
use cantap_wire::{CHANNELS, Channel, Event, Stamp};

use crate::outbox::{Item, Outbox};
use crate::stream::{ClientId, Gap, Views, shown};

/// How often to check whether the connection is over while there is nothing to write.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// A client that takes nothing for this long is gone: a peer that was switched off sends nothing.
const PATIENCE: Duration = Duration::from_secs(30);
const TOOK_NOTHING: &str = "it took nothing for 30 s";

/// Writes until nothing follows. An error says why the client is dropped.
pub fn run(outbox: &Outbox, output: &mut dyn Write, client: ClientId) -> Result<(), String> {
    let mut encoder = Encoder::new(client);
    let mut moved = Instant::now();
    loop {
        let work = outbox.take(LOOK_EVERY);
        for answer in &work.answers {
            // An earlier batch may have been read only in part.
            encoder.out.push(0);
            encoder.out.extend_from_slice(answer);
        }
        if !work.given_up.is_empty() {
            outbox.give_up(encoder.give_up(work.given_up));
        }
        for item in work.items {
            encoder.take(item);
        }
        encoder.finish();
        if !encoder.out.is_empty() || !outbox.is_held_up() {
            moved = Instant::now();
        } else if moved.elapsed() >= PATIENCE {
            return Err(TOOK_NOTHING.to_owned());
        }
        write(output, &encoder.out, outbox)?;
        outbox.wrote(encoder.out.len());
        encoder.out.clear();
        if work.is_last {
            return Ok(());
        }
    }
}

fn write(output: &mut dyn Write, mut bytes: &[u8], outbox: &Outbox) -> Result<(), String> {
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
                if moved.elapsed() >= PATIENCE {
                    return Err(TOOK_NOTHING.to_owned());
                }
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
    batch: Box<BatchWriter>,
    /// Time of the last record, or of the session's beginning.
    last_ticks: u64,
    views: Views,
    client: ClientId,
    out: Vec<u8>,
}

impl Encoder {
    fn new(client: ClientId) -> Self {
        Self {
            batch: Box::new(BatchWriter::new()),
            last_ticks: 0,
            views: Views::default(),
            client,
            out: Vec::new(),
        }
    }

    fn take(&mut self, item: Item) {
        match item {
            Item::Restart(answer, ticks) => {
                self.batch.restart();
                self.last_ticks = ticks;
                self.views = Views::default();
                self.out.push(0);
                self.out.extend_from_slice(&answer);
            }
            Item::Attach(channel, view, ticks) => {
                self.views[channel.index()] = view;
                self.event(ticks, Event::Started { channel });
            }
            Item::Detach(channel, ticks, _) => self.stop(channel, ticks),
            Item::Chunk(chunk) => {
                for entry in chunk.iter() {
                    if let Some(record) = shown(entry, self.client, &self.views) {
                        self.record(entry.ticks, &record);
                    }
                }
            }
            Item::Gap(gap) => {
                for (ticks, event) in gap.events() {
                    self.event(ticks, event);
                }
            }
            Item::Answer(answer) => {
                self.finish();
                self.out.push(0);
                self.out.extend_from_slice(&answer);
            }
            Item::Ended(reason, ticks) => self.end(reason, ticks),
        }
    }

    /// What is not sent any more is a loss where it would have stood. Returns the frames of each channel that count as such only by
    /// being lost: those that others sent.
    fn give_up(&mut self, items: Vec<Item>) -> [u32; CHANNELS] {
        let mut others = [0; CHANNELS];
        let mut lost = Gap::default();
        for item in items {
            match item {
                Item::Chunk(chunk) => {
                    for entry in chunk.iter() {
                        let Some(record) = shown(entry, self.client, &self.views) else { continue };
                        let channel = lost.absorb(entry.ticks, &record);
                        if let Some(channel) = channel.filter(|_| !matches!(record, Record::Received(_))) {
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
            self.event(ticks.max(self.last_ticks), Event::Stopped { channel });
        }
    }

    fn end(&mut self, reason: EndReason, ticks: u64) {
        for channel in Channel::ALL {
            self.stop(channel, ticks);
        }
        self.finish();
        let at = self.out.len();
        self.out.resize(at + MAX_ENCODED, 0);
        let len = self.batch.end(reason, ticks.max(self.last_ticks), &mut self.out[at..]);
        self.out.truncate(at + len);
    }

    fn event(&mut self, ticks: u64, event: Event) {
        self.record(ticks, &Record::Event(event));
    }

    fn record(&mut self, ticks: u64, record: &Record) {
        let mut bytes = [0; MAX_RECORD];
        let difference = ticks.wrapping_sub(self.last_ticks) as i64;
        let (len, frame_of, is_stamped) = match record {
            Record::Received(received) => (
                encode_received(received, difference, &mut bytes),
                Some(received.channel),
                received.stamp != Stamp::Omitted,
            ),
            Record::Event(event) => (encode_event(event, difference, &mut bytes), None, true),
        };
        if !self.batch.push(&bytes[..len], self.last_ticks, frame_of) {
            self.finish();
            // This cannot fail: any record fits in an empty batch.
            let _ = self.batch.push(&bytes[..len], self.last_ticks, frame_of);
        }
        if is_stamped {
            self.last_ticks = ticks;
        }
    }

    /// Writes the current batch.
    fn finish(&mut self) {
        let at = self.out.len();
        self.out.resize(at + MAX_ENCODED, 0);
        let len = self.batch.finish(&mut self.out[at..]);
        self.out.truncate(at + len);
    }
}
