//! The external interrupts (RM0090 Rev 21 §12): a line for each pin number, connected to one port's pin by SYSCFG_EXTICR. It becomes
//! pending on the selected edges, whether masked or not.

/// Interrupt numbers of the pins' lines: 0 to 4 have their own, 5 to 9 and 10 to 15 share one (RM0090 Rev 21 Table 61).
const IRQS: [(u32, u16); 7] =
    [(1, 6), (1 << 1, 7), (1 << 2, 8), (1 << 3, 9), (1 << 4, 10), (0x3E0, 23), (0xFC00, 40)];
/// Lines 0 to 22.
const LINES: u32 = 0x7F_FFFF;

/// The lines' registers.
#[derive(Clone, Copy, Debug, Default)]
pub struct Exti {
    interrupts: u32,
    events: u32,
    rising: u32,
    falling: u32,
    software: u32,
    pending: u32,
}

impl Exti {
    /// Reads a register; `None` where there is none.
    pub fn read(&self, offset: u32) -> Option<u32> {
        Some(match offset {
            0x00 => self.interrupts,
            0x04 => self.events,
            0x08 => self.rising,
            0x0C => self.falling,
            0x10 => self.software,
            0x14 => self.pending,
            _ => return None,
        })
    }

    /// Writes a register; `None` where there is none.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<()> {
        let value = value & LINES;
        match offset {
            0x00 => self.interrupts = value,
            0x04 => self.events = value,
            0x08 => self.rising = value,
            0x0C => self.falling = value,
            0x10 => {
                self.pending |= value & !self.software & self.interrupts;
                self.software |= value;
            }
            // Cleared by writing 1, which also clears what software had set.
            0x14 => {
                self.pending &= !value;
                self.software &= !value;
            }
            _ => return None,
        }
        Some(())
    }

    /// The level of the pin connected to a line has changed.
    pub fn edge(&mut self, line: u32, rising: bool) {
        self.pending |= if rising { self.rising } else { self.falling } & 1 << line;
    }

    /// Whether an edge of this line would interrupt.
    pub fn watches(&self, line: u32) -> bool {
        self.interrupts & (self.rising | self.falling) & 1 << line != 0
    }

    /// The interrupt lines that are asserted; bit n is interrupt n.
    pub fn lines(&self) -> u128 {
        let asserted = self.pending & self.interrupts;
        IRQS.iter().filter(|(lines, _)| asserted & lines != 0).fold(0, |all, (_, irq)| all | 1 << irq)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const IMR: u32 = 0x00;
    const RTSR: u32 = 0x08;
    const FTSR: u32 = 0x0C;
    const SWIER: u32 = 0x10;
    const PR: u32 = 0x14;

    #[test]
    fn only_edges_that_are_asked_for_become_pending_and_a_mask_only_keeps_them_back() {
        let mut exti = Exti::default();
        exti.write(FTSR, 1 << 8).unwrap();
        exti.edge(8, true);
        exti.edge(9, false);
        assert_eq!(exti.read(PR), Some(0));
        exti.edge(8, false);
        assert_eq!((exti.read(PR), exti.lines()), (Some(1 << 8), 0));
        exti.write(IMR, 1 << 8).unwrap();
        assert_eq!(exti.lines(), 1 << 23);
        exti.write(PR, !(1 << 8)).unwrap();
        assert_eq!(exti.lines(), 1 << 23, "zeros clear nothing");
        exti.write(PR, 1 << 8).unwrap();
        assert_eq!(exti.lines(), 0);
    }

    #[test]
    fn each_line_has_its_interrupt() {
        for (line, irq) in [(0, 6), (4, 10), (5, 23), (9, 23), (10, 40), (15, 40)] {
            let mut exti = Exti::default();
            for (offset, value) in [(RTSR, 1 << line), (IMR, 1 << line)] {
                exti.write(offset, value).unwrap();
            }
            assert!(exti.watches(line));
            exti.edge(line, true);
            assert_eq!(exti.lines(), 1 << irq, "line {line}");
        }
    }

    #[test]
    fn software_raises_a_line_until_it_is_cleared() {
        let mut exti = Exti::default();
        exti.write(IMR, 2).unwrap();
        exti.write(SWIER, 3).unwrap();
        assert_eq!((exti.read(PR), exti.lines()), (Some(2), 1 << 7));
        exti.write(PR, 3).unwrap();
        assert_eq!((exti.read(PR), exti.read(SWIER)), (Some(0), Some(0)));
    }
}
