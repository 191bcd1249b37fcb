//! The 28 acceptance filter banks that both controllers share (RM0090 Rev 21 §32.7.4, §32.9.5). Their
//! registers are CAN1's; CAN2SB divides the banks between the two.

/// Filter banks of the two controllers together.
pub const BANKS: usize = 28;

/// FMR.FINIT: the banks may be set up and nothing is received.
const FINIT: u32 = 1;
/// FMR's reset value: initialisation mode, CAN2 starts at bank 14.
const FMR_RESET: u32 = 0x2A1C_0E01;
/// A bit for every bank.
const ALL_BANKS: u32 = (1 << BANKS) - 1;

/// Which FIFO a frame goes to, and by which filter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Match {
    /// 0 or 1.
    pub fifo: usize,
    /// The filter match index: the number among that FIFO's filters.
    pub index: u8,
}

/// What CAN2SB = 0 means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ZeroSplit {
    /// CAN1 has no bank, as the reference manual says. Nothing of ours may depend on anything else.
    #[default]
    NoBank,
    /// CAN1 has them all: firmware that clears CAN2SB and uses CAN1 (candleLight's) is in use on real chips.
    AllBanks,
}

/// The filter registers.
#[derive(Clone, Debug)]
pub struct Filters {
    /// What a start of CAN2's banks at 0 means.
    pub zero_split: ZeroSplit,
    fmr: u32,
    /// FM1R: 1 is identifier list, 0 is mask.
    list: u32,
    /// FS1R: 1 is one 32-bit filter, 0 two of 16 bits.
    wide: u32,
    /// FFA1R: which FIFO.
    fifo: u32,
    /// FA1R: which banks are active.
    active: u32,
    banks: [[u32; 2]; BANKS],
}

impl Default for Filters {
    fn default() -> Self {
        let zero_split = ZeroSplit::default();
        Self { zero_split, fmr: FMR_RESET, list: 0, wide: 0, fifo: 0, active: 0, banks: [[0; 2]; BANKS] }
    }
}

impl Filters {
    /// The same chip's after a reset.
    #[must_use]
    pub fn after_reset(&self) -> Self {
        Self { zero_split: self.zero_split, ..Self::default() }
    }

    /// Reads a register at its offset from the controller's base (0x200 to 0x31C).
    pub fn read(&self, offset: u32) -> Option<u32> {
        Some(match offset {
            0x200 => self.fmr,
            0x204 => self.list,
            0x20C => self.wide,
            0x214 => self.fifo,
            0x21C => self.active,
            0x240..0x320 => self.banks[((offset - 0x240) / 8) as usize][half(offset)],
            _ => return None,
        })
    }

