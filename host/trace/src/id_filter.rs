//! One identifier with a mask, as Linux's filters have it.

/// The flag for an extended identifier, as on Linux.
pub const EXTENDED: u32 = 1 << 31;
/// The flag for a remote frame, as on Linux.
pub const REMOTE: u32 = 1 << 30;
const STANDARD_BITS: u32 = 0x7FF;

/// One `ID:MASK` or `ID~MASK`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct IdFilter {
    /// The identifier, with [`EXTENDED`] and [`REMOTE`].
    pub id: u32,
    /// The bits that are compared.
    pub mask: u32,
    /// Accepts whatever does not match.
    pub inverse: bool,
}

impl IdFilter {
    /// The mask as the kernel applies it: a standard ID compared with its format has no bits above the
    /// eleventh.
    pub const fn effective_mask(&self) -> u32 {
        if self.mask & EXTENDED != 0 && self.id & EXTENDED == 0 {
            self.mask & (STANDARD_BITS | EXTENDED | REMOTE)
        } else {
            self.mask
        }
    }

    pub(crate) fn accepts(&self, id: u32) -> bool {
        ((id ^ self.id) & self.effective_mask() == 0) != self.inverse
    }
}
