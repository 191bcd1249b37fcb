//! The bags of ROS 2 that are SQLite databases (`.db3`): a table of topics, and one of messages with the bytes of each.
//!
//! Source: the schema in rosbag2_storage_sqlite3.

use std::collections::HashMap;

use rusqlite::types::ValueRef;
use rusqlite::{Connection, Row};

use super::super::error_frames::ErrorFrames;
use super::super::found::Found;
use super::super::issue::Fault;
use super::{Encoding, Kind, OTHER_MESSAGES, SENT_TOPIC, Topic, Topics, content};
use cantap_trace::{Direction, TraceRecord};

/// What is known of a bag's topics.
pub(crate) struct Bag {
    topics: HashMap<i64, Option<(Kind, Topic)>>,
}

impl Bag {
    /// Reads the topics; `None` if the database is no bag.
    pub(crate) fn open(database: &Connection, known: &mut Topics) -> rusqlite::Result<Option<Self>> {
        let tables =
            "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages')";
        if database.query_row(tables, [], |row| row.get::<_, i64>(0))? < 2 {
            return Ok(None);
        }
        let mut statement = database.prepare("SELECT id, name, type, serialization_format FROM topics")?;
        let mut rows = statement.query([])?;
        let mut topics = HashMap::new();
        while let Some(row) = rows.next()? {
            let text =
                |column: usize| Ok::<_, rusqlite::Error>(row.get_ref(column)?.as_bytes().unwrap_or_default());
            let kind = Kind::of_type(text(2)?).filter(|_| matches!(text(3), Ok(b"cdr")));
            let name = text(1)?;
            topics.insert(row.get(0)?, kind.map(|kind| (kind, known.topic(name))));
        }
        Ok(Some(Self { topics }))
    }

    /// What is asked for of a bag's messages in their order. What is no frame, such as a picture, is not read from the disk.
    pub(crate) fn columns(&self) -> String {
        let frames = self.topics.iter().filter(|(_, topic)| topic.is_some()).map(|(id, _)| id.to_string());
        let frames = frames.collect::<Vec<_>>().join(", ");
        format!(
            "rowid, topic_id, timestamp, CASE WHEN topic_id IN ({frames}) THEN data ELSE x'' END FROM messages"
        )
    }

    /// Adds what a message contains.
    pub(crate) fn message(
        &self,
        row: &Row<'_>,
        errors: &mut ErrorFrames,
        found: &mut Vec<Found>,
    ) -> Result<(), Fault> {
        let value = |column: usize| row.get_ref(column).unwrap_or(ValueRef::Null);
        let (ValueRef::Integer(topic), ValueRef::Integer(stored_ns), ValueRef::Blob(bytes)) =
            (value(1), value(2), value(3))
        else {
            return Err(Fault::malformed(
                "a message with its topic, its time and its bytes",
                b"something else",
            ));
        };
        let (kind, Topic { channel, direction }) = match self.topics.get(&topic) {
            Some(Some(topic)) => *topic,
            Some(None) => {
                found.push(Found::LeftOut(OTHER_MESSAGES));
                return Ok(());
            }
            None => {
                let number = format!("topic {topic}");
                return Err(Fault::malformed("a message of a topic of the bag", number.as_bytes()));
            }
        };
        let content = content(kind, Encoding::Cdr, direction, bytes, errors)?;
        let time_ns = content.time_ns.unwrap_or(stored_ns);
        let events = std::iter::once(content.event).chain(content.second);
        found.extend(
            events.map(|event| Found::Record(TraceRecord { time_ns, device_ns: None, channel, event })),
        );
        if direction == Direction::Tx {
            found.push(Found::Note(SENT_TOPIC));
        }
        found.extend(std::iter::from_fn(|| errors.note()).map(Found::Note));
        Ok(())
    }
}
