//! Each board's firmware.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use cantap_wire::image;
use object::read::elf::{ElfFile32, FileHeader, ProgramHeader};
use object::{Endianness, elf};
use xshell::Shell;

use super::archive::{VERSION, archive, staging};
use super::notices;
use crate::board::Board;
use crate::firmware::build_all;
use crate::toolchain::{TARGET, Toolchain};

/// Packs an archive for each board.
pub fn pack(shell: &Shell, dist: &Path) -> Result<()> {
    build_all(shell, Toolchain::find(shell)?, &Board::ALL)?;
    for board in Board::ALL {
        let name = format!("cantap-firmware-{VERSION}-{}", board.name());
        let content = staging(shell, dist, &name)?;
        let elf = content.join(format!("{name}.elf"));
        shell.copy_file(board.elf(), &elf)?;
        let mut image = flash_image(&shell.read_binary_file(&elf)?)?;
        // What `cantap update` compares with the board, and with what is there of the file.
        image::finish(&mut image)?;
        let described = image::read(&image)?;
        ensure!(
            described.board == board.name(),
            "the image for {} says that it is for {}",
            board.name(),
            described.board
        );
        shell.write_file(content.join(format!("{name}.bin")), image)?;
        let selection = [
            "-p",
            "cantap-firmware",
            "--no-default-features",
            "--features",
            board.name(),
            "--target",
            TARGET,
        ];
        notices::write(shell, &content.join("THIRD-PARTY.txt"), &selection)?;
        archive(shell, dist, &name, &content)?;
    }
    Ok(())
}

/// The flash's contents from its start, in the form that `dfu-util` expects.
fn flash_image(bytes: &[u8]) -> Result<Vec<u8>> {
    const FLASH_START: usize = 0x0800_0000;
    /// The flash's size: nothing may lie beyond it.
    const FLASH_LEN: usize = 1 << 20;

    let file = ElfFile32::<Endianness>::parse(bytes)?;
    let endian = file.endian();
    let mut image = Vec::new();
    for segment in file.elf_header().program_headers(endian, bytes)? {
        let data = segment.data(endian, bytes).ok().context("a segment is outside the ELF")?;
        if segment.p_type(endian) != elf::PT_LOAD || data.is_empty() {
            continue;
        }
        let start = (segment.p_paddr(endian) as usize).wrapping_sub(FLASH_START);
        ensure!(start < FLASH_LEN, "a segment is outside the flash");
        // Erased flash reads as ones.
        image.resize(image.len().max(start + data.len()), 0xFF);
        image[start..start + data.len()].copy_from_slice(data);
    }
    Ok(image)
}
