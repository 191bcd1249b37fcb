//! The rows of a spreadsheet or of a text with separators, as texts.

use std::cell::Cell;
use std::collections::HashMap;

use roxmltree::{Document, Node};

use super::super::zip::Archive;

/// A table: its name, empty for a text, and its rows with their numbers from 1.
pub(super) struct Sheet {
    pub name: String,
    pub rows: Vec<(u32, Vec<String>)>,
}

/// The rows of a text, whose cells stand between commas, semicolons or tabs, whichever the first rows have most of.
pub(super) fn of_text(text: &str) -> Sheet {
    let head: String = text.lines().take(20).collect();
    let count = |mark: char| head.matches(mark).count();
    let separator = [',', ';', '\t'].into_iter().max_by_key(|mark| count(*mark)).unwrap_or(',');
    let mut rows = Vec::new();
    let (mut cells, mut cell) = (Vec::new(), String::new());
    let (mut line, mut first, mut quoted) = (1, 1, false);
    let mut chars = text.chars().peekable();
    while let Some(next) = chars.next() {
        match next {
            '"' if quoted && chars.peek() == Some(&'"') => {
                chars.next();
                cell.push('"');
            }
            '"' if quoted => quoted = false,
            '"' if cell.trim().is_empty() => {
                quoted = true;
                cell.clear();
            }
            '\n' => {
                line += 1;
                if quoted {
                    cell.push('\n');
                } else {
                    cells.push(std::mem::take(&mut cell));
                    rows.push((first, std::mem::take(&mut cells)));
                    first = line;
                }
            }
            '\r' => {}
            _ if next == separator && !quoted => cells.push(std::mem::take(&mut cell)),
            _ => cell.push(next),
        }
    }
    cells.push(cell);
    rows.push((first, cells));
    Sheet { name: String::new(), rows: trimmed(rows) }
}

fn trimmed(rows: Vec<(u32, Vec<String>)>) -> Vec<(u32, Vec<String>)> {
    let trim = |(row, cells): (u32, Vec<String>)| {
        (row, cells.into_iter().map(|cell| cell.trim().to_owned()).collect::<Vec<_>>())
    };
    rows.into_iter().map(trim).filter(|(_, cells)| cells.iter().any(|cell| !cell.is_empty())).collect()
}

/// The sheets of a workbook (`.xlsx`, ECMA-376 part 1, SpreadsheetML).
pub(super) fn of_workbook(bytes: &[u8]) -> Result<Vec<Sheet>, String> {
    let archive = Archive::new(bytes).map_err(|error| error.to_string())?;
    let parts = Parts::of(&archive)?;
    let workbook = parts.text("xl/workbook.xml")?;
    let workbook = document(&workbook)?;
    let links = parts.text("xl/_rels/workbook.xml.rels")?;
    let links = document(&links)?;
    let targets: HashMap<&str, &str> = elements(links.root(), "Relationship")
        .filter_map(|link| Some((link.attribute("Id")?, link.attribute("Target")?)))
        .collect();
    let shared: Vec<String> = match parts.text("xl/sharedStrings.xml") {
        Ok(text) => elements(document(&text)?.root(), "si").map(text_of).collect(),
        // A workbook without texts has no such part.
        Err(_) => Vec::new(),
    };
    let (mut sheets, mut room) = (Vec::new(), Room(MOST_CELL_BYTES));
    for sheet in elements(workbook.root(), "sheet") {
        let id = sheet.attributes().find(|attribute| attribute.name() == "id").map(|id| id.value());
        let Some(target) = id.and_then(|id| targets.get(id)) else { continue };
        let path = match target.strip_prefix('/') {
            Some(path) => path.to_owned(),
            None => format!("xl/{target}"),
        };
        // A sheet may be a chart.
        let text = match parts.text(&path) {
            Ok(text) => text,
            Err(_) if parts.left.get() > 0 => continue,
            Err(why) => return Err(why),
        };
        let name = sheet.attribute("name").unwrap_or_default().to_owned();
        sheets.push(Sheet { name, rows: trimmed(rows(&document(&text)?, &shared, &mut room)?) });
    }
    Ok(sheets)
}

/// How many bytes the cells of a workbook come to: a few letters can say that a row has 16 384 cells, and that a cell has a text that a thousand
/// others have.
const MOST_CELL_BYTES: usize = 128 << 20;
/// How many bytes of a workbook are unpacked altogether: a part may be several sheets.
const MOST_UNPACKED_BYTES: u64 = 256 << 20;

/// What a text or a row takes besides its letters or cells, about.
const ALLOCATION: usize = 64;

/// How many bytes cells may still come to.
struct Room(usize);

impl Room {
    fn take(&mut self, bytes: usize) -> Result<(), String> {
        let left = self.0.checked_sub(bytes);
        self.0 = left.ok_or("its cells come to more than 128 MiB; save the table of signals alone")?;
        Ok(())
    }
}

