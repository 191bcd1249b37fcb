//! What a vehicle has answered, as a table with names: one row for each value of each ECU.

use std::fmt::Write as _;

use cantap_protocols::{Event, Field, Value};

use crate::cut::cut;

/// Fields that say what was asked, and not what was answered.
const OF_THE_QUESTION: [&str; 4] = ["sid", "pid", "did", "asked"];
/// Trouble codes of each kind: their number, and the list.
const COUNT: &str = "trouble_codes";
const LIST: &str = "codes";
/// Decimals of a value; more are the conversion's and not the sensor's.
const DECIMALS: i32 = 3;
/// Services with values that are read again and again, in OBD-II and over UDS.
const CURRENT_DATA: u8 = 0x01;
const READ_BY_IDENTIFIER: u8 = 0x22;
/// The service that has the VIN.
const VEHICLE_INFORMATION: u8 = 0x09;
/// Columns between two.
const GAP: &str = "  ";
/// Where the name and the value are.
const NAME: usize = 1;
const VALUE: usize = 3;
/// Columns of a name that still shows what it is; the least and the most so far give way to it.
const SHORT_NAME: usize = 16;
/// Its heading.
const SHORTEST_NAME: usize = 4;

/// One value of one ECU.
#[derive(Clone, Debug, PartialEq)]
struct Row {
    service: u8,
    /// The parameter in hexadecimal; empty where there is none, as of trouble codes.
    pid: String,
    name: String,
    ecu: String,
    value: String,
    /// The least and the most so far, of numbers.
    range: Option<(f64, f64)>,
    /// When it was last answered: see [`Table::round`].
    round: u64,
}

impl Row {
    /// Who the vehicle is comes first, then its trouble codes, then values in the order of their parameters.
    fn order(&self) -> (u8, &str, &str, &str) {
        let group = match (self.service, self.pid.is_empty()) {
            (VEHICLE_INFORMATION, _) => 0,
            (_, true) => 1,
            _ => 2,
        };
        (group, &self.pid, &self.name, &self.ecu)
    }

    /// Whether it was answered in this round; who the vehicle is and its trouble codes are not asked for in each.
    fn is_current(&self, round: u64) -> bool {
        self.round == round || self.order().0 < 2
    }

    fn shown(&self, round: u64) -> TableRow<'_> {
        TableRow {
            parameter: self.parameter(),
            name: &self.name,
            ecu: &self.ecu,
            value: &self.value,
            is_current: self.is_current(round),
            range: self.range.map(|(min, max)| (rounded(min), rounded(max))),
        }
    }

    /// A parameter of another service than those of current values has that before it.
    fn parameter(&self) -> String {
        match self.service {
            _ if self.pid.is_empty() => String::new(),
            CURRENT_DATA | READ_BY_IDENTIFIER => self.pid.clone(),
            service => format!("{service:02X} {}", self.pid),
        }
    }
}

/// A row of the table, for whoever draws it in another way than as lines of text.
#[derive(Clone, Debug, PartialEq)]
pub struct TableRow<'a> {
    /// The parameter in hexadecimal, behind its service if that is not the one of current values; empty for trouble codes.
    pub parameter: String,
    /// What the value is.
    pub name: &'a str,
    /// Where the ECU answers from.
    pub ecu: &'a str,
    /// The latest value with its unit.
    pub value: &'a str,
    /// Whether the ECU has answered the last time.
    pub is_current: bool,
    /// The least and the most so far, of numbers.
    pub range: Option<(String, String)>,
}

/// Values by parameter and ECU, the latest of each.
#[derive(Clone, Debug, Default)]
pub struct Table {
    rows: Vec<Row>,
    /// How often everything has been asked so far. What was not answered the last time is shown as such.
    round: u64,
}

impl Table {
    /// Everything is asked once more.
    pub fn begin_round(&mut self) {
        self.round += 1;
    }

