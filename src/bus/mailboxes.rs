//! What is in a controller's transmit mailboxes.

use cantap_wire::message::{GATEWAY_TAG, OTHERS_TAG};

use crate::bus::outgoing::Outgoing;

/// Transmit mailboxes of a controller.
pub const MAILBOXES: usize = 3;

/// Frames by mailbox, with their tags. The count is kept because it is read far more often than it
/// changes.
pub(crate) struct Mailboxes {
    places: [Option<(u32, Outgoing)>; MAILBOXES],
    taken: usize,
}

impl Mailboxes {
    /// All empty.
    pub const fn new() -> Self {
        Self { places: [None; MAILBOXES], taken: 0 }
    }

    /// How many hold a frame.
    #[inline]
    pub const fn len(&self) -> usize {
        self.taken
    }

    /// Whether all hold a frame.
    #[inline]
    pub const fn are_full(&self) -> bool {
        self.taken == MAILBOXES
    }

    /// A frame was written to an empty one.
    #[inline]
    pub fn put(&mut self, mailbox: u8, tag: u32, frame: Outgoing) {
        if let Some(place) = self.places.get_mut(usize::from(mailbox)) {
            self.taken += usize::from(place.is_none());
            *place = Some((tag, frame));
        }
    }

    /// Empties a mailbox; `None` if it was empty already.
    #[inline]
    pub fn take(&mut self, mailbox: u8) -> Option<(u32, Outgoing)> {
        let held = self.places.get_mut(usize::from(mailbox))?.take()?;
        self.taken -= 1;
        Some(held)
    }

    /// How many hold a frame of the gateway's.
    pub fn passed(&self) -> usize {
        self.places.iter().flatten().filter(|(tag, _)| *tag >= GATEWAY_TAG).count()
    }

    /// Frames that are not the gateway's become nobody's. Returns whether there are any.
    pub fn disown(&mut self) -> bool {
        let mut any = false;
        for (tag, _) in self.places.iter_mut().flatten() {
            if *tag < GATEWAY_TAG {
                (*tag, any) = (OTHERS_TAG, true);
            }
        }
        any
    }

    /// The first that holds a frame, with its tag.
    pub fn first(&self) -> Option<(u8, u32)> {
        (0..).zip(&self.places).find_map(|(mailbox, place)| place.map(|(tag, _)| (mailbox, tag)))
    }
}
