//! The memory that a bootloader describes in the name of its interface.

use std::ops::Range;

/// A part that is erased as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sector {
    /// Its first address.
    pub address: u32,
    /// In bytes.
    pub length: u32,
    writable: bool,
}

/// All of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    sectors: Vec<Sector>,
}

impl Layout {
    /// From a description as `@Internal Flash  /0x08000000/04*016Kg,01*064Kg,07*128Kg` (UM0424, 10.3.2): a name, and for each region its
    /// start and groups of a number of sectors, their length, and a letter for what may be done with them.
    pub fn parse(text: &str) -> Option<Self> {
        let mut parts = text.strip_prefix('@')?.split('/').skip(1);
        let mut sectors = Vec::new();
        while let (Some(start), Some(groups)) = (parts.next(), parts.next()) {
            let mut address = u32::from_str_radix(start.trim().strip_prefix("0x")?, 16).ok()?;
            for group in groups.trim().split(',') {
                let (count, length) = group.split_once('*')?;
                let digits = length.find(|character: char| !character.is_ascii_digit())?;
                let (number, unit) = length.split_at(digits);
                let mut unit = unit.chars();
                // A blank instead of B says bytes, too.
                let factor = match unit.next()? {
                    'K' => 1 << 10,
                    'M' => 1 << 20,
                    'B' | ' ' => 1,
                    _ => return None,
                };
                // Bit 0 readable, 1 erasable, 2 writable.
                let may = u32::from(unit.next()?).wrapping_sub(u32::from('`'));
                let length = number.parse::<u32>().ok()?.checked_mul(factor).filter(|length| *length > 0)?;
                for _ in 0..count.trim().parse::<u16>().ok()? {
                    sectors.push(Sector { address, length, writable: may & 0b110 == 0b110 });
                    address = address.checked_add(length)?;
                }
            }
        }
        (!sectors.is_empty()).then_some(Self { sectors })
    }

    /// The sectors of the memory from one address up to another, or the first address that cannot be written.
    pub fn sectors(&self, start: u32, end: u32) -> Result<Vec<Sector>, u32> {
        let span =
            |sector: &Sector| -> Range<u32> { sector.address..sector.address.saturating_add(sector.length) };
        let mut found = Vec::new();
        let mut at = start;
        while at < end {
            let sector = self.sectors.iter().find(|sector| span(sector).contains(&at) && sector.writable);
            let sector = sector.ok_or(at)?;
            found.push(*sector);
            at = span(sector).end;
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flash_of_the_chip_is_what_its_bootloader_says() {
        let layout = Layout::parse("@Internal Flash  /0x08000000/04*016Kg,01*064Kg,07*128Kg").unwrap();
        assert_eq!(layout.sectors.len(), 12);
        assert_eq!(layout.sectors.iter().map(|sector| sector.length).sum::<u32>(), 1 << 20);
        let sectors = layout.sectors(0x0800_0000, 0x0800_0000 + 70_000).unwrap();
        let lengths: Vec<_> = sectors.iter().map(|sector| sector.length >> 10).collect();
        assert_eq!(lengths, [16, 16, 16, 16, 64]);
        assert_eq!(layout.sectors(0x080F_FFFF, 0x0810_0001), Err(0x0810_0000));
        // Readable only.
        let fixed = Layout::parse("@OTP Memory   /0x1FFF7800/01*512 a,01*016 a").unwrap();
        assert_eq!(fixed.sectors(0x1FFF_7800, 0x1FFF_7801), Err(0x1FFF_7800));
    }

    #[test]
    fn any_text_is_taken_or_refused() {
        for text in [
            "",
            "@",
            "@x",
            "@x/0x0/",
            "@x/0x0/1*",
            "@x/0x0/1*0Kg",
            "@x/0xFFFFFFFF/2*1Mg",
            "@x/0x0/9*9Q",
            "@x/0x0/1*1K",
        ] {
            assert_eq!(Layout::parse(text), None, "{text}");
        }
    }
}
