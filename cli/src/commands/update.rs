//! `cantap update`: writes a firmware to the board, through the chip's own USB bootloader.

use std::io::{ErrorKind, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use anyhow::{Context, bail};
use cantap_address::Address;

use crate::completion;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "FILE is the .bin that `cargo xtask dist` or a release provides. The device leaves its \
                        firmware for the chip's own USB bootloader; `dfu-util` writes the file, if it is installed.\n\n\
                        The bootloader listens on CAN, too. Where it could drive channel 2's bus, unplug channel 2 first: the command \
                        says so, and asks if it is run from a terminal."
)]
pub struct Args {
    /// Where the device is: a serial port.
    #[arg(short, long, add = completion::devices())]
    device: Address,
    /// The firmware, as a raw image for address 0x08000000.
    file: PathBuf,
    /// Do not ask whether channel 2 is unplugged.
    #[arg(short, long)]
    yes: bool,
}

/// Where an STM32's flash begins.
const FLASH_START: u32 = 0x0800_0000;
/// The ROM bootloader's USB IDs.
const DFU_ID: &str = "0483:df11";
/// An image cannot be longer than the largest flash of the family, 1 MiB.
const MAX_IMAGE: u64 = 1 << 20;

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let file = args.file.display();
    let image = std::fs::read(&args.file).with_context(|| format!("cannot read '{file}'; check its name"))?;
    check_image(&image).with_context(|| format!("'{file}'"))?;
    let device = args.device.open()?;
    if drives_channel_2(&device.hello().board) && !args.yes && !is_unplugged()? {
        bail!("nothing was done; unplug channel 2 and run this again");
    }
    device.bootloader()?;
    let address = format!("0x{FLASH_START:08X}:leave");
    let arguments = ["-d", DFU_ID, "-a", "0", "-s", &address, "-w", "-D"];
    let line = || format!("dfu-util {} {}", arguments.join(" "), quoted(&args.file));
    match Command::new("dfu-util").args(arguments).arg(&args.file).status() {
        Ok(status) if status.success() => Ok(ExitCode::SUCCESS),
        Ok(status) => bail!(
            "dfu-util failed ({status}); the device stays in its bootloader, so run this again:\n  {}",
            line()
        ),
        Err(error) => {
            let reason = match error.kind() {
                ErrorKind::NotFound => "Install dfu-util".to_owned(),
                _ => format!("dfu-util cannot be started ({error}). Mend that"),
            };
            writeln!(
                std::io::stdout(),
                "the device is in its USB bootloader. {reason}, then run:\n  {}",
                line()
            )?;
            Ok(ExitCode::SUCCESS)
        }
    }
}

/// Whether the ROM bootloader's CAN pins (PB5 and PB13, AN2606) are channel 2's, as on every board that does not separate them
/// (`docs/wiring.md`).
fn drives_channel_2(board: &str) -> bool {
    !matches!(board, "olimex-p405" | "virtual" | "virtual-car")
}

/// Says that channel 2 must be unplugged, and, if somebody can answer, asks whether it is.
fn is_unplugged() -> anyhow::Result<bool> {
    let mut err = std::io::stderr();
    writeln!(
        err,
        "Unplug channel 2 from its bus: on this board the chip's bootloader may drive it, and takes it for the way to be programmed."
    )?;
    if !std::io::stdin().is_terminal() {
        return Ok(true);
    }
    write!(err, "Is it unplugged? [y/N] ")?;
    err.flush()?;
    let mut answer = String::new();
    std::io::stdin().read_line(&mut answer)?;
    Ok(matches!(answer.trim(), "y" | "Y" | "yes"))
}

/// Quotes a file name for a shell.
fn quoted(path: &Path) -> String {
    format!("'{}'", path.display().to_string().replace('\'', r"'\''"))
}

/// Refuses a file that is not an image for this chip, before the device leaves its firmware: an image begins with
/// the end of the stack, in RAM, and the reset vector, an odd address in flash.
fn check_image(image: &[u8]) -> anyhow::Result<()> {
    let word =
        |at: usize| image.get(at..at + 4).and_then(|bytes| bytes.try_into().ok()).map(u32::from_le_bytes);
    if image.starts_with(b"\x7FELF") {
        bail!("it is an ELF file; give the .bin beside it (`cargo xtask dist` makes both)");
    }
    let (Some(stack), Some(reset)) = (word(0), word(4)) else { bail!("it is too short for a firmware") };
    let in_ram = matches!(stack >> 24, 0x10 | 0x20);
    let in_flash = reset & 1 == 1 && (FLASH_START..FLASH_START + MAX_IMAGE as u32).contains(&reset);
    if !in_ram || !in_flash || image.len() as u64 > MAX_IMAGE {
        bail!("it is not a firmware image for this chip; give the .bin that `cargo xtask dist` makes");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_name_with_a_quote_can_be_pasted_into_a_shell() {
        assert_eq!(quoted(Path::new("it's.bin")), r"'it'\''s.bin'");
    }

    #[test]
    fn channel_2_is_asked_for_where_the_bootloader_may_drive_it() {
        for (board, asked) in
            [("olimex-p405", false), ("virtual", false), ("feather-f405", true), ("stm32f4-discovery", true)]
        {
            assert_eq!(drives_channel_2(board), asked, "{board}");
        }
    }

    #[test]
    fn only_images_for_the_chip_are_taken() {
        let image = |stack: u32, reset: u32| [stack.to_le_bytes(), reset.to_le_bytes()].concat();
        assert!(check_image(&image(0x2002_0000, 0x0800_0195)).is_ok());
        assert!(check_image(&image(0x1001_0000, 0x0800_0195)).is_ok());
        for bad in [
            image(0, 0),
            image(0x2002_0000, 0x0800_0194),
            image(0x2002_0000, 0x2000_0195),
            b"\x7FELF....".to_vec(),
            vec![],
        ] {
            assert!(check_image(&bad).is_err(), "{bad:x?}");
        }
    }
}
