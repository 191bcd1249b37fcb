//! What clients of foreign protocols have in common: they are written to in pieces, at a pace, and are told of every loss in front of them, or
//! else whoever runs the server is.

use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use cantap::device::Records;
use cantap::{Device, TraceEvent, TraceRecord};
use cantap_wire::CHANNELS;
use cantap_wire::record::LossStage;

use crate::Board;
use crate::pace::Pace;

/// How long to wait for records before checking whether the client is still there.
const WAIT: Duration = Duration::from_millis(20);

/// A board that a client receives.
pub struct Source {
    board: Arc<Board>,
    device: Arc<Device>,
    records: Records,
    /// Frames of each channel that found no room in front of the client, as far as the board's totals have them.
    counted: [u64; CHANNELS],
    /// Frames of whose loss the client was told.
    reported: u64,
    /// Frames of whose loss it is told by what is written next.
    being_reported: u64,
}

impl Source {
    /// Everything that the device receives from now on.
    pub fn new(board: &Arc<Board>, device: &Arc<Device>) -> Self {
        Self {
            board: Arc::clone(board),
            device: Arc::clone(device),
            records: device.records(),
            counted: [0; CHANNELS],
            reported: 0,
            being_reported: 0,
        }
    }

    /// Adds to the board's totals what was lost here since the last time.
    fn count_losses(&mut self) {
        let lost = self.records.lost();
        let new = std::array::from_fn(|channel| lost[channel].saturating_sub(self.counted[channel]));
        self.counted = lost;
        if new != [0; CHANNELS] {
            self.board.count_lost(new);
        }
    }

    /// The client was given records.
    fn tells(&mut self, records: &[TraceRecord], losses: Losses) {
        let lost = records.iter().map(|record| match record.event {
            TraceEvent::Lost { stage: Some(LossStage::Host), count, .. } => u64::from(count),
            _ => 0,
        });
        match losses {
            Losses::ToldByWriting => self.being_reported += lost.sum::<u64>(),
            Losses::LeftOut => self.reported += lost.sum::<u64>(),
            Losses::NotTold => {}
        }
    }

    fn has_written(&mut self) {
        self.reported += std::mem::take(&mut self.being_reported);
    }

    /// Frames lost in front of the client of which it was not told.
    fn unreported(&self) -> u64 {
        let counters = self.device.counters();
        let lost: u64 = counters.channels.iter().map(|channel| channel.lost_host).sum();
        lost.saturating_sub(self.reported)
    }
}

/// How a client learns of the losses among the records that it was given.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Losses {
    /// They are in what is written next.
    ToldByWriting,
    /// Its protocol has no message for them: they are counted among what is left out.
    LeftOut,
    /// It does not receive them now.
    NotTold,
}

/// What becomes of the records.
pub trait Feed {
    /// Whether the client has gone.
    fn is_over(&mut self) -> bool;

    /// Takes a source's records; `source` is its place among them.
    fn take(&mut self, source: usize, records: &[TraceRecord]) -> Losses;

    /// Whether there is nothing to write.
    fn is_empty(&self) -> bool;

    /// Writes what there is. After an error, the client has gone.
    fn write(&mut self) -> io::Result<()>;
}

/// Feeds a client until it has gone, or a board or the server has. Returns how many frames were lost in front of it without its being told.
pub fn run(sources: &mut [Source], feed: &mut impl Feed) -> u64 {
    let mut pace = Pace::default();
    let each = WAIT / u32::try_from(sources.len()).unwrap_or(1).max(1);
    'feeding: while !feed.is_over() {
        for (number, source) in sources.iter_mut().enumerate() {
            let wait = if feed.is_empty() { each } else { pace.left(Instant::now()) };
            let Ok(Some(batch)) = source.records.next_batch(wait) else { break 'feeding };
            let losses = feed.take(number, &batch);
            source.tells(&batch, losses);
            source.records.recycle(batch);
            source.count_losses();
        }
        if feed.is_empty() || !pace.left(Instant::now()).is_zero() {
            continue;
        }
        if feed.write().is_err() {
            break;
        }
        sources.iter_mut().for_each(Source::has_written);
        pace.has_written(Instant::now());
    }
    let unreported = sources.iter().map(Source::unreported).sum();
    sources.iter_mut().for_each(Source::count_losses);
    unreported
}
