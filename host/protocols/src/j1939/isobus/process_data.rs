//! What task controllers and their clients send each other (ISO 11783-10).

use std::borrow::Cow;

use super::identifiers::Identifier;
use super::tables::FILE;
use super::{device_description, identifiers, layout};
use crate::table::Table;
use crate::{Event, Field};

static COMMANDS: Table = Table::new(FILE, "process_data");

const OBJECT_POOL_TRANSFER: u8 = 0x61;

/// Adds what a message says; false if its command is reserved or it is too short.
pub fn fields(data: &[u8], event: &mut Event) -> bool {
    let Some(&first) = data.first() else { return false };
    let command = first & 0xF;
    if command < 2 {
        let Some(layout) = layout::find("technical", first) else { return false };
        event.title = format!("{}: {}", event.title, layout.name).into();
        event.fields.push(Field::hex("command", first, 2).meaning(Some(layout.name)));
        layout.fields(data, &mut event.fields);
        if first == OBJECT_POOL_TRANSFER {
            device_description::fields(&data[1..], &mut event.fields);
        }
        return true;
    }
    let (Some(name), &[_, high, low_ddi, high_ddi, ref value @ ..]) = (COMMANDS.get(command), data) else {
        return false;
    };
    event.title = format!("{}: {name}", event.title).into();
    event.fields.push(Field::number("command", command).meaning(Some(name)));
    let Ok(value) = <[u8; 4]>::try_from(value) else {
        event.fields.push(Field::bytes("data", &data[1..]));
        return true;
    };
    let fields = &mut event.fields;
    if let 0xE | 0xF = command {
        let [status, ..] = value;
        fields.push(Field::hex("status", status, 2));
        let task = if status & 1 == 1 { "active" } else { "not active" };
        fields.push(Field::number("task", status & 1).meaning(Some(task)));
        return true;
    }
    let ddi = u16::from_le_bytes([low_ddi, high_ddi]);
    let identifier = identifiers::get(ddi);
    fields.push(Field::number("element", u16::from(first >> 4) | u16::from(high) << 4));
    fields.push(Field::number("ddi", ddi).meaning(identifier.map(|identifier| identifier.name)));
    let number = i32::from_le_bytes(value);
    let scaled = |name: Cow<'static, str>| match identifier {
        Some(Identifier { scale, unit, .. }) => Field::real(name, scale.of(number.into()), *unit),
        None => Field::number(name, number),
    };
    match command {
        0x3 | 0xA => {
            let name = identifier.map_or("value", |identifier| identifier.field.as_str());
            fields.push(scaled(name.into()));
        }
        0x4 => fields.push(Field::number("interval", number).unit("ms")),
        0x5 => fields.push(Field::number("interval", number).unit("mm")),
        0x6..=0x8 => fields.push(scaled("threshold".into())),
        0xD => {
            let [errors, acknowledged, ..] = value;
            fields.push(Field::hex("errors", errors, 2));
            let command = acknowledged & 0xF;
            fields.push(Field::number("acknowledged", command).meaning(COMMANDS.get(command)));
        }
        // A request has no value; how peers are assigned is not read.
        0x9 => fields.push(Field::bytes("data", &value)),
        _ => {}
    }
    true
}
