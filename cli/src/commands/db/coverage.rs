//! How databases match a trace.

use std::collections::{BTreeMap, HashMap};
use std::io::Write;

use cantap::TraceRecord;
use cantap_analysis::stats::{IdStatistics, Options, Statistics};
use cantap_signals::{Decoder, MessageRef};
use cantap_trace::counted;
use serde_json::json;

use super::describe::header_id;
use crate::input::Records;

/// A cycle differs from the database's if it deviates by more than this fraction.
const TOLERANCE: f64 = 0.1;

/// An identifier in the trace.
struct Received {
    channel: u8,
    id: String,
    frames: u64,
    mean_ms: Option<f64>,
    max_ms: Option<f64>,
}

impl Received {
    fn of(channel: u8, id: &IdStatistics) -> Self {
        Self {
            channel,
            id: id.id.to_string(),
            frames: id.frames,
            mean_ms: id.period.mean_ns().map(|ns| ns / 1e6),
            max_ms: id.period.max_ns().map(|ns| ns as f64 / 1e6),
        }
    }
}

/// What containers had, by the message and the identifier in the header; those that a database knows are there from the start.
#[derive(Default)]
struct Contained(BTreeMap<(MessageRef, u32), u64>);

impl Contained {
    fn of(decoder: &Decoder) -> Self {
        let mut counts = BTreeMap::new();
        for (reference, _, message) in decoder.messages() {
            let pdus = message.container.iter().flat_map(|container| &container.pdus);
            counts.extend(pdus.map(|pdu| ((reference, pdu.header_id), 0)));
        }
        Self(counts)
    }

    fn push(&mut self, decoder: &Decoder, record: &TraceRecord) {
        let Some(frame) = record.frame().filter(|frame| !frame.is_remote() && !self.0.is_empty()) else {
            return;
        };
        let Some(reference) = decoder.find(record.channel, frame.id()) else { return };
        let Some(container) = &decoder.message(reference).container else { return };
        for part in container.parts(frame.data()) {
            // Damage makes ever new identifiers.
            const MOST: usize = 10_000;
            if self.0.len() < MOST || self.0.contains_key(&(reference, part.header_id)) {
                *self.0.entry((reference, part.header_id)).or_default() += 1;
            }
        }
    }

    /// Message, identifier in the header, name if a database has one, and how often it came.
    fn rows<'a>(
        &'a self,
        decoder: &'a Decoder,
    ) -> impl Iterator<Item = (&'a str, String, Option<&'a str>, u64)> {
        self.0.iter().filter_map(|(&(reference, id), &count)| {
            let message = decoder.message(reference);
            let container = message.container.as_ref()?;
            let known = container.pdus.iter().find(|pdu| pdu.header_id == id);
            let name = known.map(|pdu| pdu.name.as_str());
            Some((message.name.as_str(), header_id(container, id), name, count))
        })
    }
}

