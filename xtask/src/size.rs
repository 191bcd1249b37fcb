//! `cargo xtask size`: how much memory the firmware takes on each board, against a budget.

use std::path::Path;

use anyhow::{Context, Result, bail};
use object::read::elf::{ElfFile32, FileHeader, SectionHeader};
use object::{Endianness, elf};
use serde::Deserialize;

use crate::board::Board;
use crate::workspace;

/// Bytes per kind of memory, either used or allowed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    /// Code, constants and the initial values of static data.
    pub flash: u64,
    /// Static data in SRAM.
    pub sram: u64,
    /// Static data in core-coupled memory.
    pub ccm: u64,
}

/// Address ranges of the STM32F405/407 (RM0090, "Memory map").
const FLASH: std::ops::Range<u64> = 0x0800_0000..0x0810_0000;
const SRAM: std::ops::Range<u64> = 0x2000_0000..0x2002_0000;
const CCM: std::ops::Range<u64> = 0x1000_0000..0x1001_0000;

/// Prints the sizes of these boards' firmware and compares them with the budget.
pub fn run(boards: &[Board]) -> Result<()> {
    let shell = workspace::shell()?;
    let budget: Sizes = toml::from_str(&shell.read_file("size-budget.toml")?).context("size-budget.toml")?;
    println!("{:<18} {:>9} {:>9} {:>9}", "bytes", "flash", "sram", "ccm");
    println!("{:<18} {:>9} {:>9} {:>9}", "budget", budget.flash, budget.sram, budget.ccm);
    let mut over = Vec::new();
    for board in boards {
        let sizes = measure(&board.elf())?;
        println!("{:<18} {:>9} {:>9} {:>9}", board.name(), sizes.flash, sizes.sram, sizes.ccm);
        let pairs = [
            (sizes.flash, budget.flash, "flash"),
            (sizes.sram, budget.sram, "sram"),
            (sizes.ccm, budget.ccm, "ccm"),
        ];
        for (size, most, what) in pairs {
            if size > most {
                over.push(format!("{}: {what} is {} bytes over", board.name(), size - most));
            }
        }
    }
    if !over.is_empty() {
        bail!("past the budget in size-budget.toml: {}", over.join("; "));
    }
    Ok(())
}

/// Adds up what an ELF places in each memory.
fn measure(path: &Path) -> Result<Sizes> {
    let bytes = std::fs::read(path)
        .with_context(|| format!("{}; run `cargo xtask firmware --all`", path.display()))?;
    let file = ElfFile32::<Endianness>::parse(&*bytes).with_context(|| path.display().to_string())?;
    let endian = file.endian();
    let sections = file.elf_header().sections(endian, &*bytes)?;
    let mut sizes = Sizes::default();
    for section in sections.iter() {
        if !section.sh_flags(endian).contains(elf::SHF_ALLOC) {
            continue;
        }
        let address = u64::from(section.sh_addr(endian));
        let size = u64::from(section.sh_size(endian));
        // Initial values of data in RAM are in flash, too.
        let stored = section.sh_type(endian) != elf::SHT_NOBITS;
        if FLASH.contains(&address) || stored {
            sizes.flash += size;
        }
        if SRAM.contains(&address) {
            sizes.sram += size;
        } else if CCM.contains(&address) {
            sizes.ccm += size;
        }
    }
    Ok(sizes)
}
