//! The trace of a report: read once to know that it can be, and packed whole or, if it is too large, its beginning.

use std::path::Path;

use anyhow::{Context, bail};
use cantap_formats::{Format, MemoryFile, ReadOptions, WriteOptions, create_stream_writer, open_reader};
use cantap_trace::TraceRecord;
use cantap_trace::diff::Profile;

use crate::page::Carried;

/// How many records are written between two looks at the size.
const BETWEEN_LOOKS: u64 = 4096;

/// What is known of a trace after reading it.
pub struct Read {
    /// What is compared with another trace.
    pub profile: Profile,
    /// Its records.
    pub records: u64,
    /// Its channels, from 1.
    pub channels: Vec<u8>,
}

/// What is in the page.
pub struct Trace {
    /// The file.
    pub file: Carried,
    /// What was left out, in sentences.
    pub thinned: Vec<String>,
}

/// Reads a trace. What of it cannot be read is said in the page, where the trace is read again.
pub fn read(path: &Path) -> anyhow::Result<Read> {
    let mut profile = Profile::default();
    let (mut records, mut channels) = (0, Vec::new());
    let rest = each(path, |record| {
        profile.add(record);
        records += 1;
        if !channels.contains(&record.channel) {
            channels.push(record.channel);
        }
        Ok(true)
    })?;
    if let Some(nothing) = rest {
        bail!(nothing);
    }
    channels.sort_unstable();
    Ok(Read { profile, records, channels })
}

/// Passes on the records until `take` returns false; at the end, why nothing was read, if so.
fn each(
    path: &Path,
    mut take: impl FnMut(&TraceRecord) -> anyhow::Result<bool>,
) -> anyhow::Result<Option<cantap_formats::NothingRead>> {
    let mut reader = open_reader(path, &ReadOptions::default())?;
    let mut batch = Vec::new();
    while let Some(next) = reader.next_batch(&mut batch) {
        // Only a disk that cannot be read is the end.
        if let Err(issue) = next {
            if let cantap_formats::Fault::Io(_) = issue.fault {
                return Err(issue).context("cannot read the trace");
            }
            continue;
        }
        for record in &batch {
            if !take(record)? {
                return Ok(None);
            }
        }
    }
    Ok(reader.nothing_read())
}

/// Packs the trace, in at most `room` bytes of the page.
pub fn carried(path: &Path, name: &str, read: &Read, room: u64) -> anyhow::Result<Trace> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let file = Carried::new(name, &bytes)?;
    if file.len() as u64 <= room {
        return Ok(Trace { file, thinned: Vec::new() });
    }
    // In base64, three bytes are four characters.
    beginning(path, name, read, room / 4 * 3)
}

/// As much of the beginning as fits, as a BLF: compressed, and every kind of frame is in it.
fn beginning(path: &Path, name: &str, read: &Read, room: u64) -> anyhow::Result<Trace> {
    let file = MemoryFile::default();
    let options = WriteOptions { format: Some(Format::Blf), ..WriteOptions::default() };
    let mut writer = create_stream_writer(Box::new(file.clone()), &options)?;
    let (mut written, mut first_ns, mut last_ns) = (0, None, 0);
    each(path, |record| {
        writer.write(record)?;
        written += 1;
        first_ns.get_or_insert(record.time_ns);
        last_ns = record.time_ns;
        if written % BETWEEN_LOOKS == 0 {
            writer.flush()?;
        }
        // What is begun now may take as much again as a look is apart.
        Ok(file.len() as u64 + 2 * BETWEEN_LOOKS * 16 < room)
    })?;
    let left_out = writer.finish()?;
    let bytes = file.take();
    if bytes.len() as u64 > room || written == 0 {
        bail!(
            "not even the beginning of {} fits into the page; allow more with --size-limit",
            path.display()
        );
    }
    let stem = name.split('.').next().unwrap_or(name);
    let seconds = last_ns - first_ns.unwrap_or(last_ns);
    let mut thinned = vec![format!(
        "Only the first {written} of {} records are in this page, {:.3} s of the trace: the others would make it larger than \
         --size-limit allows. So what can be saved out of it is a part of {name}, as BLF",
        read.records,
        seconds as f64 / 1e9
    )];
    thinned.extend(
        left_out.iter().map(|(what, count)| format!("The BLF in this page does not have {what} ({count})")),
    );
    Ok(Trace { file: Carried::new(&format!("{stem}-beginning.blf"), &bytes)?, thinned })
}
