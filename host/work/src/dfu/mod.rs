//! Writes a firmware through an STM32's ROM bootloader: ST's DFU with extensions, "DfuSe" (AN3156 revision 16; USB DFU 1.1a).
//!
//! The protocol is here, over a [`Port`]; [`usb`] is the one that programs use. Sectors are erased, the image is written and read back, and only
//! when it is there, whole, the bootloader is left.

mod layout;
pub mod usb;

use std::time::Duration;

use cantap_trace::counted;

pub use layout::{Layout, Sector};

/// What a [`Port`] reports.
pub type PortError = Box<dyn std::error::Error + Send + Sync>;

/// The way to a bootloader: requests of its DFU interface.
pub trait Port {
    /// A request with data to the device.
    fn send(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), PortError>;
    /// A request for at most this many bytes.
    fn receive(&mut self, request: u8, value: u16, length: usize) -> Result<Vec<u8>, PortError>;
    /// Lets time pass.
    fn pause(&mut self, time: Duration);
    /// The most bytes in one transfer.
    fn transfer_bytes(&self) -> usize;
    /// The memory that it describes.
    fn layout(&self) -> &Layout;
}

/// What is being done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Sectors are erased.
    Erase,
    /// The image is written.
    Write,
    /// It is read back and compared.
    Verify,
}

/// Why an image was not written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DfuError {
    /// The transfers themselves.
    #[error("the bootloader does not answer: {0}")]
    Port(#[source] PortError),
    /// The bootloader refused.
    #[error("the bootloader refused to {what}: {reason}")]
    Refused {
        /// What was asked for.
        what: &'static str,
        /// Its status in words.
        reason: &'static str,
    },
    /// It did something else than it should.
    #[error(
        "the bootloader is in state {state} instead of {expected}; unplug the board, start its bootloader and try again"
    )]
    State {
        /// Its state (USB DFU 1.1, A.2).
        state: u8,
        /// The one that should follow.
        expected: u8,
    },
    /// It needs longer than anything takes.
    #[error("the bootloader needs too long to {0}; unplug the board, start its bootloader and try again")]
    TooSlow(&'static str),
    /// The image does not fit into what can be written.
    #[error("the image does not fit into the bootloader's memory: 0x{0:08X} cannot be written")]
    NoRoom(u32),
    /// It is not there as it was written.
    #[error(
        "what was read back differs from the image at 0x{0:08X}; try again, and if it stays so, the flash is worn out or protected"
    )]
    Differs(u32),
}

/// Requests (USB DFU 1.1, 3).
const DNLOAD: u8 = 1;
const UPLOAD: u8 = 2;
const GETSTATUS: u8 = 3;
const CLRSTATUS: u8 = 4;
const ABORT: u8 = 6;
/// States (USB DFU 1.1, A.2).
const IDLE: u8 = 2;
const DOWNLOAD_BUSY: u8 = 4;
const DOWNLOAD_IDLE: u8 = 5;
const MANIFEST: u8 = 7;
const ERROR: u8 = 10;
/// Commands of ST's extension, in block 0 (AN3156).
const SET_ADDRESS: u8 = 0x21;
const ERASE: u8 = 0x41;
/// Data begin with this block.
const FIRST_BLOCK: u16 = 2;
/// A sector of 128 KiB takes up to 4 s to erase (STM32F405 data sheet, table 42, at 8-bit parallelism).
const MOST_BUSY: Duration = Duration::from_secs(20);

/// What `GETSTATUS` answers.
struct Status {
    code: u8,
    poll: Duration,
    state: u8,
}

struct Dfu<'p, P> {
    port: &'p mut P,
}

/// Writes an image to flash from `start` on, verifies it, and starts it. `progress` is told of each step how many of how many bytes are
/// done.
pub fn write(
    port: &mut impl Port,
    start: u32,
    image: &[u8],
    mut progress: impl FnMut(Step, usize, usize),
) -> Result<(), DfuError> {
    let end = u32::try_from(image.len()).ok().and_then(|length| start.checked_add(length));
    let end = end.ok_or(DfuError::NoRoom(u32::MAX))?;
    let sectors = port.layout().sectors(start, end).map_err(DfuError::NoRoom)?;
    let transfer = port.transfer_bytes().max(1);
    let mut dfu = Dfu { port };
    dfu.make_idle()?;
    let to_erase: usize = sectors.iter().map(|sector| sector.length as usize).sum();
    let mut erased = 0;
    for sector in &sectors {
        progress(Step::Erase, erased, to_erase);
        dfu.command("erase a sector", ERASE, sector.address)?;
        erased += sector.length as usize;
    }
    progress(Step::Erase, to_erase, to_erase);
    dfu.command("take an address", SET_ADDRESS, start)?;
    let blocks = || (FIRST_BLOCK..).zip(image.chunks(transfer));
    let mut done = 0;
    for (number, chunk) in blocks() {
        progress(Step::Write, done, image.len());
        dfu.download("write", number, chunk)?;
        done += chunk.len();
    }
    progress(Step::Write, done, image.len());
    dfu.make_idle()?;
    dfu.command("take an address", SET_ADDRESS, start)?;
    dfu.make_idle()?;
    done = 0;
    for (number, chunk) in blocks() {
        progress(Step::Verify, done, image.len());
        let read = dfu.port.receive(UPLOAD, number, chunk.len()).map_err(DfuError::Port)?;
        let differs = (0..chunk.len()).find(|at| read.get(*at) != Some(&chunk[*at]));
        if let Some(at) = differs {
            return Err(DfuError::Differs(start + (done + at) as u32));
        }
        done += chunk.len();
    }
    progress(Step::Verify, done, image.len());
    dfu.leave(start)
}