    /// Takes an answer. One without values, such as a refusal, has its title as its name.
    pub fn take(&mut self, event: &Event) {
        let number = |name| event.field(name).and_then(|field: &Field| field.value.as_number());
        let service = number("sid").unwrap_or_default() as u8;
        let pid = event.field("pid").or_else(|| event.field("did"));
        let pid = pid.map_or_else(String::new, |field| number_text(&field.value));
        let (ecu, round) = (event.to.to_string(), self.round);
        let is_value = |field: &&Field| {
            // How many trouble codes there are is seen by their list.
            let is_count = pid.is_empty() && field.name == COUNT && event.field(LIST).is_some();
            !is_count && !OF_THE_QUESTION.contains(&&*field.name)
        };
        let mut values = event.fields.iter().filter(is_value).peekable();
        if values.peek().is_none() {
            let (name, value) = (event.title.to_string(), "–".to_owned());
            self.put(Row { service, pid, name, ecu, value, range: None, round });
            return;
        }
        for field in values {
            // Trouble codes of each kind have the same fields.
            let name = match pid.as_str() {
                "" if field.name == LIST => event.title.to_string(),
                "" => format!("{}: {}", event.title, field.name),
                _ => field.name.to_string(),
            };
            let range = self::number(&field.value).map(|value| (value, value));
            let (pid, ecu, value) = (pid.clone(), ecu.clone(), value_text(field));
            self.put(Row { service, pid, name, ecu, value, range, round });
        }
    }

    fn put(&mut self, row: Row) {
        match self.rows.iter_mut().find(|known| known.order() == row.order()) {
            None => self.rows.push(row),
            Some(known) => {
                let range = match (known.range, row.range) {
                    (Some((min, max)), Some((now, _))) => Some((min.min(now), max.max(now))),
                    (before, now) => before.or(now),
                };
                *known = Row { range, ..row };
            }
        }
    }

    /// Whether there is nothing to show.
    pub const fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Its rows: who the vehicle is, then its trouble codes, then values in the order of their parameters.
    pub fn rows(&self) -> Vec<TableRow<'_>> {
        let mut rows: Vec<_> = self.rows.iter().collect();
        rows.sort_by(|a, b| a.order().cmp(&b.order()));
        rows.into_iter().map(|row| row.shown(self.round)).collect()
    }

    /// The table's lines, none longer than `columns`; with the least and the most so far if `with_range`. In a narrow window names are shorter, and
    /// where that is not enough, the least and the most are left out. If there are more than `lines`, the last line says how many are missing.
    pub fn lines(&self, with_range: bool, (columns, lines): (usize, usize)) -> Vec<String> {
        let mut cells = vec![vec!["PID".to_owned(), "name".to_owned(), "ECU".to_owned(), "value".to_owned()]];
        if with_range {
            cells[0].extend(["min".to_owned(), "max".to_owned()]);
        }
        for TableRow { parameter, name, ecu, value, is_current, range } in self.rows() {
            let value = if is_current { value.to_owned() } else { format!("no answer, was {value}") };
            let mut line = vec![parameter, name.to_owned(), ecu.to_owned(), value];
            if with_range {
                let (min, max) = range.unwrap_or_default();
                line.extend([min, max]);
            }
            cells.push(line);
        }
        let width = |column: usize| cells.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let mut widths: Vec<usize> = (0..cells[0].len()).map(width).collect();
        let without_name = |widths: &[usize]| {
            let all: usize = widths.iter().map(|width| width + GAP.len()).sum();
            all - GAP.len() - widths[NAME]
        };
        // What is measured now matters most, and then what it is.
        if without_name(&widths) + widths[NAME].min(SHORT_NAME) > columns {
            widths.truncate(VALUE + 1);
        }
        widths[NAME] = widths[NAME].min(columns.saturating_sub(without_name(&widths)).max(SHORTEST_NAME));
        let line = |row: &Vec<String>| {
            let mut line = String::new();
            for (cell, width) in row.iter().zip(&widths) {
                // Writing to a String cannot fail.
                let _ = write!(line, "{:<width$}{GAP}", cut(cell, *width));
            }
            cut(line.trim_end(), columns)
        };
        let mut text: Vec<String> = cells.iter().map(line).collect();
        if text.len() > lines {
            text.truncate(lines.saturating_sub(1));
            let missing = cells.len() - text.len();
            text.push(cut(
                &format!("{missing} more: enlarge the window, or name the PIDs to watch"),
                columns,
            ));
        }
        text
    }
}

fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Number(number) => Some(*number as f64),
        Value::Real(number) => Some(*number),
        _ => None,
    }
}

/// As many digits as the number has, without `0x`.
fn number_text(value: &Value) -> String {
    match value {
        Value::Hex(number, digits) => format!("{number:0width$X}", width = usize::from(*digits)),
        other => other.to_string(),
    }
}

fn rounded(value: f64) -> String {
    crate::rounded(value, DECIMALS).to_string()
}

