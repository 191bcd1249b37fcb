//! Messages in full.

use std::io::Write;

use cantap_signals::{
    ByteOrder, Container, ContainerHeader, Database, Message, Selection, Signal, Suggestion, ValueKind,
};
use cantap_trace::counted;
use serde_json::{Value, json};

/// Shows the requested messages.
pub fn run(
    messages: &[String],
    json: bool,
    databases: &[Database],
    out: &mut impl Write,
) -> anyhow::Result<()> {
    let patterns: Vec<_> = messages.iter().map(|text| Wanted::of(text)).collect::<Result<_, _>>()?;
    for wanted in &patterns {
        if !databases.iter().flat_map(|database| &database.messages).any(|message| wanted.matches(message)) {
            let names = databases.iter().flat_map(|database| &database.messages);
            let near = Suggestion::nearest(&wanted.text, names.map(|message| message.name.as_str()));
            anyhow::bail!("no message of the databases matches {:?}{near}", wanted.text);
        }
    }
    let chosen = |message: &&Message| patterns.iter().any(|wanted| wanted.matches(message));
    let mut found = databases.iter().flat_map(|database| &database.messages).filter(chosen);
    if json {
        let messages: Vec<_> = found.map(as_json).collect();
        return Ok(writeln!(out, "{}", json!({ "messages": messages }))?);
    }
    let mut separator = "";
    found.try_for_each(|message| {
        write!(out, "{}", std::mem::replace(&mut separator, "\n"))?;
        show(message, out)
    })
}

/// A requested message, by identifier or name.
struct Wanted {
    text: String,
    selection: Selection,
}

impl Wanted {
    fn of(text: &str) -> anyhow::Result<Self> {
        Ok(Self { text: text.to_owned(), selection: Selection::new(&[text])? })
    }

    fn matches(&self, message: &Message) -> bool {
        message.id.to_string().eq_ignore_ascii_case(&self.text)
            || self.text.parse::<cantap::Id>().is_ok_and(|id| id == message.id)
            || self.selection.names(message)
    }
}

fn show(message: &Message, out: &mut impl Write) -> anyhow::Result<()> {
    write!(out, "{} {}, {}", message.id, message.name, counted(message.length, "byte"))?;
    if let Some(cycle) = message.cycle_ms {
        write!(out, ", every {cycle} ms")?;
    }
    writeln!(out, "{}", if message.j1939 { ", J1939" } else { "" })?;
    comment(&message.description, "  ", out)?;
    if let Some(container) = &message.container {
        let header = if container.header == ContainerHeader::Long { "long" } else { "short" };
        writeln!(out, "  from byte {} on a container of PDUs, each behind a {header} header:", container.at)?;
        for pdu in &container.pdus {
            write!(
                out,
                "    {} {}, {}",
                header_id(container, pdu.header_id),
                pdu.name,
                counted(pdu.length, "byte")
            )?;
            if let Some(cycle) = pdu.cycle_ms {
                write!(out, ", every {cycle} ms")?;
            }
            writeln!(out)?;
            comment(&pdu.description, "      ", out)?;
        }
    }
    let pages = message.pages();
    for page in &pages {
        writeln!(out)?;
        if pages.len() > 1 {
            let own: Vec<_> =
                page.iter().filter_map(|&place| condition(message, &message.signals[place])).collect();
            let mut own: Vec<_> = own.into_iter().collect();
            own.dedup();
            let pdu = page.first().and_then(|&place| message.signals[place].contained.as_ref());
            own.splice(0..0, pdu.map(|pdu| format!("in {}", pdu.name)));
            if !own.is_empty() {
                writeln!(out, "  {}:", own.join(", "))?;
            }
        }
        write!(out, "{}", message.layout_picture(page))?;
    }
    writeln!(out)?;
    for signal in &message.signals {
        let order = if signal.order == ByteOrder::Big { "big-endian" } else { "little-endian" };
        write!(
            out,
            "  {}: bit {}, {}, {order}, {}, x {}",
            signal.label(),
            signal.start,
            counted(signal.length, "bit"),
            kind(signal.kind),
            signal.factor
        )?;
        if signal.offset != 0.0 {
            write!(out, " {} {}", if signal.offset < 0.0 { '-' } else { '+' }, signal.offset.abs())?;
        }
        if !signal.unit.is_empty() {
            write!(out, " {}", signal.unit)?;
        }
        if let (Some(min), Some(max)) = (signal.min, signal.max) {
            write!(out, ", {min} to {max}")?;
        }
        if let Some(when) = condition(message, signal) {
            write!(out, ", when {when}")?;
        }
        writeln!(out)?;
        comment(&signal.description, "    ", out)?;
        for (value, text) in signal.values.iter() {
            writeln!(out, "    {value} = {text}")?;
        }
    }
    Ok(())
}

