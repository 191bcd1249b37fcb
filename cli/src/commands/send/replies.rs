//! Replies: the device sends them on its own, and says how each ended, but not which frames it saw. Those are counted here, so that a
//! reply that never gets onto the bus does not look like none that was asked for.

use std::fmt::Write as _;
use std::time::Duration;

use cantap::device::{Records, Ticks, Transmission};
use cantap::transmit::Stream;
use cantap::unsent::PATIENCE;
use cantap::wire::message::{Filter as HardwareFilter, FrameKind, OTHERS_TAG, TRIGGER_TAG, Trigger};
use cantap::{Channel, Device, Direction, Frame, Id, TraceEvent, TraceFrame, TraceRecord};

use cantap_work::sending::{LOOK_EVERY, Sending};

/// What became of one reply's matches.
struct Entry {
    trigger: Trigger,
    /// Frames received that should be answered.
    matches: u64,
    sent: u64,
    /// Ended otherwise.
    failed: u64,
    last_match_ns: i64,
    last_end_ns: i64,
}

/// The replies' total.
pub struct Counts {
    /// Frames that should have been answered, without those whose reply was taken back at the end.
    pub asked: u64,
    /// Those not answered because the reply to the one before was still waiting.
    pub merged: u64,
}

/// Replies in the device's slots from 0.
pub struct Replies<'d> {
    device: &'d Device,
    channel: Channel,
    stream: Stream<'d>,
    records: Records,
    entries: Vec<Entry>,
    /// Frames count from this time to that, in nanoseconds since the Unix epoch: while the device surely had the entries.
    from_ns: i64,
    until_ns: i64,
}

impl<'d> Replies<'d> {
    /// Has the device reply.
    pub fn set(device: &'d Device, channel: Channel, triggers: Vec<Trigger>) -> anyhow::Result<Self> {
        let (stream, records) = (Stream::new(device), device.records());
        for (slot, trigger) in (0..).zip(&triggers) {
            device.set_trigger(channel, slot, Some(*trigger))?;
        }
        let entry =
            |trigger| Entry { trigger, matches: 0, sent: 0, failed: 0, last_match_ns: 0, last_end_ns: 0 };
        let entries = triggers.into_iter().map(entry).collect();
        let mut replies = Self { device, channel, stream, records, entries, from_ns: 0, until_ns: i64::MAX };
        replies.from_ns = replies.now_ns()?;
        Ok(replies)
    }

    fn now_ns(&self) -> anyhow::Result<i64> {
        let ticks = self.device.time()?;
        Ok(self.device.clock_map().utc(Ticks(ticks)).0)
    }

    /// Watches until it is over or stands still, clears the entries, and waits for what is on its way.
    pub fn watch(
        &mut self,
        sending: &mut Sending<'d>,
        is_over: impl Fn(&Sending<'d>) -> bool,
    ) -> anyhow::Result<()> {
        while !is_over(sending) {
            let ends = self.next(sending, LOOK_EVERY)?;
            if !sending.device_goes_on(&ends) {
                break;
            }
        }
        sending.check()?;
        self.until_ns = self.now_ns()?;
        for slot in (0..).take(self.entries.len()) {
            self.device.set_trigger(self.channel, slot, None)?;
        }
        sending.settle(self.channel, |sending| self.next(sending, LOOK_EVERY))?;
        Ok(())
    }

    /// Waits a moment for transmissions to end, and counts what was received meanwhile.
    fn next(&mut self, sending: &mut Sending<'_>, wait: Duration) -> anyhow::Result<Vec<Transmission>> {
        self.stream.wait(wait)?;
        while let Some(batch) = self.records.next_batch(Duration::ZERO)?.filter(|batch| !batch.is_empty()) {
            sending.take(&batch);
            for record in &batch {
                self.take(record);
            }
            self.records.recycle(batch);
        }
        let mut ends = self.stream.take_ended();
        // On a shared board, what other programs sent is no reply of ours.
        ends.retain(|end| end.channel == self.channel && end.tag >= TRIGGER_TAG && end.tag != OTHERS_TAG);
        for end in &ends {
            let slot = (end.tag - TRIGGER_TAG) as usize;
            let Some(entry) = self.entries.get_mut(slot) else { continue };
            *(if end.result.is_ok() { &mut entry.sent } else { &mut entry.failed }) += 1;
            entry.last_end_ns = end.time_ns;
        }
        Ok(ends)
    }

    fn take(&mut self, record: &TraceRecord) {
        let TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction: Direction::Rx, .. } =
            record.event
        else {
            return;
        };
        if record.channel != self.channel.number()
            || !(self.from_ns..=self.until_ns).contains(&record.time_ns)
        {
            return;
        }
        for entry in &mut self.entries {
            entry.take(&frame, record.time_ns);
        }
    }

    /// The total.
    pub fn counts(&self) -> Counts {
        let fates = self.entries.iter().map(|entry| entry.fate(self.until_ns));
        fates.fold(Counts { asked: 0, merged: 0 }, |sum, fate| Counts {
            asked: sum.asked + fate.asked - fate.withdrawn,
            merged: sum.merged + if fate.is_stuck { 0 } else { fate.left_out - fate.failed },
        })
    }