impl<P: Port> Dfu<'_, P> {
    fn status(&mut self) -> Result<Status, DfuError> {
        let answer = self.port.receive(GETSTATUS, 0, 6).map_err(DfuError::Port)?;
        let [status, low, middle, high, state, ..] = answer[..] else {
            return Err(DfuError::Port(
                format!("{} of status instead of 6", counted(answer.len(), "byte")).into(),
            ));
        };
        let poll = Duration::from_millis(u32::from_le_bytes([low, middle, high, 0]).into());
        Ok(Status { code: status, poll, state })
    }

    /// Whatever was before: ready for a command.
    fn make_idle(&mut self) -> Result<(), DfuError> {
        // An error is cleared first, then a transfer in progress is given up.
        for _ in 0..3 {
            let state = self.status()?.state;
            match state {
                IDLE => return Ok(()),
                ERROR => self.port.send(CLRSTATUS, 0, &[]),
                _ => self.port.send(ABORT, 0, &[]),
            }
            .map_err(DfuError::Port)?;
        }
        let state = self.status()?.state;
        if state == IDLE { Ok(()) } else { Err(DfuError::State { state, expected: IDLE }) }
    }

    fn command(&mut self, what: &'static str, command: u8, address: u32) -> Result<(), DfuError> {
        let [a, b, c, d] = address.to_le_bytes();
        self.download(what, 0, &[command, a, b, c, d])
    }

    /// A block, and the wait until it is done.
    fn download(&mut self, what: &'static str, number: u16, data: &[u8]) -> Result<(), DfuError> {
        self.port.send(DNLOAD, number, data).map_err(DfuError::Port)?;
        let mut waited = Duration::ZERO;
        loop {
            let Status { code: status, poll, state } = self.status()?;
            if status != 0 || state == ERROR {
                // So that the next attempt finds it ready; this one has failed anyway.
                let _ = self.port.send(CLRSTATUS, 0, &[]);
                return Err(DfuError::Refused { what, reason: reason(status) });
            }
            match state {
                DOWNLOAD_IDLE => return Ok(()),
                DOWNLOAD_BUSY if waited < MOST_BUSY => {
                    // Some revisions say 0 and mean a while.
                    let pause = poll.max(Duration::from_millis(1));
                    waited += pause;
                    self.port.pause(pause);
                }
                DOWNLOAD_BUSY => return Err(DfuError::TooSlow(what)),
                state => return Err(DfuError::State { state, expected: DOWNLOAD_IDLE }),
            }
        }
    }

    /// Starts what was written: an empty block, and the request for the status after which it goes.
    fn leave(&mut self, start: u32) -> Result<(), DfuError> {
        self.make_idle()?;
        self.command("take an address", SET_ADDRESS, start)?;
        self.port.send(DNLOAD, FIRST_BLOCK, &[]).map_err(DfuError::Port)?;
        match self.status() {
            // An error: it has gone already.
            Ok(Status { state: MANIFEST | 6 | 8, code: 0, .. }) | Err(_) => Ok(()),
            Ok(Status { code: 0, state, .. }) => Err(DfuError::State { state, expected: MANIFEST }),
            Ok(Status { code, .. }) => {
                Err(DfuError::Refused { what: "start the firmware", reason: reason(code) })
            }
        }
    }
}

/// A status in words (USB DFU 1.1, A.1).
const fn reason(status: u8) -> &'static str {
    match status {
        1 => "the file is not for this device (errTARGET)",
        2 => "the file fails a test (errFILE)",
        3 => "it cannot write (errWRITE)",
        4 => "erasing failed (errERASE)",
        5 => "the memory is not erased (errCHECK_ERASED)",
        6 => "programming failed (errPROG)",
        7 => "verifying failed (errVERIFY)",
        8 => "the address is out of range (errADDRESS)",
        9 => "data are missing (errNOTDONE)",
        10 => "its firmware is broken (errFIRMWARE)",
        11 => "the flash is protected, or another vendor's error (errVENDOR)",
        12 => "USB was reset (errUSBR)",
        13 => "power was reset (errPOR)",
        15 => "a request came at the wrong time (errSTALLEDPKT)",
        _ => "the reason is unknown (errUNKNOWN)",
    }
}

#[cfg(test)]
mod tests;