/// The parts of an archive, by their names.
struct Parts<'a> {
    archive: &'a Archive<'a>,
    members: HashMap<String, super::super::zip::Member>,
    left: Cell<u64>,
}

impl<'a> Parts<'a> {
    fn of(archive: &'a Archive<'a>) -> Result<Self, String> {
        let members = archive.members().map(|member| member.map(|member| (member.name.clone(), member)));
        let members = members.collect::<Result<_, _>>().map_err(|error| error.to_string())?;
        Ok(Self { archive, members, left: Cell::new(MOST_UNPACKED_BYTES) })
    }

    fn text(&self, name: &str) -> Result<String, String> {
        /// No table of signals is longer.
        const MOST_BYTES: u64 = 64 << 20;
        let member = self.members.get(name).ok_or_else(|| format!("it has no part {name}"))?;
        let most = MOST_BYTES.min(self.left.get());
        let bytes = self.archive.unpack(member, most).map_err(|error| {
            if most < MOST_BYTES {
                self.left.set(0);
            }
            format!("{name} {error}")
        })?;
        self.left.set(self.left.get() - bytes.len() as u64);
        String::from_utf8(bytes).map_err(|_| format!("{name} is not in UTF-8"))
    }
}

fn document(text: &str) -> Result<Document<'_>, String> {
    Document::parse(text).map_err(|error| error.to_string())
}

fn elements<'a>(of: Node<'a, 'a>, name: &'static str) -> impl Iterator<Item = Node<'a, 'a>> {
    of.descendants().filter(move |node| node.tag_name().name() == name)
}

/// The text of a string, without the readings of its characters.
fn text_of(of: Node<'_, '_>) -> String {
    let is_reading = |node: &Node<'_, '_>| node.ancestors().any(|around| around.tag_name().name() == "rPh");
    let texts = of.descendants().filter(|node| node.tag_name().name() == "t" && !is_reading(node));
    texts.filter_map(|node| node.text()).collect()
}

fn rows(sheet: &Document<'_>, shared: &[String], room: &mut Room) -> Result<Vec<(u32, Vec<String>)>, String> {
    /// Columns from A to XFD.
    const MOST_COLUMNS: usize = 16_384;
    let mut found: Vec<(u32, Vec<String>)> = Vec::new();
    for row in sheet.descendants().filter(|node| node.tag_name().name() == "row") {
        let before = found.last().map_or(0, |(number, _)| *number);
        let number = row.attribute("r").and_then(|number| number.parse().ok()).unwrap_or(before + 1);
        let mut cells: Vec<String> = Vec::new();
        for cell in row.children().filter(|node| node.tag_name().name() == "c") {
            let at = cell.attribute("r").and_then(column).unwrap_or(cells.len());
            if at >= MOST_COLUMNS {
                continue;
            }
            let value =
                cell.children().find(|node| node.tag_name().name() == "v").and_then(|node| node.text());
            let text = match (cell.attribute("t"), value) {
                (Some("s"), Some(value)) => value
                    .trim()
                    .parse::<usize>()
                    .ok()
                    .and_then(|at| shared.get(at))
                    .cloned()
                    .unwrap_or_default(),
                (Some("inlineStr"), _) => text_of(cell),
                // An error such as #REF! is no number either.
                (_, Some(value)) => value.to_owned(),
                // A formula that no program has calculated.
                (_, None) => {
                    let formula = cell.children().find(|node| node.tag_name().name() == "f");
                    formula
                        .and_then(|formula| formula.text())
                        .map_or_else(String::new, |text| format!("={text}"))
                }
            };
            let more = (at + 1).saturating_sub(cells.len());
            room.take(more * size_of::<String>() + text.len() + ALLOCATION)?;
            cells.resize(cells.len() + more, String::new());
            cells[at] = text;
        }
        room.take(size_of::<(u32, Vec<String>)>() + ALLOCATION)?;
        found.push((number, cells));
    }
    Ok(found)
}

/// The column of a cell such as `AB12`, from 0.
fn column(cell: &str) -> Option<usize> {
    let letters = cell.bytes().take_while(u8::is_ascii_uppercase);
    let number = letters.take(4).fold(0, |number, letter| number * 26 + usize::from(letter - b'A') + 1);
    number.checked_sub(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_split_at_what_they_have_most_of_and_quotes_keep_lines_together() {
        let rows = |text: &str| of_text(text).rows;
        let cells = |cells: &[&str]| cells.iter().map(|cell| (*cell).to_owned()).collect::<Vec<_>>();
        assert_eq!(
            rows("a;\"b\n\"\"c\"\"\" ;d\r\n;;\r\n1,5;2;3"),
            [(1, cells(&["a", "b\n\"c\"", "d"])), (4, cells(&["1,5", "2", "3"]))]
        );
        assert_eq!(rows("a\tb,c\n"), [(1, cells(&["a", "b,c"]))]);
        assert_eq!(
            (column("A1"), column("AB12"), column("XFD1"), column("12")),
            (Some(0), Some(27), Some(16_383), None)
        );
    }
}
