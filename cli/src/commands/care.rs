//! What is done to the device itself: `cantap identify`, `reset`, `update`, `defaults`.

use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, ExitCode};

use anyhow::{Context, bail};
use cantap::filter::Filter;
use cantap::wire::message::Mode;
use cantap::{Address, Device};

use crate::args;
use crate::channel_args::ChannelArgs;

/// The command line of `cantap identify`.
#[derive(clap::Args)]
pub struct Identify {
    /// Where the device is: a serial port, or virtual.
    #[arg(short, long)]
    device: Address,
    /// How long to show the pattern, in seconds.
    #[arg(short, long, default_value_t = 5, value_parser = clap::value_parser!(u8).range(1..))]
    seconds: u8,
}

/// The command line of `cantap reset`.
#[derive(clap::Args)]
pub struct Reset {
    /// Where the device is: a serial port, or virtual.
    #[arg(short, long)]
    device: Address,
}

/// The command line of `cantap update`.
#[derive(clap::Args)]
#[command(
    after_help = "FILE is the .bin that `cargo xtask dist` or a release provides. The device leaves its \
                        firmware for the chip's own USB bootloader; `dfu-util` writes the file, if it is installed."
)]
pub struct Update {
    /// Where the device is: a serial port.
    #[arg(short, long)]
    device: Address,
    /// The firmware, as a raw image for address 0x08000000.
    file: PathBuf,
}

/// The command line of `cantap defaults`.
#[derive(clap::Args)]
pub struct Defaults {
    #[command(subcommand)]
    action: DefaultsAction,
}

#[derive(clap::Subcommand)]
enum DefaultsAction {
    /// Store how channels are opened, so that it survives a power cycle; commands without -b use it.
    Save(Save),
    /// Erase what is stored.
    Clear(Clear),
}

#[derive(clap::Args)]
struct Save {
    /// Where the device is: a serial port, or virtual.
    #[arg(short, long)]
    device: Address,
    /// Which channels: 1, 2 or both.
    #[arg(short, long, default_value = "both", value_parser = args::channels)]
    channel: args::Channels,
    #[command(flatten)]
    open: ChannelArgs,
    /// Hardware filters, in candump's syntax.
    #[arg(short, long, value_name = "FILTER")]
    filter: Vec<Filter>,
}

#[derive(clap::Args)]
struct Clear {
    /// Where the device is: a serial port, or virtual.
    #[arg(short, long)]
    device: Address,
}

/// Where an STM32's flash begins.
const FLASH_START: u32 = 0x0800_0000;
/// The ROM bootloader's USB IDs.
const DFU_ID: &str = "0483:df11";
/// An image cannot be longer than the largest flash of the family, 1 MiB.
const MAX_IMAGE: u64 = 1 << 20;

/// Runs `cantap identify`.
pub fn identify(args: &Identify) -> anyhow::Result<ExitCode> {
    Device::open(&args.device)?.identify(args.seconds)?;
    writeln!(std::io::stdout(), "its LEDs blink for {} s", args.seconds)?;
    Ok(ExitCode::SUCCESS)
}

/// Runs `cantap reset`.
pub fn reset(args: &Reset) -> anyhow::Result<ExitCode> {
    Device::open(&args.device)?.reset()?;
    writeln!(std::io::stdout(), "restarting")?;
    Ok(ExitCode::SUCCESS)
}

/// Runs `cantap update`.
pub fn update(args: &Update) -> anyhow::Result<ExitCode> {
    let file = args.file.display();
    let image = std::fs::read(&args.file).with_context(|| format!("cannot read '{file}'; check its name"))?;
    check_image(&image).with_context(|| format!("'{file}'"))?;
    Device::open(&args.device)?.bootloader()?;
    let arguments = ["-d", DFU_ID, "-a", "0", "-s", &format!("0x{FLASH_START:08X}:leave"), "-w", "-D"];
    match Command::new("dfu-util").args(arguments).arg(&args.file).status() {
        Ok(status) if status.success() => Ok(ExitCode::SUCCESS),
        Ok(status) => bail!("dfu-util failed ({status}); the device stays in its bootloader: try again"),
        Err(_) => {
            let line = arguments.join(" ");
            writeln!(
                std::io::stdout(),
                "the device is in its USB bootloader. Install dfu-util, then run:\n  dfu-util {line} '{file}'"
            )?;
            Ok(ExitCode::SUCCESS)
        }
    }
}

/// Refuses what is no image for this chip, before the device leaves its firmware: an image begins with the stack's
/// end, in RAM, and the reset vector, an odd address in flash.
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
        bail!("it is no firmware image for this chip; give the .bin that `cargo xtask dist` makes");
    }
    Ok(())
}

/// Runs `cantap defaults`.
pub fn defaults(args: &Defaults) -> anyhow::Result<ExitCode> {
    let done = match &args.action {
        DefaultsAction::Save(save) => {
            let device = Device::open(&save.device)?;
            let channels = save.open.open(&device, save.channel.iter(), Mode::ListenOnly, &save.filter)?;
            for (channel, _) in channels {
                device.close_channel(channel)?;
            }
            device.save_defaults()?;
            "saved on the device"
        }
        DefaultsAction::Clear(clear) => {
            Device::open(&clear.device)?.clear_defaults()?;
            "erased from the device"
        }
    };
    writeln!(std::io::stdout(), "{done}")?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;

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
