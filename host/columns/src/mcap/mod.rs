//! MCAP files of decoded signals, for Foxglove and other viewers of recorded drives.

mod container;

use std::collections::{HashMap, HashSet};
use std::io::{self, Write};

use cantap_signals::{Decoder, Message, MessageRef, Reading, Signal, SignalValue};
use cantap_trace::{TraceEvent, TraceRecord};
use serde_json::{Map, Value, json};

use self::container::Container;
use crate::events::Happened;
use crate::names::{ColumnNames, text_column};

/// A file with a channel for each message of a database on each channel of the trace, `/channel1/NAME`, and one for what else happened,
/// `/events`: losses, bus errors, states.
///
/// A message is a JSON object with the frame's `id` and a number for each signal under its name, and for one with a value table also `NAME.text`.
/// What a frame does not have, or says that there is none, is not in its object. The schema has units, descriptions and ranges. Signals whose name
/// another field has already are called `MESSAGE.NAME`, as in [`crate::MessageColumns`]. Times are in nanoseconds since 1970, or since the
/// trace's start; MCAP has none before that.
pub struct McapFile<W> {
    container: Container<W>,
    channels: HashMap<(u8, MessageRef), Topic>,
    topics: HashSet<String>,
    events: Option<u16>,
    before_1970: u64,
    /// The object being written.
    object: Vec<u8>,
}

/// A channel of the file.
struct Topic {
    channel: u16,
    /// For each signal, the names of its fields, as JSON.
    signals: Vec<Fields>,
}

struct Fields {
    value: String,
    text: Option<String>,
}

impl<W: Write> McapFile<W> {
    /// Begins a file.
    pub fn new(out: W) -> io::Result<Self> {
        Ok(Self {
            container: Container::new(out)?,
            channels: HashMap::new(),
            topics: HashSet::new(),
            events: None,
            before_1970: 0,
            object: Vec::new(),
        })
    }

    /// Adds the values that were decoded from a frame; nothing for another record. `values` and `reference` come from [`Decoder::decode`].
    pub fn push_values(
        &mut self,
        decoder: &Decoder,
        record: &TraceRecord,
        reference: MessageRef,
        values: &[SignalValue],
    ) -> io::Result<()> {
        let Some(frame) = record.frame() else { return Ok(()) };
        let Some(time_ns) = self.time_ns(record) else { return Ok(()) };
        let message = decoder.message(reference);
        let key = (record.channel, reference);
        if !self.channels.contains_key(&key) {
            let topic = self.add_topic(record.channel, message)?;
            self.channels.insert(key, topic);
        }
        let Some(topic) = self.channels.get(&key) else { return Ok(()) };
        let object = &mut self.object;
        object.clear();
        write!(object, "{{\"id\":{}", frame.id().raw())?;
        for value in values {
            let reading = Reading::of(message, value);
            let fields = &topic.signals[value.signal as usize];
            if let Some(number) = reading.number_for_programs().filter(|number| number.is_finite()) {
                write!(object, ",{}:{number}", fields.value)?;
            }
            if let (Some(name), Some(text)) = (&fields.text, reading.text) {
                write!(object, ",{name}:")?;
                serde_json::to_writer(&mut *object, text)?;
            }
        }
        object.push(b'}');
        self.container.message(topic.channel, time_ns, object)
    }

    /// Adds an event other than a frame; nothing for a frame.
    pub fn push_event(&mut self, record: &TraceRecord) -> io::Result<()> {
        if matches!(record.event, TraceEvent::Frame { .. }) {
            return Ok(());
        }
        let Some(time_ns) = self.time_ns(record) else { return Ok(()) };
        let channel = match self.events {
            Some(channel) => channel,
            None => *self.events.insert(add_events(&mut self.container)?),
        };
        let happened = Happened::of(&record.event);
        let mut object = Map::from_iter([("channel".to_owned(), record.channel.into())]);
        let mut put = |name: &str, value: Option<Value>| {
            object.extend(value.map(|value| (name.to_owned(), value)));
        };
        put("event", happened.kind().map(Value::from));
        put("detail", happened.detail.map(Value::from));
        put("count", happened.count.map(Value::from));
        put("at_least", happened.at_least.map(Value::from));
        put("tec", happened.counters.map(|(tec, _)| tec.into()));
        put("rec", happened.counters.map(|(_, rec)| rec.into()));
        put("tag", happened.tag.map(Value::from));
        put("text", record.lin().map(|frame| frame.to_string().into()));
        self.container.message(channel, time_ns, Value::from(object).to_string().as_bytes())
    }

