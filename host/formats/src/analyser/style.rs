//! How the analyser's tables look.

/// How lines end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LineEnd {
    /// As on Windows, where the analyser's program ran.
    #[default]
    CrLf,
    /// As on Unix.
    Lf,
}

/// What `VECTORS` counts in a DIF file, and what follows a number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DifConvention {
    /// As DIF was defined: `VECTORS` are columns, `TUPLES` rows; `V` follows a number.
    #[default]
    Columns,
    /// As in some spreadsheets: `VECTORS` are rows, `TUPLES` columns; an empty line follows a number.
    Rows,
}

/// How the analyser's tables are written. Reading detects it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TableStyle {
    /// What separates columns of CSV.
    pub separator: u8,
    /// The decimal mark.
    pub decimal_mark: u8,
    /// How lines end.
    pub line_end: LineEnd,
    /// Which kind of DIF.
    pub dif: DifConvention,
}

impl Default for TableStyle {
    fn default() -> Self {
        Self { separator: b';', decimal_mark: b',', line_end: LineEnd::CrLf, dif: DifConvention::Columns }
    }
}

impl TableStyle {
    pub(crate) fn line_end(self) -> &'static [u8] {
        match self.line_end {
            LineEnd::CrLf => b"\r\n",
            LineEnd::Lf => b"\n",
        }
    }
}
