//! Uses a trace file as the traffic of the simulated buses.

use std::path::Path;

use cantap_wire::{CHANNELS, Frame};

use super::options::{BadOption, Options};
use cantap_formats::{ReadOptions, open_reader};
use cantap_trace::{TraceEvent, TraceFrame};

impl Options {
    /// Replays a trace file with its own timing instead of made-up frames: channel 1 of the file on the first
    /// bus, 2 on the second. The file's first frame is at time zero, which is when a channel is opened.
    pub fn read_log(&mut self, path: &Path) -> Result<(), BadOption> {
        let bad = |reason: String| BadOption::Value {
            key: "log".to_owned(),
            value: path.display().to_string(),
            reason,
        };
        let reader = open_reader(path, &ReadOptions { strict: true, ..ReadOptions::default() })
            .map_err(|error| bad(error.to_string()))?;
        let mut log: [Vec<(u64, Frame)>; CHANNELS] = [Vec::new(), Vec::new()];
        let mut start_ns = None;
        for record in reader {
            let record = record.map_err(|issue| bad(issue.to_string()))?;
            let TraceEvent::Frame { frame: TraceFrame::Classic(frame), .. } = record.event else { continue };
            let start_ns = *start_ns.get_or_insert(record.time_ns);
            if let Some(entries) = log.get_mut(usize::from(record.channel.saturating_sub(1))) {
                let at_ns = u64::try_from(record.time_ns.saturating_sub(start_ns)).unwrap_or(0);
                entries.push((at_ns, frame));
            }
        }
        self.log = Some(log);
        Ok(())
    }
}