    /// Writes a register; `None` where there is none, or if the hardware would not accept it.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<()> {
        let init = self.fmr & FINIT != 0;
        match offset {
            0x200 => self.fmr = FMR_RESET & !0x3F01 | value & 0x3F01,
            // Mode, scale and FIFO can only be set in initialisation mode, a bank's registers also
            // while it is inactive.
            0x204 if init => self.list = value & ALL_BANKS,
            0x20C if init => self.wide = value & ALL_BANKS,
            0x214 if init => self.fifo = value & ALL_BANKS,
            0x21C => self.active = value & ALL_BANKS,
            0x240..0x320 => {
                let bank = (offset - 0x240) / 8;
                if !init && self.active >> bank & 1 != 0 {
                    return None;
                }
                self.banks[bank as usize][half(offset)] = value;
            }
            _ => return None,
        }
        Some(())
    }

    /// Looks up a frame received by controller 0 or 1, given as the word that RIxR would hold (identifier,
    /// IDE, RTR). 32-bit filters win over 16-bit ones, lists over masks, low numbers over high ones.
    pub fn accept(&self, controller: usize, word: u32) -> Option<Match> {
        if self.fmr & FINIT != 0 {
            return None;
        }
        let split = ((self.fmr >> 8 & 0x3F) as usize).min(BANKS);
        let banks = match (controller, split) {
            (0, 0) if self.zero_split == ZeroSplit::AllBanks => 0..BANKS,
            (0, _) => 0..split,
            _ => split..BANKS,
        };
        let short = short_form(word);
        let mut next_index = [0u8; 2];
        let mut best: Option<(u8, Match)> = None;
        for bank in banks {
            let [first, second] = self.banks[bank];
            let bit = |register: u32| register >> bank & 1 != 0;
            let (wide, list, fifo) = (bit(self.wide), bit(self.list), usize::from(bit(self.fifo)));
            let halves = [first as u16, (first >> 16) as u16, second as u16, (second >> 16) as u16];
            // Bit 0 of a 32-bit filter is reserved.
            let differs = |filter: u32| (filter ^ word) & !1;
            let differs_short = |filter: u16| filter ^ short;
            let hits: &[bool] = match (wide, list) {
                (true, false) => &[differs(first) & second == 0],
                (true, true) => &[differs(first) == 0, differs(second) == 0],
                (false, false) => {
                    &[differs_short(halves[0]) & halves[1] == 0, differs_short(halves[2]) & halves[3] == 0]
                }
                (false, true) => &halves.map(|half| differs_short(half) == 0),
            };
            // Inactive banks are numbered too.
            let base = next_index[fifo];
            next_index[fifo] += hits.len() as u8;
            if !bit(self.active) {
                continue;
            }
            if let Some(position) = hits.iter().position(|hit| *hit) {
                let rank = match (wide, list) {
                    (true, true) => 0,
                    (true, false) => 1,
                    (false, true) => 2,
                    (false, false) => 3,
                };
                if best.is_none_or(|(best, _)| rank < best) {
                    best = Some((rank, Match { fifo, index: base + position as u8 }));
                }
            }
        }
        best.map(|(_, found)| found)
    }
}

/// Whether an offset names a bank's first or second register.
fn half(offset: u32) -> usize {
    (offset / 4 % 2) as usize
}

