//! The table as CSV.

use super::encode::{Layout, TableRow};
use super::{COLUMNS, TableStyle};

/// Writes the table as CSV.
pub(crate) struct CsvLayout(pub(crate) TableStyle);

impl Layout for CsvLayout {
    fn head(&mut self, date: &str, out: &mut Vec<u8>) {
        let Self(style) = self;
        let end = style.line_end();
        for comment in [date, "Filter: as captured"] {
            out.extend_from_slice(b"# ");
            out.extend_from_slice(comment.as_bytes());
            out.extend_from_slice(end);
        }
        for (at, name) in COLUMNS.iter().enumerate() {
            if at > 0 {
                out.push(style.separator);
            }
            out.extend_from_slice(name.as_bytes());
        }
        out.extend_from_slice(end);
    }

    fn row(&self, row: &TableRow, out: &mut Vec<u8>) {
        let Self(style) = self;
        let mut first = true;
        row.cells(style.decimal_mark, |_, cell| {
            if !std::mem::replace(&mut first, false) {
                out.push(style.separator);
            }
            out.extend_from_slice(cell);
        });
        out.extend_from_slice(style.line_end());
    }
}
