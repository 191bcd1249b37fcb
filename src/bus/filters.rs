//! Compiles filters into the controllers' 28 banks.
//!
//! A bank of bxCAN (RM0090 Rev 21 §32.7.4) holds one 29-bit identifier with a mask, or two without, or
//! two 11-bit identifiers with masks, or four without. Banks below the split belong to CAN1, the others to CAN2.

use cantap_wire::message::{Filter, FrameKind};
use cantap_wire::{CHANNELS, Channel, Frame, Id, Refusal};

/// Banks of the chip, for both channels.
pub const BANKS: usize = 28;
/// Where CAN2's banks begin unless one channel needs more than half.
const DEFAULT_SPLIT: usize = BANKS / 2;

/// What a bank's two registers mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// One identifier and its mask, 32 bits each.
    Mask32,
    /// Two identifiers of 32 bits.
    List32,
    /// Two pairs of identifier (low half) and mask (high half).
    Mask16,
    /// Four identifiers of 16 bits.
    List16,
}

/// One bank.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bank {
    /// What the registers mean.
    pub shape: Shape,
    /// FiR1.
    pub first: u32,
    /// FiR2.
    pub second: u32,
}

impl Bank {
    /// Lets every frame pass.
    pub const ALL: Bank = Bank { shape: Shape::Mask32, first: 0, second: 0 };

    /// Whether it lets a frame pass (RM0090 Rev 21 §32.7.4): what a controller's hardware does, for those that have none.
    pub fn passes(&self, frame: &Frame) -> bool {
        let (id, extended, remote) =
            (frame.id().raw(), frame.id().is_extended(), u32::from(frame.is_remote()));
        let standard_part = if extended { id >> 18 } else { id };
        let wide = if extended { id << 3 | 1 << 2 } else { id << 21 } | remote << 1;
        let extended_part = if extended { id >> 15 & 7 } else { 0 };
        let narrow = standard_part << 5 | remote << 4 | u32::from(extended) << 3 | extended_part;
        let halves = [self.first & 0xFFFF, self.first >> 16, self.second & 0xFFFF, self.second >> 16];
        match self.shape {
            Shape::Mask32 => (wide ^ self.first) & self.second == 0,
            Shape::List32 => [self.first, self.second].contains(&wide),
            Shape::Mask16 => (narrow ^ halves[0]) & halves[1] == 0 || (narrow ^ halves[2]) & halves[3] == 0,
            Shape::List16 => halves.contains(&narrow),
        }
    }
}

/// All banks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// The first bank of CAN2: CAN2SB.
    pub split: u8,
    /// The banks; `None` is switched off. Frames go to FIFO 0.
    pub banks: [Option<Bank>; BANKS],
}

impl Layout {
    /// Both channels receive everything.
    pub const fn open() -> Self {
        let mut banks = [None; BANKS];
        banks[0] = Some(Bank::ALL);
        banks[DEFAULT_SPLIT] = Some(Bank::ALL);
        Self { split: DEFAULT_SPLIT as u8, banks }
    }

    /// A channel's banks.
    fn of(&self, channel: Channel) -> &[Option<Bank>] {
        let (first, second) = self.banks.split_at(self.split as usize);
        match channel {
            Channel::Can1 => first,
            Channel::Can2 => second,
        }
    }

    /// Banks that a channel uses.
    pub fn used(&self, channel: Channel) -> usize {
        self.of(channel).iter().flatten().count()
    }

    /// This layout with one channel's filters replaced.
    pub fn with(&self, channel: Channel, filters: &[Filter]) -> Result<Self, Refusal> {
        let mut packer = Packer::new();
        for filter in filters {
            packer.add(filter)?;
        }
        let banks = packer.finish();
        let other = match channel {
            Channel::Can1 => Channel::Can2,
            Channel::Can2 => Channel::Can1,
        };
        let available = BANKS - self.used(other);
        if banks.needed > available {
            return Err(Refusal::BanksExhausted { needed: banks.needed as u8, available: available as u8 });
        }
        let mut parts: [&[Option<Bank>]; CHANNELS] = [&banks.banks[..banks.needed]; CHANNELS];
        parts[other.index()] = &self.of(other)[..self.used(other)];
        let [first, second] = parts;
        let split = DEFAULT_SPLIT.clamp(first.len(), BANKS - second.len());
        let mut layout = Self { split: split as u8, banks: [None; BANKS] };
        layout.banks[..first.len()].copy_from_slice(first);
        layout.banks[split..split + second.len()].copy_from_slice(second);
        Ok(layout)
    }

