//! A session with a device, shared by everything in this process that uses it.

use std::collections::HashMap;
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cantap::autobaud::{Limits, Outcome};
use cantap::device::{Ticks, Transmission};
use cantap::hw_filter::{self, Remainder};
use cantap::wire::Refusal;
use cantap::wire::message::{ChannelConfig, MAX_SEND, MAX_SEND_FD, TxFdFrame, TxFrame};
use cantap::{Channel, Device, DeviceError, TraceFrame};
use cantap_address::{Address, OpenDevice};
use cantap_trace::filter::Filter;
use cantap_work::bit_rate_search::{self, Search};

use super::fanout::Fanout;
use super::lock::lock;
use super::transmissions::{NOBODY, SenderId, Transmissions};
use crate::error::Error;

/// Tags wrap here: a device reserves those from `DEVICE_TAG` up for itself.
const TAGS: u32 = 0x7FFF_0000;
/// While the device's queue is full, sending is retried after this time.
const RETRY_AFTER: Duration = Duration::from_millis(1);

/// A session.
pub struct Session {
    /// Never dropped in a process other than the one that opened it, see [`Drop`].
    device: ManuallyDrop<OpenDevice>,
    pub address: String,
    pub is_car: bool,
    process: u32,
    pub fanout: Arc<Fanout>,
    pub transmissions: Arc<Transmissions>,
    next_tag: AtomicU32,
    /// Entries in use in the device's tables.
    slots: Mutex<HashMap<(SlotTable, Channel), Vec<bool>>>,
}

/// How frames are sent.
#[derive(Clone, Copy)]
pub struct HowToSend {
    /// Who has them sent.
    pub sender: SenderId,
    /// Not before this device time.
    pub at_ticks: Option<u64>,
    /// Whether the end of each can be awaited.
    pub is_told: bool,
    /// Until when to wait while the device's queue is full.
    pub deadline: Instant,
}

/// A table of what a device sends on its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum SlotTable {
    /// Periodic frames.
    Periodic,
    /// Replies.
    Replies,
}

impl Session {
    /// Begins a session with the device at an address.
    pub fn open(address: &str) -> Result<Self, Error> {
        let place = address.parse::<Address>().map_err(Error::argument)?;
        let device = place.open()?;
        let fanout = Arc::new(Fanout::default());
        let transmissions = Arc::new(Transmissions::new(device.transmissions()));
        let records = device.records();
        let (for_records, for_ends) = (Arc::clone(&fanout), Arc::clone(&transmissions));
        spawn("cantap-records", move || for_records.pump(records, &for_ends))?;
        Ok(Self {
            device: ManuallyDrop::new(device),
            address: address.to_owned(),
            is_car: place.is_car(),
            process: std::process::id(),
            fanout,
            transmissions,
            next_tag: AtomicU32::new(1),
            slots: Mutex::default(),
        })
    }

    /// The device, in the process that opened it: after a fork, the thread that reads it is in the other
    /// process.
    pub fn device(&self) -> Result<&Device, Error> {
        if self.process == std::process::id() {
            Ok(&self.device)
        } else {
            Err(Error::other_process(&self.address))
        }
    }

    /// The bit rate of a channel's bus in bit/s, if it is known without listening.
    pub fn bitrate_of_bus(&self, channel: Channel) -> Option<u32> {
        self.device.bitrate_of_bus(channel)
    }

