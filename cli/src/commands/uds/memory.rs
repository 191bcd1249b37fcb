//! `cantap uds download` and `upload`: memory to and from files.

use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context;
use cantap_work::memory_image::MemoryImage;
use cantap_work::uds::Client;
use cantap_work::uds_memory::{self, MemoryFormat};

use super::hex::{byte, number};
use crate::usage_error::usage;

/// How addresses and sizes are written.
#[derive(clap::Args, Clone)]
pub struct FormatArgs {
    /// How many bytes sizes (first digit) and addresses (second digit) have in the request.
    #[arg(long, value_name = "HEX", default_value = "44", value_parser = byte)]
    lengths: u8,
    /// How the data are compressed (first digit) and encrypted (second digit), as the ECU's maker has it.
    #[arg(long, value_name = "HEX", default_value = "00", value_parser = byte)]
    encoding: u8,
}

/// What to write.
#[derive(clap::Args, Clone)]
pub struct DownloadArgs {
    /// Intel HEX, S-records, or plain bytes with --memory-address.
    #[arg(value_name = "FILE", value_hint = clap::ValueHint::FilePath)]
    file: PathBuf,
    /// Where plain bytes belong, in hexadecimal.
    #[arg(long = "memory-address", value_name = "HEX", value_parser = address)]
    address: Option<u32>,
    #[command(flatten)]
    format: FormatArgs,
    /// Confirm that the ECU's memory is to be overwritten.
    #[arg(short, long)]
    yes: bool,
}

/// What to read.
#[derive(clap::Args, Clone)]
pub struct UploadArgs {
    /// The first address, in hexadecimal.
    #[arg(value_name = "ADDRESS", value_parser = address)]
    address: u32,
    /// How many bytes, in hexadecimal.
    #[arg(value_name = "SIZE", value_parser = address)]
    size: u32,
    /// The file for the bytes, which must not exist yet.
    #[arg(short, long, value_name = "FILE", value_hint = clap::ValueHint::FilePath)]
    output: PathBuf,
    #[command(flatten)]
    format: FormatArgs,
}

fn address(text: &str) -> Result<u32, String> {
    number(text, u32::MAX).ok_or_else(|| "write up to eight hexadecimal digits, as 08004000".to_owned())
}

impl FormatArgs {
    const fn format(&self) -> MemoryFormat {
        MemoryFormat { lengths: self.lengths, encoding: self.encoding }
    }
}

impl DownloadArgs {
    /// The file's bytes.
    ///
    /// # Errors
    ///
    /// Anything that would end the transfer before it begins: no --yes, a file that is no image, numbers that do not fit.
    pub fn image(&self) -> anyhow::Result<MemoryImage> {
        if !self.yes {
            return Err(usage(
                "this overwrites the ECU's memory, and one that is interrupted or is not meant for this ECU may leave it without \
                 a program; if that is meant, add --yes",
            ));
        }
        let file =
            std::fs::read(&self.file).with_context(|| format!("cannot read {}", self.file.display()))?;
        let image = MemoryImage::read(&file, self.address)
            .with_context(|| format!("{} cannot be written to an ECU", self.file.display()))?;
        for segment in &image.segments {
            self.format.format().request(0x34, segment.address, segment.data.len())?;
        }
        Ok(image)
    }

    /// Writes it.
    pub fn run(&self, client: &mut Client<'_>) -> anyhow::Result<()> {
        for segment in &self.image()?.segments {
            uds_memory::download(client, segment, self.format.format())
                .with_context(|| format!("the memory at {:08X} is not as in the file", segment.address))?;
        }
        Ok(())
    }
}

impl UploadArgs {
    /// Checks what can be checked before anything is sent.
    ///
    /// # Errors
    ///
    /// Numbers that do not fit; a file that is there already.
    pub fn check(&self) -> anyhow::Result<()> {
        self.format.format().request(0x35, self.address, self.size as usize)?;
        if self.size == 0 {
            return Err(usage("there are no bytes to read; give a size in hexadecimal, as 100"));
        }
        if self.output.exists() {
            return Err(usage(format!("{} already exists; choose another name", self.output.display())));
        }
        Ok(())
    }

    /// Reads it.
    pub fn run(&self, client: &mut Client<'_>) -> anyhow::Result<()> {
        // Created first: if the bytes cannot be stored, they need not be read.
        let mut file = File::create_new(&self.output).with_context(|| {
            format!("cannot write {}; nothing there is overwritten", self.output.display())
        })?;
        let read = uds_memory::upload(client, self.address, self.size as usize, self.format.format());
        let written = read.and_then(|data| file.write_all(&data).context("cannot write the bytes"));
        if written.is_err() {
            discard(&self.output);
        }
        written
    }
}

/// It is incomplete, and did not exist before.
fn discard(path: &Path) {
    let _ = std::fs::remove_file(path);
}