    /// One object per reply.
    pub fn objects(&self) -> serde_json::Value {
        let object = |entry: &Entry| {
            let Fate { asked, left_out, withdrawn, .. } = entry.fate(self.until_ns);
            serde_json::json!({
                "frame": entry.trigger.reply.to_string(),
                "on": filter_text(&entry.trigger.filter),
                "matches": entry.matches,
                "asked": asked,
                "sent": entry.sent,
                "left_out": left_out,
                "withdrawn": withdrawn,
            })
        };
        self.entries.iter().map(object).collect()
    }

    /// The same on standard error, for people.
    pub fn tell(&self) {
        for entry in &self.entries {
            let Fate { left_out, withdrawn, .. } = entry.fate(self.until_ns);
            let (on, frame) = (filter_text(&entry.trigger.filter), entry.trigger.reply);
            let mut text = format!("{frame} on {on}: {} matches, {} sent", entry.matches, entry.sent);
            for (count, kind) in [(left_out, "left out"), (withdrawn, "taken back at the end")] {
                if count > 0 {
                    let _ = write!(text, ", {count} {kind}");
                }
            }
            eprintln!("cantap: {text}");
        }
    }
}

/// What became of an entry's matches.
struct Fate {
    asked: u64,
    /// Asked for, but not sent.
    left_out: u64,
    /// Of these, those that the device reported as failed.
    failed: u64,
    /// Its turn had not come yet when it was taken back: 0 or 1.
    withdrawn: u64,
    /// It waited for so long that it must have been stuck.
    is_stuck: bool,
}

impl Entry {
    fn take(&mut self, frame: &Frame, time_ns: i64) {
        let is_wanted = self.trigger.count == 0 || self.matches < u64::from(self.trigger.count);
        if is_wanted && self.trigger.filter.matches(frame) {
            self.matches += 1;
            // The oldest of those that wait.
            if self.last_match_ns <= self.last_end_ns {
                self.last_match_ns = time_ns;
            }
        }
    }

    fn fate(&self, until_ns: i64) -> Fate {
        // Matches at the very beginning and end are not counted, although they may be answered.
        let asked = self.matches.max(self.sent + self.failed);
        let unanswered = asked - self.sent - self.failed;
        let waits = unanswered > 0 && self.last_match_ns > self.last_end_ns;
        let waited_ns = until_ns.saturating_sub(self.last_match_ns);
        let is_stuck = waits && waited_ns >= PATIENCE.as_nanos() as i64;
        let withdrawn = u64::from(waits && !is_stuck);
        Fate { asked, left_out: asked - self.sent - withdrawn, failed: self.failed, withdrawn, is_stuck }
    }
}

/// As candump writes it.
fn filter_text(filter: &HardwareFilter) -> String {
    let HardwareFilter { extended, kind, id, mask } = *filter;
    let widest = if extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
    let digits = if extended { 8 } else { 3 };
    let mask = if mask == widest { String::new() } else { format!(":{mask:X}") };
    let kind = match kind {
        FrameKind::Any => "",
        FrameKind::Data => " data",
        FrameKind::Remote => " remote",
    };
    format!("{id:0digits$X}{mask}{kind}")
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn entry(count: u32, matches_ms: &[i64]) -> Entry {
        let filter = HardwareFilter { extended: false, kind: FrameKind::Any, id: 0x7E0, mask: 0x7FF };
        let trigger = Trigger { filter, reply: "7E8#".parse().unwrap(), count };
        let mut entry = Entry { trigger, matches: 0, sent: 0, failed: 0, last_match_ns: 0, last_end_ns: 0 };
        for ms in matches_ms {
            entry.take(&"7E0#".parse().unwrap(), ms * MS);
            entry.take(&"7E1#".parse().unwrap(), ms * MS);
        }
        entry
    }

    #[test]
    fn a_reply_that_never_left_was_asked_for() {
        let fate = entry(0, &[100, 200, 300]).fate(5_000 * MS);
        assert_eq!((fate.asked, fate.left_out, fate.withdrawn, fate.is_stuck), (3, 3, 0, true));
        // Its turn had just come.
        let fate = entry(0, &[4_990]).fate(5_000 * MS);
        assert_eq!((fate.asked, fate.left_out, fate.withdrawn, fate.is_stuck), (1, 0, 1, false));
    }

    #[test]
    fn matches_are_answered_or_merged_or_more_than_were_wanted() {
        let mut some = entry(0, &[100, 101, 102]);
        (some.sent, some.last_end_ns) = (2, 103 * MS);
        let fate = some.fate(5_000 * MS);
        assert_eq!((fate.asked, fate.left_out, fate.withdrawn, fate.is_stuck), (3, 1, 0, false));
        let mut limited = entry(2, &[100, 101, 102]);
        (limited.sent, limited.last_end_ns) = (2, 103 * MS);
        assert_eq!((limited.matches, limited.fate(5_000 * MS).left_out), (2, 0));
        // One that was answered while its match was not counted.
        let mut early = entry(0, &[]);
        early.sent = 1;
        assert_eq!((early.fate(MS).asked, early.fate(MS).left_out), (1, 0));
    }

    #[test]
    fn filters_are_named_as_candump_does() {
        let filter = |extended, kind, id, mask| filter_text(&HardwareFilter { extended, kind, id, mask });
        assert_eq!(filter(false, FrameKind::Any, 0x7E0, 0x7FF), "7E0");
        assert_eq!(filter(true, FrameKind::Remote, 0x7E0, 0x1FFF_FFF0), "000007E0:1FFFFFF0 remote");
    }
}
