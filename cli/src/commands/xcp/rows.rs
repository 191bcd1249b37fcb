//! Values as lines: for people, as JSON, as CSV.

use std::io::Write as _;

use cantap_protocols::{Field, Value};
use cantap_trace::clean;
use serde_json::{Map, json};

use super::targets::Target;

/// How rows are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    Text,
    Json,
    Csv,
}

/// Writes rows of values.
pub struct Rows {
    form: Form,
    columns: Vec<String>,
    has_stamp: bool,
    written: u64,
}

/// A row: the time of the bus, the ECU's own stamp in microseconds, and a value for each column, if it is there.
#[derive(Clone, Debug, Default)]
pub struct Row {
    /// In nanoseconds.
    pub time_ns: i64,
    /// In microseconds.
    pub stamp_us: Option<f64>,
    /// One for each column.
    pub values: Vec<Option<Field>>,
}

/// The widest column of a table.
const WIDEST: usize = 24;

/// A value for programs.
fn json_value(value: &Value) -> serde_json::Value {
    match value {
        Value::Number(number) => json!(number),
        Value::Hex(number, _) => json!(number),
        Value::Real(number) => json!(number),
        Value::Text(text) => json!(text),
        Value::Bytes(_) => json!(value.to_string().replace(' ', "")),
        Value::Missing => serde_json::Value::Null,
    }
}

/// A value without its name: with its unit, or the text that it stands for.
fn text_of(field: &Field) -> String {
    match (&field.text, &field.value) {
        (Some(text), value) => format!("{value} ({text})"),
        (None, Value::Missing) => "not available".to_owned(),
        (None, Value::Text(text)) => format!("\"{}\"", text.escape_debug()),
        (None, value) if field.unit.is_empty() => value.to_string(),
        (None, value) => format!("{value} {}", field.unit),
    }
}

/// A cell of a table of comma-separated values.
fn cell(field: &Field) -> String {
    let text = match (&field.text, &field.value) {
        (Some(text), _) => text.to_string(),
        (None, Value::Missing) => String::new(),
        (None, Value::Text(text)) => clean::line(text).into_owned(),
        (None, Value::Hex(number, _)) => number.to_string(),
        (None, value) => value.to_string(),
    };
    quoted(&text)
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

/// Values, what they stand for, and units, as three objects.
fn objects<'f>(fields: impl Iterator<Item = &'f Field>) -> [Map<String, serde_json::Value>; 3] {
    let mut all = [Map::new(), Map::new(), Map::new()];
    for field in fields {
        let name = field.name.to_string();
        all[0].insert(name.clone(), json_value(&field.value));
        if let Some(text) = &field.text {
            all[1].insert(name.clone(), json!(text));
        }
        if !field.unit.is_empty() {
            all[2].insert(name, json!(field.unit));
        }
    }
    all
}

impl Rows {
    /// A value in each line.
    pub fn one(json: bool) -> Self {
        let form = if json { Form::Json } else { Form::Text };
        Self { form, columns: Vec::new(), has_stamp: false, written: 0 }
    }

    /// A table with these columns.
    pub fn table(columns: Vec<String>, json: bool, csv: bool, has_stamp: bool) -> Self {
        let form = match (json, csv) {
            (true, _) => Form::Json,
            (false, true) => Form::Csv,
            (false, false) => Form::Text,
        };
        Self { form, columns, has_stamp, written: 0 }
    }

    /// How many rows were written.
    pub const fn written(&self) -> u64 {
        self.written
    }

    /// Writes what was read of one target.
    pub fn write_one(&mut self, target: &Target, fields: &[Option<Field>]) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        self.written += 1;
        if self.form == Form::Json {
            let [values, texts, units] = objects(fields.iter().flatten());
            let line = json!({ "name": target.text, "fields": values, "texts": texts, "units": units });
            writeln!(out, "{line}")?;
        } else {
            for field in fields.iter().flatten() {
                writeln!(out, "{} {}", field.name, text_of(field))?;
            }
        }
        Ok(out.flush()?)
    }

    /// Writes what a value was before, and what it is.
    pub fn write_change(
        &mut self,
        target: &Target,
        before: &[Option<Field>],
        now: &[Option<Field>],
    ) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        for (before, now) in before.iter().zip(now) {
            let (Some(before), Some(now)) = (before, now) else { continue };
            if self.form == Form::Json {
                let value = |field: &Field| json_value(&field.value);
                writeln!(
                    out,
                    "{}",
                    json!({ "name": target.text, "before": value(before), "now": value(now) })
                )?;
            } else {
                writeln!(out, "{}: {} -> {}", now.name, text_of(before), text_of(now))?;
            }
        }
        Ok(out.flush()?)
    }

    /// Writes a row, and the head before the first.
    pub fn write(&mut self, row: &Row) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        let seconds = row.time_ns as f64 / 1e9;
        let is_first = self.written == 0;
        self.written += 1;
        match self.form {
            Form::Json => {
                let [values, texts, units] = objects(row.values.iter().flatten());
                let mut line = json!({ "time_s": seconds, "fields": values, "texts": texts, "units": units });
                if let Some(stamp_us) = row.stamp_us {
                    line["stamp_us"] = json!(stamp_us);
                }
                writeln!(out, "{line}")?;
            }
            Form::Csv => {
                if is_first {
                    let mut head = vec!["time_s".to_owned()];
                    head.extend(self.has_stamp.then(|| "stamp_us".to_owned()));
                    head.extend(self.columns.iter().map(|name| quoted(name)));
                    writeln!(out, "{}", head.join(","))?;
                }
                let mut cells = vec![format!("{seconds:.6}")];
                if self.has_stamp {
                    cells.push(row.stamp_us.map_or_else(String::new, |stamp_us| stamp_us.to_string()));
                }
                cells.extend(row.values.iter().map(|field| field.as_ref().map_or_else(String::new, cell)));
                writeln!(out, "{}", cells.join(","))?;
            }
            Form::Text => {
                let width = |name: &str| name.chars().count().clamp(14, WIDEST);
                if is_first {
                    let names = self.columns.iter().map(|name| format!("  {name:<0$}", width(name)));
                    writeln!(out, "{:<19}{}", "time_s", names.collect::<String>().trim_end())?;
                }
                let cells = self.columns.iter().zip(&row.values).map(|(name, field)| {
                    let text = field.as_ref().map_or_else(|| "-".to_owned(), text_of);
                    format!("  {text:<0$}", width(name))
                });
                let cells = cells.collect::<String>();
                writeln!(out, "{seconds:<19.6}{}", cells.trim_end())?;
            }
        }
        Ok(out.flush()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_what_a_value_stands_for() {
        assert_eq!(cell(&Field::number("a", 3).meaning(Some("third, last"))), "\"third, last\"");
        assert_eq!(cell(&Field::real("a", 0.5, "V")), "0.5");
        assert_eq!(cell(&Field::missing("a")), "");
        assert_eq!(text_of(&Field::real("a", 0.5, "V")), "0.5 V");
        assert_eq!(text_of(&Field::number("a", 3).meaning(Some("third"))), "3 (third)");
    }
}