    /// Finds the bit rate of a closed channel's bus, in bit/s, without sending anything.
    pub fn find_bitrate(
        &self,
        channel: Channel,
        silence: Duration,
        mut go_on: impl FnMut() -> Result<(), Error>,
    ) -> Result<u32, Error> {
        let device = self.device()?;
        if !bit_rate_search::is_possible(device) {
            return Err(Error::Address(format!(
                "'{}' cannot measure a bit rate: it does not report what its receive pin does; give bitrate=",
                self.address
            )));
        }
        if device.open_channels().iter().any(|(open, _)| *open == channel) {
            return Err(Error::argument(format!(
                "channel {0} is open; close it first: close_channel({0})",
                channel.number()
            )));
        }
        let started = Instant::now();
        let mut stopped = None;
        // What is received on the way was not asked for.
        self.fanout.ignore_until(channel, i64::MAX);
        let found = bit_rate_search::search(device, channel, &Limits { silence }, &mut |_| {
            stopped = go_on().err();
            stopped.is_none()
        });
        let now_ns = device.time().map(|ticks| device.clock_map().utc(Ticks(ticks)).0);
        self.fanout.ignore_until(channel, *now_ns.as_ref().unwrap_or(&0));
        if let Some(error) = stopped {
            return Err(error);
        }
        now_ns?;
        let found = found?;
        match found {
            Search::Confirmed { bitrate_bps } | Search::Measured(Outcome::Found { bitrate_bps, .. }) => {
                Ok(bitrate_bps)
            }
            Search::Measured(outcome) => {
                let seconds = started.elapsed().as_secs_f64();
                Err(Error::Address(bit_rate_search::failure(outcome, channel.number(), seconds)))
            }
        }
    }

    /// Opens a channel; returns what its filters leave to this computer.
    pub fn open_channel(
        &self,
        channel: Channel,
        config: ChannelConfig,
        filters: &[Filter],
    ) -> Result<Option<Remainder>, Error> {
        let device = self.device()?;
        let compiled = hw_filter::apply(device, channel, filters)?;
        // This must be set before the first frame arrives.
        self.fanout.set_filters(channel, filters.to_vec());
        device.open_channel(channel, Some(config))?;
        Ok(compiled.remainder)
    }

    /// Closes a channel and opens it as it was, with other filters: its hardware cannot be given others while it is open. What was on
    /// the bus in between is missing, and a loss says so.
    pub fn reopen(&self, channel: Channel, filters: &[Filter]) -> Result<(), Error> {
        let device = self.device()?;
        let open = device.open_channels().into_iter().find(|(open, _)| *open == channel);
        let Some((_, config)) = open else {
            return Err(Error::Address(format!("channel {} is not open", channel.number())));
        };
        device.close_channel(channel)?;
        let closed_at = device.time()?;
        self.fanout.add_gap(channel, device.clock_map().utc(Ticks(closed_at)).0);
        self.open_channel(channel, config, filters)?;
        Ok(())
    }

    /// Passes frames to the device. While its queue is full, it waits until the deadline, as long as `go_on` returns no error.
    pub fn send(
        &self,
        channel: Channel,
        frames: &[TraceFrame],
        how: HowToSend,
        mut go_on: impl FnMut() -> Result<(), Error>,
    ) -> Result<Sending, Error> {
        let HowToSend { sender, at_ticks, is_told, deadline } = how;
        let device = self.device()?;
        let mut sending = Sending { transmissions: Arc::clone(&self.transmissions), ends: Vec::new() };
        if frames.iter().any(TraceFrame::is_fd) && !device.hello().sends_fd() {
            return Err(DeviceError::NoFd.into());
        }
        // A request has frames of one kind.
        let most = |frame: &TraceFrame| if frame.is_fd() { MAX_SEND_FD } else { MAX_SEND };
        let runs = frames.chunk_by(|one, next| one.is_fd() == next.is_fd());
        for chunk in runs.flat_map(|run| run.chunks(most(&run[0]))) {
            let mut tags = Vec::with_capacity(chunk.len());
            for _ in chunk {
                let tag = self.next_tag.fetch_add(1, Ordering::Relaxed) % TAGS;
                if is_told {
                    let (told, end) = sync_channel(1);
                    self.transmissions.wait_for(tag, told);
                    sending.ends.push((tag, end));
                }
                self.transmissions.requested(channel, tag, sender);
                tags.push(tag);
            }
            while let Err(error) = hand_over(device, channel, chunk, &tags, at_ticks) {
                let is_full = matches!(error, DeviceError::Refused { refusal: Refusal::QueueFull { .. } });
                if !is_full || Instant::now() >= deadline {
                    for tag in tags {
                        self.transmissions.requested(channel, tag, NOBODY);
                    }
                    return Err(error.into());
                }
                go_on()?;
                std::thread::sleep(RETRY_AFTER);
            }
        }
        Ok(sending)
    }