/// The 16-bit form of an identifier word: STID, RTR, IDE, EXID[17:15].
fn short_form(word: u32) -> u16 {
    let (stid, exid_high) = (word >> 21 & 0x7FF, word >> 18 & 7);
    let (ide, rtr) = (word >> 2 & 1, word >> 1 & 1);
    (stid << 5 | rtr << 4 | ide << 3 | exid_high) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    const IDE: u32 = 4;
    const RTR: u32 = 2;

    fn std(id: u32) -> u32 {
        id << 21
    }

    fn ext(id: u32) -> u32 {
        id << 3 | IDE
    }

    /// Sets up banks as (number, wide, list, fifo, registers), all active, CAN2 from bank 14.
    fn filters(banks: &[(u32, bool, bool, bool, [u32; 2])]) -> Filters {
        let mut filters = Filters::default();
        let mut registers = [0u32; 4];
        for (bank, wide, list, fifo, values) in banks {
            for (register, set) in registers.iter_mut().zip([*list, *wide, *fifo, true]) {
                *register |= u32::from(set) << bank;
            }
            filters.write(0x240 + 8 * bank, values[0]).unwrap();
            filters.write(0x244 + 8 * bank, values[1]).unwrap();
        }
        for (offset, value) in [0x204, 0x20C, 0x214, 0x21C].into_iter().zip(registers) {
            filters.write(offset, value).unwrap();
        }
        filters.write(0x200, 14 << 8).unwrap();
        filters
    }

    fn to(fifo: usize, index: u8) -> Match {
        Match { fifo, index }
    }

    #[test]
    fn a_32_bit_mask_takes_its_identifiers_and_no_other() {
        let filters = filters(&[(0, true, false, false, [std(0x120), std(0x7F0) | IDE | RTR])]);
        assert_eq!(filters.accept(0, std(0x120)), Some(to(0, 0)));
        assert_eq!(filters.accept(0, std(0x12F)), Some(to(0, 0)));
        for other in [std(0x130), std(0x120) | RTR, ext(0x120 << 18)] {
            assert_eq!(filters.accept(0, other), None);
        }
    }

    #[test]
    fn a_32_bit_list_takes_exactly_its_two() {
        let filters = filters(&[(0, true, true, true, [std(0x123), ext(0x1234_5678)])]);
        assert_eq!(filters.accept(0, std(0x123)), Some(to(1, 0)));
        assert_eq!(filters.accept(0, ext(0x1234_5678)), Some(to(1, 1)));
        for other in [std(0x122), ext(0x1234_5679), std(0x123) | RTR, ext(0x123)] {
            assert_eq!(filters.accept(0, other), None);
        }
    }

    #[test]
    fn the_16_bit_forms_see_the_upper_three_extended_bits() {
        let short = |word| u32::from(short_form(word));
        let list = filters(&[(
            0,
            false,
            true,
            false,
            [short(std(1)) | short(std(2)) << 16, short(std(3)) | short(ext(7 << 15)) << 16],
        )]);
        assert_eq!(list.accept(0, std(1)), Some(to(0, 0)));
        assert_eq!(list.accept(0, std(3)), Some(to(0, 2)));
        assert_eq!(list.accept(0, ext(7 << 15 | 0x1234)), Some(to(0, 3)));
        assert_eq!(list.accept(0, ext(6 << 15)), None);
        assert_eq!(list.accept(0, std(4)), None);
        let mask = filters(&[(
            0,
            false,
            false,
            false,
            [short(std(0x100)) | 0xE000 << 16, short(std(0x7FF)) | 0xFFFF << 16],
        )]);
        assert_eq!(mask.accept(0, std(0x1AB)), Some(to(0, 0)));
        assert_eq!(mask.accept(0, std(0x7FF)), Some(to(0, 1)));
        assert_eq!(mask.accept(0, std(0x2AB)), None);
    }

    #[test]
    fn a_list_wins_over_a_mask_and_wide_over_narrow() {
        let everything = [0, 0];
        let filters = filters(&[
            (0, false, false, false, everything),
            (1, true, false, true, everything),
            (2, true, true, false, [std(5), std(6)]),
        ]);
        assert_eq!(filters.accept(0, std(5)), Some(to(0, 2)), "the list, numbered after bank 0's two masks");
        assert_eq!(filters.accept(0, std(9)), Some(to(1, 0)), "the 32-bit mask before the 16-bit one");
    }

    #[test]
    fn the_banks_are_divided_between_the_controllers() {
        let filters =
            filters(&[(13, true, true, false, [std(1), std(1)]), (14, true, true, false, [std(2), std(2)])]);
        // Bank 13 is CAN1's fourteenth; the inactive ones before it hold two 16-bit masks each.
        assert_eq!(filters.accept(0, std(1)), Some(to(0, 26)));
        assert_eq!(filters.accept(0, std(2)), None);
        assert_eq!(filters.accept(1, std(2)), Some(to(0, 0)));
        assert_eq!(filters.accept(1, std(1)), None);
    }

    #[test]
    fn nothing_is_received_in_filter_initialisation() {
        let mut filters = filters(&[(0, true, false, false, [0, 0])]);
        assert_eq!(filters.accept(0, std(1)), Some(to(0, 0)));
        filters.write(0x200, 14 << 8 | FINIT).unwrap();
        assert_eq!(filters.accept(0, std(1)), None);
    }

    #[test]
    fn a_bank_in_use_cannot_be_changed() {
        let mut filters = filters(&[(0, true, false, false, [0, 0])]);
        assert_eq!(filters.write(0x240, 1), None);
        assert_eq!(filters.write(0x204, 1), None);
        assert_eq!(filters.write(0x248, 1), Some(()), "bank 1 is inactive");
    }
}