    /// Whether changing from `self` to `next` needs the filters' initialisation mode, in which neither
    /// channel receives: the split, or any bank's shape or use, differs. (RM0090 Rev 21 §32.9.4: FM1R, FS1R and
    /// FFA1R can only be written then.) The contents of a closed channel's banks do not need it.
    pub fn disturbs(&self, next: &Self) -> bool {
        let shape = |bank: &Option<Bank>| bank.map(|bank| bank.shape);
        self.split != next.split || !self.banks.iter().map(shape).eq(next.banks.iter().map(shape))
    }
}

/// Packs entries of the four kinds into banks.
struct Packer {
    banks: [Option<Bank>; BANKS],
    needed: usize,
    mask16: Pack<2>,
    list16: Pack<4>,
    list32: Pack<2>,
}

/// Entries of one kind, not yet enough to fill a bank.
struct Pack<const N: usize> {
    entries: [u32; N],
    len: usize,
}

impl<const N: usize> Pack<N> {
    const fn new() -> Self {
        Self { entries: [0; N], len: 0 }
    }

    /// Adds an entry; returns a bank's worth once there are enough.
    fn add(&mut self, entry: u32) -> Option<[u32; N]> {
        self.entries[self.len] = entry;
        self.len += 1;
        (self.len == N).then(|| {
            self.len = 0;
            self.entries
        })
    }

    fn take(&mut self) -> Self {
        core::mem::replace(self, Self::new())
    }

    /// The remaining entries, padded with copies of the last.
    fn rest(mut self) -> Option<[u32; N]> {
        let last = *self.entries.get(self.len.checked_sub(1)?)?;
        self.entries[self.len..].fill(last);
        Some(self.entries)
    }
}

struct Packed {
    banks: [Option<Bank>; BANKS],
    needed: usize,
}

impl Packer {
    const fn new() -> Self {
        Self {
            banks: [None; BANKS],
            needed: 0,
            mask16: Pack::new(),
            list16: Pack::new(),
            list32: Pack::new(),
        }
    }

    fn add(&mut self, filter: &Filter) -> Result<(), Refusal> {
        if !filter.is_valid() {
            return Err(Refusal::BadId);
        }
        let widest = if filter.extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
        let remote = u32::from(filter.kind == FrameKind::Remote);
        let listed = filter.mask == widest && filter.kind != FrameKind::Any;
        let kind_counts = u32::from(filter.kind != FrameKind::Any);
        if filter.extended {
            // STID[10:0] EXID[17:0] IDE RTR 0
            const IDE: u32 = 1 << 2;
            let id = filter.id << 3 | IDE | remote << 1;
            if listed {
                if let Some([first, second]) = self.list32.add(id) {
                    self.put(Bank { shape: Shape::List32, first, second });
                }
            } else {
                let mask = filter.mask << 3 | IDE | kind_counts << 1;
                self.put(Bank { shape: Shape::Mask32, first: id, second: mask });
            }
        } else {
            // STID[10:0] RTR IDE EXID[17:15]
            const IDE: u32 = 1 << 3;
            let id = filter.id << 5 | remote << 4;
            if listed {
                if let Some(entries) = self.list16.add(id) {
                    self.put(list16(entries));
                }
            } else {
                let mask = filter.mask << 5 | kind_counts << 4 | IDE;
                if let Some([first, second]) = self.mask16.add(mask << 16 | id) {
                    self.put(Bank { shape: Shape::Mask16, first, second });
                }
            }
        }
        Ok(())
    }

    fn put(&mut self, bank: Bank) {
        if let Some(place) = self.banks.get_mut(self.needed) {
            *place = Some(bank);
        }
        self.needed += 1;
    }

    fn finish(mut self) -> Packed {
        if let Some([first, second]) = self.mask16.take().rest() {
            self.put(Bank { shape: Shape::Mask16, first, second });
        }
        if let Some([first, second]) = self.list32.take().rest() {
            self.put(Bank { shape: Shape::List32, first, second });
        }
        if let Some(entries) = self.list16.take().rest() {
            self.put(list16(entries));
        }
        if self.needed == 0 {
            self.put(Bank::ALL);
        }
        Packed { banks: self.banks, needed: self.needed }
    }
}

const fn list16([a, b, c, d]: [u32; 4]) -> Bank {
    Bank { shape: Shape::List16, first: b << 16 | a, second: d << 16 | c }
}
