//! What a cell says in words about its frame: `DATA`, `Ext. Remote Frm.`, `Std`, `CAN FD BRS`, `Error Frame`.

use super::super::text;
use cantap_trace::Direction;

/// What the cells of a row that describe its frame say, as far as they do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Kind {
    /// Whether its identifier has 29 bits.
    pub extended: Option<bool>,
    pub remote: Option<bool>,
    pub direction: Option<Direction>,
    /// It is a CAN FD frame.
    pub fd: bool,
    pub brs: bool,
    pub esi: bool,
    /// It is no frame but an error on the bus, or an overload frame.
    pub is_error: bool,
}

impl Kind {
    /// Of one cell. A letter alone says something in a column of types, and may be anything in one of flags.
    pub(super) fn of(cell: &[u8], is_type: bool) -> Self {
        let mut kind = Self::default();
        if cell.len() == 1 && !is_type {
            return kind;
        }
        // CSS Electronics' older loggers: bit 0 is that of 29 bits, bit 3 that of a sent frame.
        if let (Some(number @ (0 | 1 | 8 | 9)), 1) = (text::decimal(cell), cell.len()) {
            kind.extended = Some(number & 1 != 0);
            kind.direction = (number & 8 != 0).then_some(Direction::Tx);
            return kind;
        }
        let words = cell.split(|byte| !byte.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
        let mut words = words.map(<[u8]>::to_ascii_lowercase).peekable();
        while let Some(word) = words.next() {
            // A name and whether it holds, such as `RTR=0`.
            let holds = !matches!(words.peek().map(Vec::as_slice), Some(b"0" | b"false" | b"no"));
            match word.as_slice() {
                b"x" | b"e" | b"ext" | b"extended" | b"xtd" | b"eff" | b"29" | b"29bit" => {
                    kind.extended = Some(holds);
                }
                b"s" | b"std" | b"standard" | b"base" | b"sff" | b"11" | b"11bit" => {
                    kind.extended = Some(false);
                }
                b"r" | b"rtr" | b"remote" | b"remoteframe" => kind.remote = Some(holds),
                b"d" | b"data" | b"dataframe" => kind.remote = kind.remote.or(Some(false)),
                b"rx" | b"received" => kind.direction = Some(Direction::Rx),
                b"tx" | b"sent" | b"transmitted" | b"self" => kind.direction = Some(Direction::Tx),
                b"fd" | b"fdf" | b"edl" | b"canfd" => kind.fd |= holds,
                b"brs" => kind.brs |= holds,
                b"esi" => kind.esi |= holds,
                b"err" | b"error" | b"errorframe" | b"overload" | b"overloadframe" => kind.is_error |= holds,
                _ => {}
            }
        }
        kind
    }

    /// What both say; the first counts where they differ.
    pub(super) fn and(self, other: Self) -> Self {
        Self {
            extended: self.extended.or(other.extended),
            remote: self.remote.filter(|remote| *remote).or(other.remote).or(self.remote),
            direction: self.direction.or(other.direction),
            fd: self.fd | other.fd,
            brs: self.brs | other.brs,
            esi: self.esi | other.esi,
            is_error: self.is_error | other.is_error,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_say_what_a_frame_is() {
        let all = |cells: &[&str]| {
            cells.iter().fold(Kind::default(), |kind, cell| kind.and(Kind::of(cell.as_bytes(), true)))
        };
        let frame = Kind::default();
        let data = Kind { remote: Some(false), ..frame };
        for (cells, kind) in [
            (&["DATA"][..], data),
            (&["REMOTE"], Kind { remote: Some(true), ..frame }),
            (&["Data Frm.", "Std"], Kind { extended: Some(false), ..data }),
            (&["Remote Frm.", "Ext"], Kind { remote: Some(true), extended: Some(true), ..frame }),
            (&["Base Data"], Kind { extended: Some(false), ..data }),
            (
                &["Std", "RTR Self"],
                Kind { extended: Some(false), remote: Some(true), direction: Some(Direction::Tx), ..frame },
            ),
            (&["Data", "RTR"], Kind { remote: Some(true), ..frame }),
            (&["RTR=0 EXT=1"], Kind { remote: Some(false), extended: Some(true), ..frame }),
            (&["CAN FD BRS"], Kind { fd: true, brs: true, ..frame }),
            (&["8"], Kind { extended: Some(false), direction: Some(Direction::Tx), ..frame }),
            (&["1"], Kind { extended: Some(true), ..frame }),
            (&["Error Frame"], Kind { is_error: true, ..frame }),
            (&["Ack Err."], Kind { is_error: true, ..frame }),
            (&["CAN Frame", "OK", "", "benign"], frame),
        ] {
            assert_eq!(all(cells), kind, "{cells:?}");
        }
        assert_eq!(Kind::of(b"R", false), frame);
    }
}
