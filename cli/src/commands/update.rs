//! `cantap update`: writes a firmware to the board, through the chip's own USB bootloader.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::time::Duration;

use anyhow::{Context, bail};
use cantap::wire::PROTOCOL_VERSION;
use cantap::wire::image::{self, Image};
use cantap::wire::message::{Hello, capability};
use cantap_address::Address;
use cantap_work::dfu::usb::{Bootloaders, UsbPort};
use cantap_work::dfu::{self, Step};

use crate::completion;
use crate::progress::Progress;
use crate::usage_error::usage;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "FILE is the .bin that `cargo xtask dist` or a release provides. It says for which board it is, and how long: one for another board, \
                        half a one, a damaged one and what is no firmware of cantap are refused before anything restarts.\n\n\
                        The device leaves its firmware for the chip's own USB bootloader, which this command then erases, writes, reads back, and \
                        leaves. With --dfu-util, dfu-util does it. On Windows, the bootloader needs the driver WinUSB (Zadig installs it).\n\n\
                        The bootloader listens on CAN, too. Where it could drive channel 2's bus, unplug channel 2 first: the command \
                        says so, and asks if it is run from a terminal."
)]
pub struct Args {
    /// Where the device is: a serial port.
    #[arg(short, long, required_unless_present = "in_bootloader", add = completion::devices())]
    device: Option<Address>,
    /// The board already is in its bootloader, for example because an update failed: write what is for this board.
    #[arg(long, value_name = "BOARD", conflicts_with = "device")]
    in_bootloader: Option<String>,
    /// The firmware, as a raw image for address 0x08000000.
    file: PathBuf,
    /// Let dfu-util write it.
    #[arg(long)]
    dfu_util: bool,
    /// Also write a firmware that speaks another version of the protocol, with which only another version of this command works.
    #[arg(long)]
    other_protocol: bool,
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
/// How long the bootloader takes to appear, at most.
const BOOTLOADER_WITHIN: Duration = Duration::from_secs(15);

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let file = args.file.display();
    let image = std::fs::read(&args.file).with_context(|| format!("cannot read '{file}'; check its name"))?;
    let described = check_image(&image).with_context(|| format!("'{file}'"))?;
    check_protocol(&described, args.other_protocol)?;
    let writer = Writer::ready(args)?;
    let port = if let Some(board) = &args.in_bootloader {
        check_board(&described, board)?;
        if drives_channel_2(board) && !args.yes && !is_unplugged()? {
            bail!("nothing was done; unplug channel 2 and run this again");
        }
        writer.bootloader_there()?
    } else {
        let Some(address) = &args.device else {
            return Err(usage("give the device with -d, or --in-bootloader BOARD"));
        };
        let device = address.open()?;
        let hello = device.hello();
        check_board(&described, &hello.board)?;
        check_bootloader(hello)?;
        if drives_channel_2(&hello.board) && !args.yes && !is_unplugged()? {
            bail!("nothing was done; unplug channel 2 and run this again");
        }
        device.bootloader()?;
        drop(device);
        writer.bootloader_to_come().with_context(|| left_in_bootloader(args, described.board))?
    };
    write(port, &image, args).with_context(|| left_in_bootloader(args, described.board))?;
    let [major, minor, patch] = described.version;
    writeln!(std::io::stdout(), "{} now runs firmware {major}.{minor}.{patch}", described.board)?;
    Ok(ExitCode::SUCCESS)
}

/// What to do when the device has left its firmware, but has no new one.
fn left_in_bootloader(args: &Args, board: &str) -> String {
    let option = if args.dfu_util { " --dfu-util" } else { "" };
    format!(
        "the device stays in its bootloader, so run `cantap update --in-bootloader {board}{option} {}` once this is mended",
        quoted(&args.file)
    )
}

/// Who writes; ready before the device leaves its firmware.
enum Writer {
    /// This program, to one that is not among these.
    Own(Bootloaders),
    DfuUtil,
}

/// Where to write.
enum Target {
    Own(Box<UsbPort>),
    DfuUtil,
}

impl Writer {
    fn ready(args: &Args) -> anyhow::Result<Self> {
        if args.dfu_util {
            let found = Command::new("dfu-util")
                .arg("--version")
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .status();
            found.context(
                "dfu-util cannot be started; install it, or leave --dfu-util out. Nothing was done",
            )?;
            return Ok(Self::DfuUtil);
        }
        let there = Bootloaders::list().context("nothing was done; perhaps dfu-util can, with --dfu-util")?;
        Ok(Self::Own(there))
    }

