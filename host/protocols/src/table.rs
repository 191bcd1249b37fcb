//! Names for numbers, from the tables in `data/`, which have the sources. Each is read when it is first asked.
//!
//! A line is `table,number,name`, where the number is hexadecimal and may be a range, and a name that contains a comma is in quotation
//! marks. Lines that begin with `#` are comments.

use std::sync::OnceLock;

/// One table of a file.
pub struct Table {
    file: &'static str,
    name: &'static str,
    index: OnceLock<Index>,
}

/// The numbers from one start to the next have the same name, or none.
#[derive(Debug, Default)]
struct Index {
    /// In order; the first is 0.
    starts: Vec<u32>,
    names: Vec<Option<&'static str>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Row {
    first: u32,
    last: u32,
    name: &'static str,
}

impl Table {
    /// The table with this name in a file.
    pub const fn new(file: &'static str, name: &'static str) -> Self {
        Self { file, name, index: OnceLock::new() }
    }

    /// The name of a number. Of several ranges, the narrowest counts.
    pub fn get(&self, number: impl Into<u32>) -> Option<&'static str> {
        let number = number.into();
        let Index { starts, names } = self.index.get_or_init(|| Index::of(&self.read()));
        // The first start is 0, so there is one before every number.
        names[starts.partition_point(|start| *start <= number) - 1]
    }

    /// The names of the bits that are set, the lowest first.
    pub fn bits(&self, bits: u8) -> impl Iterator<Item = &'static str> + '_ {
        (0..8_u8).filter(move |bit| bits >> bit & 1 == 1).filter_map(|bit| self.get(bit))
    }

    fn read(&self) -> Vec<Row> {
        let rows = lines(self.file).filter_map(|line| line.strip_prefix(self.name)?.strip_prefix(','));
        // What cannot be read is left out, of which the tables have nothing: a test reads every line.
        rows.filter_map(Row::read).collect()
    }
}

impl Index {
    fn of(rows: &[Row]) -> Self {
        let ends = rows.iter().filter_map(|row| row.last.checked_add(1));
        let mut starts: Vec<u32> = rows.iter().map(|row| row.first).chain(ends).chain([0]).collect();
        starts.sort_unstable();
        starts.dedup();
        let name = |start: &u32| {
            let own = rows.iter().filter(|row| (row.first..=row.last).contains(start));
            own.min_by_key(|row| row.last - row.first).map(|row| row.name)
        };
        let names = starts.iter().map(name).collect();
        Self { starts, names }
    }
}

impl Row {
    fn read(rest: &'static str) -> Option<Self> {
        let (numbers, name) = rest.split_once(',')?;
        let (first, last) = range(numbers)?;
        let name = name.strip_prefix('"').and_then(|name| name.strip_suffix('"')).unwrap_or(name);
        Some(Self { first, last, name })
    }
}

/// The lines of a table file that are no comments.
pub fn lines(file: &'static str) -> impl Iterator<Item = &'static str> {
    file.lines().filter(|line| !line.is_empty() && !line.starts_with('#'))
}

/// What a raw number is multiplied with.
#[derive(Clone, Copy, Debug)]
pub enum Scale {
    /// This factor.
    Times(f64),
    /// One divided by this number, which gives the nearest decimal where the factor has no exact binary form.
    Over(f64),
}

impl Scale {
    /// A number, a quotient such as `100/255`, or `/20` for a division.
    pub fn read(text: &str) -> Option<Self> {
        let number = |text: &str| text.parse::<f64>().ok();
        match text.split_once('/') {
            Some(("", divisor)) => number(divisor).map(Self::Over),
            Some((dividend, divisor)) => Some(Self::Times(number(dividend)? / number(divisor)?)),
            None => number(text).map(Self::Times),
        }
    }

    /// Of this number.
    pub fn of(self, raw: f64) -> f64 {
        match self {
            Self::Times(factor) => raw * factor,
            Self::Over(divisor) => raw / divisor,
        }
    }
}

/// A hexadecimal number, or a range of them.
pub fn range(text: &str) -> Option<(u32, u32)> {
    let number = |text| u32::from_str_radix(text, 16).ok();
    match text.split_once('-') {
        Some((first, last)) => Some((number(first)?, number(last)?)),
        None => number(text).map(|number| (number, number)),
    }
}

/// That every line of a file is in one of its tables, that all tables have lines, that no number stands twice, and that each table
/// has a comment in front of it, which is where its source is.
#[cfg(test)]
pub fn check(file: &'static str, tables: &[&Table]) {
    let mut read = 0;
    for table in tables {
        let mut rows = table.read();
        rows.sort_by_key(|row| (row.first, row.last));
        assert!(!rows.is_empty(), "{} is empty", table.name);
        for two in rows.windows(2) {
            assert_ne!((two[0].first, two[0].last), (two[1].first, two[1].last), "{}", table.name);
        }
        for row in &rows {
            assert!(row.first <= row.last && !row.name.is_empty(), "{} {row:?}", table.name);
            assert!(row.name.trim() == row.name && !row.name.contains('"'), "{} {row:?}", table.name);
        }
        read += rows.len();
    }
    assert_eq!(lines(file).count(), read, "a line is in no table, or cannot be read");
    let mut before = ("#", "");
    for line in file.lines() {
        let table = line.split(',').next().unwrap_or_default();
        assert!(
            line.starts_with('#') || table == before.1 || before.0.starts_with("# "),
            "{line} has no source"
        );
        before = (line, if line.starts_with('#') { "" } else { table });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_narrowest_range_names_a_number() {
        const FILE: &str =
            "# Source: none.\na,10-1F,wide\na,12,one\na,12-13,\"two, of them\"\n# And another.\nb,12,other\n";
        let (a, b) = (Table::new(FILE, "a"), Table::new(FILE, "b"));
        let names = [0x0F_u32, 0x10, 0x12, 0x13, 0x14, 0x20].map(|number| a.get(number));
        let expected = [None, Some("wide"), Some("one"), Some("two, of them"), Some("wide"), None];
        assert_eq!(names, expected);
        assert_eq!((b.get(0x12_u8), b.get(0x10_u8)), (Some("other"), None));
        check(FILE, &[&a, &b]);
    }
}
