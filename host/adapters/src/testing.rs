//! What a test hears from a session.

use cantap::device::Device;
use cantap_trace::TraceRecord;

/// Records up to a frame, given as text, included.
pub(crate) fn until(device: &Device, frame: &str) -> Vec<TraceRecord> {
    let mut all = Vec::new();
    for record in device.records() {
        let record = record.unwrap();
        let is_last = record.frame().is_some_and(|there| there.to_string() == frame);
        all.push(record);
        if is_last {
            break;
        }
    }
    all
}

/// The frames among records, as texts, with their channels.
pub(crate) fn frames(records: &[TraceRecord]) -> Vec<(u8, String)> {
    let frame = |record: &TraceRecord| Some((record.channel, record.frame()?.to_string()));
    records.iter().filter_map(frame).collect()
}