    fn bootloader_there(self) -> anyhow::Result<Target> {
        Ok(match self {
            Self::Own(there) => Target::Own(there.only()?.into()),
            Self::DfuUtil => Target::DfuUtil,
        })
    }

    fn bootloader_to_come(self) -> anyhow::Result<Target> {
        Ok(match self {
            Self::Own(before) => Target::Own(before.wait_for_another(BOOTLOADER_WITHIN)?.into()),
            Self::DfuUtil => Target::DfuUtil,
        })
    }
}

fn write(target: Target, image: &[u8], args: &Args) -> anyhow::Result<()> {
    match target {
        Target::Own(mut port) => {
            let mut progress = Progress::start();
            dfu::write(&mut *port, FLASH_START, image, |step, done, all| {
                if let Some(progress) = &mut progress {
                    progress.tell(|| {
                        let what = match step {
                            Step::Erase => "erasing",
                            Step::Write => "writing",
                            Step::Verify => "reading back",
                        };
                        format!("{what} {} of {} kB", done / 1000, all / 1000)
                    });
                }
            })?;
            Ok(())
        }
        Target::DfuUtil => {
            let address = format!("0x{FLASH_START:08X}:leave");
            let arguments = ["-d", DFU_ID, "-a", "0", "-s", &address, "-w", "-D"];
            let status = Command::new("dfu-util").args(arguments).arg(&args.file).status();
            let status = status.context("dfu-util cannot be started")?;
            if status.success() { Ok(()) } else { bail!("dfu-util failed ({status})") }
        }
    }
}

/// Refuses an image for another board.
fn check_board(image: &Image<'_>, board: &str) -> anyhow::Result<()> {
    if image.board == board {
        return Ok(());
    }
    bail!("this firmware is for '{}', and the device is '{board}'; give the one for '{board}'", image.board)
}

/// Refuses an image that this command could not talk to.
fn check_protocol(image: &Image<'_>, allowed: bool) -> anyhow::Result<()> {
    if allowed || image.protocol == PROTOCOL_VERSION {
        return Ok(());
    }
    bail!(
        "this firmware speaks protocol {}, and this command {PROTOCOL_VERSION}: afterwards only a cantap command with protocol {} works with the \
         board. Take the firmware of this command's version, or add --other-protocol",
        image.protocol,
        image.protocol
    )
}

/// Refuses a device that cannot enter a bootloader.
fn check_bootloader(hello: &Hello) -> anyhow::Result<()> {
    if hello.capabilities & capability::BOOTLOADER == 0 {
        bail!(
            "'{}' has no bootloader that it could enter by itself; write the firmware with a probe",
            hello.board
        );
    }
    Ok(())
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

/// Refuses a file that is not a whole image for this chip, before the device leaves its firmware: an image begins with
/// the end of the stack, in RAM, and the reset vector, an odd address in flash; and it says what it is.
fn check_image(image: &[u8]) -> anyhow::Result<Image<'_>> {
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
    Ok(image::read(image)?)
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
        let start = |stack: u32, reset: u32| [stack.to_le_bytes(), reset.to_le_bytes()].concat();
        for bad in [
            start(0, 0),
            start(0x2002_0000, 0x0800_0194),
            start(0x2002_0000, 0x2000_0195),
            // The chip's, but not ours.
            start(0x2002_0000, 0x0800_0195),
            b"\x7FELF....".to_vec(),
            vec![],
        ] {
            assert!(check_image(&bad).is_err(), "{bad:x?}");
        }
    }

    #[test]
    fn another_board_s_image_and_another_protocol_s_are_refused() {
        let image = Image { board: "olimex-p405", version: [1, 0, 0], protocol: PROTOCOL_VERSION };
        assert!(check_board(&image, "olimex-p405").is_ok() && check_protocol(&image, false).is_ok());
        let error = check_board(&image, "feather-f405").unwrap_err().to_string();
        assert!(error.contains("is for 'olimex-p405', and the device is 'feather-f405'"), "{error}");
        let newer = Image { protocol: PROTOCOL_VERSION + 1, ..image };
        assert!(check_protocol(&newer, false).is_err() && check_protocol(&newer, true).is_ok());
    }
}
