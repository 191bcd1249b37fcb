//! What a board counts, at one moment.

/// A board's figures.
pub(crate) struct BoardFigures {
    pub is_there: bool,
    pub clients: u64,
    pub places: u64,
    pub pages: u64,
    pub refused: u64,
    /// Whether it counts the losses of its own controllers.
    pub counts_losses: bool,
    pub channels: crate::totals::Totals,
    pub bitrates_bps: [Option<u32>; cantap_wire::CHANNELS],
}
