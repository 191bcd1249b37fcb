//! `cargo xtask dist`: release archives, named by what they hold and its version.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use flate2::Compression;
use flate2::write::GzEncoder;
use object::read::elf::{ElfFile32, FileHeader, ProgramHeader};
use object::{Endianness, elf};
use xshell::{Shell, cmd};

use crate::board::Board;
use crate::firmware;
use crate::toolchain::Toolchain;
use crate::workspace;

const VERSION: &str = env!("CARGO_PKG_VERSION");
/// What goes into every archive.
const PAPERS: [&str; 4] = ["README.md", "CHANGELOG.md", "LICENSE-MIT", "LICENSE-APACHE"];

/// Builds and packs everything into `target/dist`.
pub fn run() -> Result<()> {
    let shell = workspace::shell()?;
    let toolchain = Toolchain::find(&shell)?;
    let dist = workspace::target().join("dist");
    shell.create_dir(&dist)?;
    cmd!(shell, "cargo build --locked --release -p cantap-cli").run()?;
    let host = host_triple(&shell)?;
    let command = workspace::target().join("release").join(format!("cantap{}", std::env::consts::EXE_SUFFIX));
    pack(&shell, &dist, &format!("cantap-{VERSION}-{host}"), &[command])?;

    firmware::build_all(&shell, toolchain, &Board::ALL)?;
    for board in Board::ALL {
        let name = format!("cantap-firmware-{VERSION}-{}", board.name());
        let (elf, bin) = (dist.join(format!("{name}.elf")), dist.join(format!("{name}.bin")));
        shell.copy_file(board.elf(), &elf)?;
        shell.write_file(&bin, flash_image(&shell.read_binary_file(&elf)?)?)?;
        pack(&shell, &dist, &name, &[elf.clone(), bin.clone()])?;
        shell.remove_path(elf)?;
        shell.remove_path(bin)?;
    }
    Ok(())
}

/// The bytes that go to the start of the flash, as `dfu-util` wants them.
fn flash_image(bytes: &[u8]) -> Result<Vec<u8>> {
    const FLASH_START: usize = 0x0800_0000;
    /// The flash's size: nothing may lie behind it.
    const FLASH_LEN: usize = 1 << 20;

    let file = ElfFile32::<Endianness>::parse(bytes)?;
    let endian = file.endian();
    let mut image = Vec::new();
    for segment in file.elf_header().program_headers(endian, bytes)? {
        let data = segment.data(endian, bytes).ok().context("a segment lies outside the ELF")?;
        if segment.p_type(endian) != elf::PT_LOAD || data.is_empty() {
            continue;
        }
        let start = (segment.p_paddr(endian) as usize).wrapping_sub(FLASH_START);
        ensure!(start < FLASH_LEN, "a segment lies outside the flash");
        // Erased flash reads as ones.
        image.resize(image.len().max(start + data.len()), 0xFF);
        image[start..start + data.len()].copy_from_slice(data);
    }
    Ok(image)
}

/// Packs files, and the papers, into `DIST/NAME.tar.gz`, under a directory `NAME`.
fn pack(shell: &Shell, dist: &Path, name: &str, files: &[PathBuf]) -> Result<()> {
    let archive = dist.join(format!("{name}.tar.gz"));
    let mut tar = tar::Builder::new(GzEncoder::new(std::fs::File::create(&archive)?, Compression::best()));
    tar.mode(tar::HeaderMode::Deterministic);
    let papers = PAPERS.iter().map(|paper| shell.current_dir().join(paper));
    for file in files.iter().cloned().chain(papers) {
        let inside = Path::new(name).join(file.file_name().unwrap_or_default());
        tar.append_path_with_name(&file, inside).with_context(|| file.display().to_string())?;
    }
    tar.into_inner()?.finish()?;
    println!("{}", archive.display());
    Ok(())
}

fn host_triple(shell: &Shell) -> Result<String> {
    Ok(cmd!(shell, "rustc --print host-tuple").quiet().read()?)
}