/// A value with its unit and its meaning, without quotes.
fn value_text(field: &Field) -> String {
    let mut text = match &field.value {
        Value::Real(value) => rounded(*value),
        Value::Text(text) if text.is_empty() => "none".to_owned(),
        Value::Text(text) => cantap_trace::clean::line(text).into_owned(),
        other => other.to_string(),
    };
    for part in [field.unit.as_ref(), field.text.as_deref().unwrap_or_default()] {
        if !part.is_empty() {
            text.push(' ');
            text.push_str(part);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(pid: &str, value: f64, round: u64) -> Row {
        Row {
            service: CURRENT_DATA,
            pid: pid.to_owned(),
            name: "engine_speed".to_owned(),
            ecu: "7E8".to_owned(),
            value: format!("{} rpm", rounded(value)),
            range: Some((value, value)),
            round,
        }
    }

    fn table(values: &[(&str, f64)]) -> Table {
        let mut table = Table::default();
        for (pid, value) in values {
            table.put(row(pid, *value, 0));
        }
        table
    }

    const ROOM: (usize, usize) = (100, 24);

    #[test]
    fn a_row_keeps_the_latest_value_with_the_least_and_the_most() {
        let table = table(&[("0C", 900.0), ("0C", 700.25), ("0C", 800.123_456)]);
        assert_eq!(
            table.lines(true, ROOM),
            [
                "PID  name          ECU  value        min     max",
                "0C   engine_speed  7E8  800.123 rpm  700.25  900"
            ]
        );
        assert_eq!(table.lines(false, ROOM)[1], "0C   engine_speed  7E8  800.123 rpm");
    }

    #[test]
    fn in_a_narrow_window_names_are_cut_and_values_are_not() {
        let mut table = table(&[("0C", 1234.5)]);
        let name = "catalyst_temperature_bank_1_sensor_1".to_owned();
        table.put(Row { name, value: "no answer, was 512.3 °C".to_owned(), ..row("3C", 512.3, 0) });
        let lines = table.lines(true, (70, 24));
        assert_eq!(lines[2], "3C   catalyst_temperatu…  7E8  no answer, was 512.3 °C  512.3   512.3");
        assert_eq!(table.lines(true, (40, 24))[2], "3C   cata…  7E8  no answer, was 512.3 °C");
    }

    /// A value must not stand there as if the ECU still told it.
    #[test]
    fn what_is_not_answered_any_more_is_shown_as_such() {
        let mut table = table(&[("0C", 900.0), ("0D", 50.0)]);
        table.begin_round();
        table.put(row("0D", 51.0, 1));
        let lines = table.lines(true, ROOM);
        assert!(lines[1].contains("no answer, was 900 rpm  900  900"), "{lines:?}");
        assert!(lines[2].contains("7E8  51 rpm") && lines[2].ends_with("50   51"), "{lines:?}");
    }

    #[test]
    fn who_the_vehicle_is_and_its_codes_hold_until_they_are_asked_for_again() {
        let mut table = table(&[("0C", 900.0)]);
        table.put(Row {
            service: 3,
            pid: String::new(),
            value: "P0301".to_owned(),
            range: None,
            ..row("", 0.0, 0)
        });
        table.put(Row { service: VEHICLE_INFORMATION, ..row("02", 0.0, 0) });
        table.begin_round();
        let current: Vec<_> =
            table.rows().iter().map(|row| (row.parameter.clone(), row.is_current)).collect();
        assert_eq!(current, [("09 02".to_owned(), true), (String::new(), true), ("0C".to_owned(), false)]);
    }

    #[test]
    fn rows_are_in_order_no_line_is_too_long_and_what_does_not_fit_is_counted() {
        let mut table = table(&[("0D", 1.0), ("0C", 2.0)]);
        table.put(Row { service: 3, pid: String::new(), ..row("", 0.0, 0) });
        table.put(Row { service: VEHICLE_INFORMATION, name: "vin".to_owned(), ..row("02", 0.0, 0) });
        let starts: Vec<String> =
            table.lines(false, ROOM).iter().map(|line| line[..6].trim().to_owned()).collect();
        assert_eq!(starts, ["PID", "09 02", "", "0C", "0D"]);
        let narrow = table.lines(false, (10, 24));
        assert!(narrow.iter().all(|line| line.chars().count() == 10 && line.ends_with('…')), "{narrow:?}");
        let low = table.lines(false, (100, 3));
        assert!(low.len() == 3 && low[2].starts_with("3 more: "), "{low:?}");
    }
}