    /// Takes a free entry of a table.
    pub fn take_slot(&self, table: SlotTable, channel: Channel) -> Result<u8, Error> {
        let hello = self.device()?.hello();
        let (count, what) = match table {
            SlotTable::Periodic => (hello.periodic_slots, "periodic frames"),
            SlotTable::Replies => (hello.trigger_slots, "replies"),
        };
        let mut slots = lock(&self.slots);
        let slots = slots.entry((table, channel)).or_insert_with(|| vec![false; usize::from(count)]);
        let Some(free) = slots.iter().position(|taken| !taken) else {
            return Err(Error::Address(format!(
                "the device has room for {count} {what} per channel; stop one first"
            )));
        };
        slots[free] = true;
        Ok(free as u8)
    }

    /// Gives it back.
    pub fn free_slot(&self, table: SlotTable, channel: Channel, slot: u8) {
        if let Some(slots) = lock(&self.slots).get_mut(&(table, channel)) {
            slots[usize::from(slot)] = false;
        }
    }
}

/// Passes frames of one kind to a device.
fn hand_over(
    device: &Device,
    channel: Channel,
    frames: &[TraceFrame],
    tags: &[u32],
    at_ticks: Option<u64>,
) -> Result<u16, DeviceError> {
    let all = || frames.iter().zip(tags);
    if frames.first().is_some_and(TraceFrame::is_fd) {
        let fd =
            |(frame, tag): (&TraceFrame, &u32)| Some(TxFdFrame { tag: *tag, frame: *frame.fd()?, at_ticks });
        device.send_fd(channel, &all().filter_map(fd).collect::<Vec<_>>())
    } else {
        let classic = |(frame, tag): (&TraceFrame, &u32)| {
            Some(TxFrame { tag: *tag, frame: *frame.classic()?, at_ticks })
        };
        device.send(channel, &all().filter_map(classic).collect::<Vec<_>>())
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), Error> {
    let thread = std::thread::Builder::new().name(name.to_owned()).spawn(work);
    thread.map(drop).map_err(|error| Error::Device(DeviceError::Thread(error)))
}

impl Drop for Session {
    /// Leaves the bus. A copy of the session in a forked process does nothing: the port belongs to the other process, and so does
    /// the thread that would have to be joined.
    fn drop(&mut self) {
        if self.process == std::process::id() {
            // SAFETY: nothing uses it after this.
            unsafe { ManuallyDrop::drop(&mut self.device) };
        }
    }
}

/// Frames passed to the device.
pub struct Sending {
    transmissions: Arc<Transmissions>,
    /// In the order in which they were passed.
    ends: Vec<(u32, Receiver<Transmission>)>,
}

impl Sending {
    /// How the frames ended, in order. `None` if one has not ended by `deadline`.
    pub fn wait(
        &self,
        deadline: Instant,
        slice: Duration,
        mut go_on: impl FnMut() -> Result<(), Error>,
    ) -> Result<Option<Vec<Transmission>>, Error> {
        let mut ended = Vec::with_capacity(self.ends.len());
        for (_, end) in &self.ends {
            loop {
                let left = deadline.saturating_duration_since(Instant::now());
                match end.recv_timeout(left.min(slice)) {
                    Ok(end) => {
                        ended.push(end);
                        break;
                    }
                    Err(RecvTimeoutError::Timeout) if left.is_zero() => return Ok(None),
                    Err(RecvTimeoutError::Timeout) => go_on()?,
                    Err(RecvTimeoutError::Disconnected) => {
                        return Err(Error::Address(
                            "the device is gone; what became of the frame is not known".to_owned(),
                        ));
                    }
                }
            }
        }
        Ok(Some(ended))
    }
}

impl Drop for Sending {
    fn drop(&mut self) {
        self.transmissions.forget(&self.ends.iter().map(|(tag, _)| *tag).collect::<Vec<_>>());
    }
}