    /// The time of a message, if the format has it.
    fn time_ns(&mut self, record: &TraceRecord) -> Option<u64> {
        let time_ns = u64::try_from(record.time_ns).ok();
        self.before_1970 += u64::from(time_ns.is_none());
        time_ns
    }

    fn add_topic(&mut self, channel: u8, message: &Message) -> io::Result<Topic> {
        let (schema, signals) = schema(message);
        let schema = self.container.add_schema(&message.name, &schema.to_string())?;
        let mut topic = format!("/channel{channel}/{}", message.name);
        // Two databases may each have a message of that name.
        while !self.topics.insert(topic.clone()) {
            topic = format!("{topic}-{}", message.id);
        }
        let mut about = vec![("channel", channel.to_string()), ("id", message.id.to_string())];
        about.extend(message.cycle_ms.map(|cycle_ms| ("cycle_ms", cycle_ms.to_string())));
        let channel = self.container.add_channel(schema, &topic, &about)?;
        Ok(Topic { channel, signals })
    }

    /// Records that were left out because they are from before 1970.
    pub fn before_1970(&self) -> u64 {
        self.before_1970
    }

    /// Writes the rest. Returns what it was written to.
    pub fn finish(self) -> io::Result<W> {
        self.container.finish()
    }
}

/// The schema of a message, and the names of its signals' fields.
fn schema(message: &Message) -> (Value, Vec<Fields>) {
    let mut properties = Map::from_iter([("id".to_owned(), json!({ "type": "integer" }))]);
    let mut names = ColumnNames::default();
    names.take("id");
    let mut signals = Vec::new();
    for signal in &message.signals {
        let has_texts = !signal.values.is_empty();
        let name = names.choose(&signal.label(), &message.name, has_texts);
        properties.insert(name.clone(), property(signal));
        let quoted = |name: &str| Value::from(name).to_string();
        let text = has_texts.then(|| {
            let name = text_column(&name);
            let quoted = quoted(&name);
            properties.insert(name, json!({ "type": "string" }));
            quoted
        });
        signals.push(Fields { value: quoted(&name), text });
    }
    let mut schema = json!({ "title": message.name, "type": "object", "properties": properties });
    if !message.description.is_empty() {
        schema["description"] = message.description.clone().into();
    }
    (schema, signals)
}

fn property(signal: &Signal) -> Value {
    let mut property = json!({ "type": "number" });
    let unit = Some(&signal.unit).filter(|unit| !unit.is_empty()).map(|unit| format!("[{unit}]"));
    let description = Some(signal.description.clone()).filter(|text| !text.is_empty());
    let about: Vec<_> = description.into_iter().chain(unit).collect();
    if !about.is_empty() {
        property["description"] = about.join(" ").into();
    }
    for (key, limit) in [("minimum", signal.min), ("maximum", signal.max)] {
        if let Some(limit) = limit.filter(|limit| limit.is_finite()) {
            property[key] = limit.into();
        }
    }
    property
}

fn add_events<W: Write>(container: &mut Container<W>) -> io::Result<u16> {
    let of = |kind: &str| json!({ "type": kind });
    let properties = json!({
        "channel": of("integer"), "event": of("string"), "detail": of("string"), "count": of("integer"),
        "at_least": of("boolean"), "tec": of("integer"), "rec": of("integer"), "tag": of("integer"), "text": of("string"),
    });
    let description = "what happened besides CAN frames: frames that were lost, errors, states of controllers, frames of LIN";
    let schema = json!({
        "title": "cantap.Event", "type": "object", "description": description, "properties": properties,
    });
    let schema = container.add_schema("cantap.Event", &schema.to_string())?;
    container.add_channel(schema, "/events", &[])
}
