//! A drive that watches our heartbeat while it moves.

use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use cantap_protocols::active::heartbeat::HeartbeatProducer;
use cantap_protocols::active::sdo::{SdoClient, SdoIds, SdoJob};

use super::watched::{Guarded, run};
use super::{Drive, nanoseconds};

/// Our heartbeat, which the drive watches during a motion: if this computer or the cable to it is gone, the drive ends the motion by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Guard {
    /// Whose heartbeat is sent: a number that no node has.
    pub node: u8,
    /// For how long the drive may hear nothing, in whole milliseconds up to 65535.
    pub within: Duration,
}

/// How many heartbeats are sent in the time after which the drive takes action.
const BEATS: u32 = 4;
/// For how long is listened, at least and at most, whether the number is free.
const LISTENS: [Duration; 2] = [Duration::from_millis(500), Duration::from_secs(2)];
/// What the drive consumes: for each entry the node and the time (CiA 301).
const CONSUMER_HEARTBEAT: u16 = 0x1016;
/// What the drive does when its connection is lost (CiA 402).
const ABORT_CONNECTION: u16 = 0x6007;

impl Drive<'_, '_> {
    /// Has the drive watch our heartbeat from now to the end of the motion. Returns what that changes, in words.
    ///
    /// # Errors
    /// Another node has the number; the drive has no room for it, or does nothing when its connection is lost.
    pub fn guard(&mut self, guard: Guard) -> anyhow::Result<String> {
        let (node, own) = (self.node, guard.node);
        let within_ms = u16::try_from(guard.within.as_millis()).ok().filter(|ms| *ms > 0);
        let within_ms = within_ms.context("the time of a guard is from 1 ms to 65535 ms")?;
        let producer = HeartbeatProducer::new(own, nanoseconds(guard.within / BEATS));
        let producer = producer.context("nodes have numbers from 1 to 127")?;
        self.speaking.listen(guard.within.clamp(LISTENS[0], LISTENS[1]))?;
        let is_there = self.heard.get() >> own & 1 == 1;
        anyhow::ensure!(
            own != node && !is_there,
            "node {own} is there; give --guard-node a number that no node has"
        );
        let option = self.client.object(ABORT_CONNECTION);
        let reaction = match self.read(option, 0) {
            Ok(0) => bail!(
                "node {node} does nothing when its connection is lost (object {option:04X} is 0), so a guard is of no use; change that first"
            ),
            Ok(number) => {
                let names = ["", "fault", "disable voltage", "quick stop"];
                let name =
                    names.get(number as u16 as usize).map_or_else(String::new, |name| format!(" ({name})"));
                format!("what it then does is {}{name}, by object {option:04X}", number as u16 as i16)
            }
            Err(_) => format!("what it then does is up to it: it has no object {option:04X}"),
        };
        let entries =
            self.read(CONSUMER_HEARTBEAT, 0).with_context(|| format!("node {node} watches no heartbeats"))?;
        for sub in 1..=entries.min(127) as u8 {
            let before = self.read(CONSUMER_HEARTBEAT, sub)?;
            // An entry without a time or a node is free, and so is one that an earlier guard has left.
            let (of, time) = (before >> 16 & 0x7F, before & 0xFFFF);
            if of != 0 && time != 0 && of != u32::from(own) {
                continue;
            }
            let value = u32::from(own) << 16 | u32::from(within_ms);
            self.write_entry(sub, value, false)?;
            (self.guarded, self.heartbeat) = (Some(Guarded { sub, before }), Some(producer));
            return Ok(format!(
                "node {node} watches the heartbeat of node {own}, which is sent from here: after {within_ms} ms without it, it ends the motion \
                 ({reaction}); object {CONSUMER_HEARTBEAT:04X}:{sub:02X} was {before:08X} and is {value:08X} until the end"
            ));
        }
        bail!("node {node} already watches {entries} heartbeats, and has no room for another")
    }

    /// Puts the entry back. Returns that in words; nothing without a guard.
    pub(super) fn unguard(&mut self) -> Option<String> {
        let Guarded { sub, before } = self.guarded.take()?;
        let text = match self.write_entry(sub, before, true) {
            Ok(()) => format!("object {CONSUMER_HEARTBEAT:04X}:{sub:02X} is {before:08X} again"),
            Err(error) => format!(
                "object {CONSUMER_HEARTBEAT:04X}:{sub:02X} could not be set back to {before:08X} ({error})"
            ),
        };
        self.heartbeat = None;
        Some(text)
    }

    /// A number of up to four bytes.
    fn read(&mut self, index: u16, sub: u8) -> anyhow::Result<u32> {
        let data = self.transfer(index, sub, SdoJob::Read, false)?;
        let mut bytes = [0; 4];
        let length = data.len().min(4);
        bytes[..length].copy_from_slice(&data[..length]);
        Ok(u32::from_le_bytes(bytes))
    }

    fn write_entry(&mut self, sub: u8, value: u32, is_last: bool) -> anyhow::Result<()> {
        let data = value.to_le_bytes().to_vec();
        self.transfer(CONSUMER_HEARTBEAT, sub, SdoJob::Write(data), is_last).map(drop)
    }

    fn transfer(&mut self, index: u16, sub: u8, job: SdoJob, is_last: bool) -> anyhow::Result<Vec<u8>> {
        let mut client = SdoClient::new(SdoIds::of(self.node), index, sub, job, false, self.answer_ns);
        run(self.speaking, self.heartbeat.as_mut(), &mut client, is_last)?;
        client.finish().map_err(|error| anyhow!("node {}: object {index:04X}:{sub:02X}: {error}", self.node))
    }
}