/// The identifier in a PDU's header, in as many digits as it has there.
pub fn header_id(container: &Container, header_id: u32) -> String {
    let width = if container.header == ContainerHeader::Long { 8 } else { 6 };
    format!("{header_id:0width$X}")
}

fn comment(text: &str, indent: &str, out: &mut impl Write) -> anyhow::Result<()> {
    for line in text.lines() {
        writeln!(out, "{indent}{line}")?;
    }
    Ok(())
}

/// `Page is 1 or 3 to 5`, if the signal is not always present.
fn condition(message: &Message, signal: &Signal) -> Option<String> {
    let multiplexed = signal.multiplexed.as_ref()?;
    let switch = message.signals.get(multiplexed.switch)?;
    let values = multiplexed.values.iter().map(|range| {
        if range.start() == range.end() {
            range.start().to_string()
        } else {
            format!("{} to {}", range.start(), range.end())
        }
    });
    Some(format!("{} is {}", switch.label(), values.collect::<Vec<_>>().join(" or ")))
}

fn kind(kind: ValueKind) -> &'static str {
    match kind {
        ValueKind::Unsigned => "unsigned",
        ValueKind::Signed => "signed",
        ValueKind::SignMagnitude => "sign-magnitude",
        ValueKind::OnesComplement => "one's complement",
        ValueKind::Half => "half",
        ValueKind::Single => "float",
        ValueKind::Double => "double",
    }
}

/// A whole database.
pub fn database(database: &Database) -> Value {
    let messages: Vec<_> = database.messages.iter().map(as_json).collect();
    json!({
        "file": database.file,
        "buses": database.buses,
        "warnings": database.warnings.len(),
        "messages": messages,
    })
}

fn as_json(message: &Message) -> Value {
    let signals: Vec<_> = message
        .signals
        .iter()
        .map(|signal| {
            let texts: Vec<_> =
                signal.values.iter().map(|(value, text)| json!({ "value": value, "text": text })).collect();
            json!({
                "name": signal.label(),
                "pdu": signal.contained.as_ref().map(|pdu| &pdu.name),
                "start": signal.start,
                "length": signal.length,
                "order": if signal.order == ByteOrder::Big { "big" } else { "little" },
                "type": kind(signal.kind),
                "factor": signal.factor,
                "offset": signal.offset,
                "min": signal.min,
                "max": signal.max,
                "unit": signal.unit,
                "texts": texts,
                "when": condition(message, signal),
                "comment": signal.description,
            })
        })
        .collect();
    let pdus = message.container.iter().flat_map(|container| {
        container.pdus.iter().map(|pdu| {
            json!({
                "header_id": header_id(container, pdu.header_id),
                "name": pdu.name,
                "length": pdu.length,
                "cycle_ms": pdu.cycle_ms,
                "comment": pdu.description,
            })
        })
    });
    json!({
        "id": message.id.to_string(),
        "extended": message.id.is_extended(),
        "name": message.name,
        "length": message.length,
        "cycle_ms": message.cycle_ms,
        "j1939": message.j1939,
        "comment": message.description,
        "pdus": pdus.collect::<Vec<_>>(),
        "signals": signals,
    })
}