/// Compares with a trace and prints.
pub fn run(decoder: &Decoder, mut records: Records, json: bool, out: &mut impl Write) -> anyhow::Result<()> {
    let mut statistics = Statistics::new(Options::default())?;
    let mut contained = Contained::of(decoder);
    let mut batch = Vec::new();
    while records.next_batch(&mut batch)? {
        for record in &batch {
            statistics.push(record);
            contained.push(decoder, record);
        }
    }
    let (mut known, mut unknown) = (Vec::new(), Vec::new());
    let mut came: HashMap<MessageRef, u64> = HashMap::new();
    let (mut frames, mut covered, mut unlisted) = (0, 0, 0);
    for channel in statistics.channels() {
        frames += channel.frames;
        unlisted += channel.unlisted_frames();
        for id in channel.ids() {
            let heard = Received::of(channel.number, id);
            if let Some(message) = decoder.find(channel.number, id.id) {
                covered += id.frames;
                *came.entry(message).or_default() += id.frames;
                known.push((heard, message));
            } else {
                unknown.push(heard);
            }
        }
    }
    known.sort_by(|(a, _), (b, _)| (a.channel, &a.id).cmp(&(b.channel, &b.id)));
    unknown.sort_by_key(|heard| std::cmp::Reverse(heard.frames));
    let all = decoder.messages();
    let never: Vec<_> = all.filter(|(reference, ..)| !came.contains_key(reference)).collect();
    let off = |heard: &Received, message: MessageRef| {
        let nominal = decoder.message(message).cycle_ms.map(f64::from)?;
        let mean = heard.mean_ms?;
        Some(((mean - nominal) / nominal).abs() > TOLERANCE)
    };
    if json {
        let entry = |heard: &Received| json!({ "channel": heard.channel, "id": heard.id, "frames": heard.frames, "period_mean_ms": heard.mean_ms, "period_max_ms": heard.max_ms });
        let missing: Vec<_> = unknown.iter().map(entry).collect();
        let silent: Vec<_> = never
            .iter()
            .map(|(_, _, message)| json!({ "id": message.id.to_string(), "message": message.name, "cycle_ms": message.cycle_ms }))
            .collect();
        let cycles: Vec<_> = known
            .iter()
            .map(|(heard, message)| {
                let mut object = entry(heard);
                object["message"] = decoder.message(*message).name.as_str().into();
                object["cycle_ms"] = decoder.message(*message).cycle_ms.into();
                object["cycle_differs"] = off(heard, *message).into();
                object
            })
            .collect();
        let pdus: Vec<_> = contained
            .rows(decoder)
            .map(|(message, header_id, pdu, count)| json!({ "message": message, "header_id": header_id, "pdu": pdu, "count": count }))
            .collect();
        let mut object = json!({
            "frames": frames, "covered": covered, "unlisted": unlisted,
            "contained": pdus,
            "not_in_database": missing, "never_came": silent, "messages": cycles,
        });
        records.missing().put_into(&mut object);
        return Ok(writeln!(out, "{object}")?);
    }
    let share = if frames > 0 { covered as f64 * 100.0 / frames as f64 } else { 0.0 };
    writeln!(out, "{covered} of {frames} frames are in the databases ({share:.1} %)")?;
    if unlisted > 0 {
        let frames = counted(unlisted, "frame");
        writeln!(out, "{frames} of identifiers beyond those that are followed one by one")?;
    }
    let ms = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
    writeln!(out, "\nNot in the databases: {}", counted(unknown.len(), "identifier"))?;
    if !unknown.is_empty() {
        writeln!(out, "  C {:<8} {:>9} {:>10} {:>10}", "ID", "frames", "mean ms", "max ms")?;
    }
    for heard in &unknown {
        writeln!(
            out,
            "  {} {:<8} {:>9} {:>10} {:>10}",
            heard.channel,
            heard.id,
            heard.frames,
            ms(heard.mean_ms),
            ms(heard.max_ms)
        )?;
    }
    writeln!(out, "\nNever came: {} of {}", never.len(), counted(decoder.messages().count(), "message"))?;
    for (_, _, message) in &never {
        let cycle = message.cycle_ms.map_or(String::new(), |cycle| format!(", every {cycle} ms"));
        writeln!(out, "  {:<8} {}{cycle}", message.id.to_string(), message.name)?;
    }
    writeln!(out, "\nCame: {}", counted(known.len(), "identifier"))?;
    if !known.is_empty() {
        let head = ["ID", "frames", "cycle ms", "mean ms", "max ms"];
        writeln!(
            out,
            "  C {:<8} {:>9} {:>10} {:>10} {:>10}  Message",
            head[0], head[1], head[2], head[3], head[4]
        )?;
    }
    for (heard, message) in &known {
        let described = decoder.message(*message);
        writeln!(
            out,
            "  {} {:<8} {:>9} {:>10} {:>10} {:>10}  {}{}",
            heard.channel,
            heard.id,
            heard.frames,
            described.cycle_ms.map_or("–".to_owned(), |cycle| cycle.to_string()),
            ms(heard.mean_ms),
            ms(heard.max_ms),
            described.name,
            if off(heard, *message) == Some(true) { "  (another cycle than the database says)" } else { "" }
        )?;
    }
    if !contained.0.is_empty() {
        writeln!(out, "\nIn containers:")?;
    }
    for (message, header_id, pdu, count) in contained.rows(decoder) {
        let pdu = pdu.unwrap_or("(not in the databases)");
        writeln!(out, "  {message} {header_id:<8} {count:>9}  {pdu}")?;
    }
    Ok(())
}
