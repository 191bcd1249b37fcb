//! Which column of a row has what.

use serde::{Deserialize, Serialize};

use super::TrcVersion;

/// Most columns a row can have before its data.
pub(super) const MAX_COLUMNS: usize = 16;

/// The content of each column, counted from 0.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Layout {
    pub offset: usize,
    pub kind: Option<usize>,
    pub bus: Option<usize>,
    pub id: usize,
    pub direction: Option<usize>,
    pub len: usize,
    /// The length is a number of bytes, not the bus's length code.
    pub len_is_bytes: bool,
    pub data: usize,
}

impl Layout {
    /// Whether all are columns that a row can have.
    pub(super) fn is_of_a_row(&self) -> bool {
        let Self { offset, kind, bus, id, direction, len, len_is_bytes: _, data } = *self;
        let columns = [Some(offset), kind, bus, Some(id), direction, Some(len), Some(data)];
        columns.into_iter().flatten().all(|column| column < MAX_COLUMNS)
    }

    /// The fixed columns of version 1, and those of 2.1 unless the header says otherwise.
    pub(super) fn of(version: TrcVersion) -> Self {
        let fixed = |kind, bus, id, len| {
            let direction = kind;
            Self { offset: 1, kind, bus, id, direction, len, len_is_bytes: false, data: len + 1 }
        };
        match version {
            TrcVersion::V1_0 => fixed(None, None, 2, 3),
            TrcVersion::V1_1 => fixed(Some(2), None, 3, 4),
            TrcVersion::V1_2 => fixed(Some(3), Some(2), 4, 5),
            TrcVersion::V1_3 => fixed(Some(3), Some(2), 4, 6),
            TrcVersion::V2_0 => Self::named(b"N,O,T,I,d,l,D").unwrap_or(fixed(None, None, 3, 5)),
            TrcVersion::V2_1 => Self::named(b"N,O,T,B,I,d,R,L,D").unwrap_or(fixed(None, None, 4, 7)),
        }
    }

    /// The columns that `$COLUMNS` names.
    pub(super) fn named(names: &[u8]) -> Option<Self> {
        let names: Vec<&[u8]> = names.split(|byte| *byte == b',').map(<[u8]>::trim_ascii).collect();
        let find = |name: &[u8]| names.iter().position(|known| *known == name);
        if names.len() > MAX_COLUMNS {
            return None;
        }
        Some(Self {
            offset: find(b"O")?,
            kind: find(b"T"),
            bus: find(b"B"),
            id: find(b"I")?,
            direction: find(b"d"),
            len: find(b"L").or_else(|| find(b"l"))?,
            len_is_bytes: find(b"L").is_none(),
            data: find(b"D")?,
        })
    }
}
