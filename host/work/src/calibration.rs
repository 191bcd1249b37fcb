//! A master of XCP or CCP: reads, writes and measures an ECU's values over a device.

mod lists;

use std::time::Duration;

use anyhow::{Context as _, anyhow, bail, ensure};
use cantap::Frame;
use cantap_protocols::Event;
use cantap_protocols::active::calibration::{CalibrationCommand, CommandError, CommandRequest, Dialect};
use cantap_protocols::calibration::{ByteOrder, MasterSlave};
use cantap_protocols::ccp::codec as ccp;
use cantap_protocols::xcp::codec::{self as xcp, command};

pub use self::lists::{RunningList, Sampled};
use crate::speaking::Speaking;

/// Bytes of a frame: commands are sent in classical ones, whatever the slave has room for.
const MOST_FRAME: usize = 8;
/// Bytes of a seed of CCP.
const CCP_SEED: usize = 4;
/// Most bytes that are read with one name or address.
pub const MOST_READ: u32 = 1 << 16;

/// Whom to ask, and how long to wait.
#[derive(Clone, Copy, Debug)]
pub struct MasterOptions {
    /// The identifiers.
    pub parties: MasterSlave,
    /// CCP, for the station with this address and numbers in this order; otherwise XCP.
    pub ccp: Option<(u16, ByteOrder)>,
    /// Fill every frame of XCP up to eight bytes.
    pub is_padded: bool,
    /// How long an answer may take.
    pub timeout: Duration,
    /// How long one command may take altogether, however often its answer is pending.
    pub patience: Duration,
}

/// What a slave has said when it was connected.
#[derive(Clone, Copy, Debug)]
struct Connected {
    order: ByteOrder,
    max_cto: usize,
    max_dto: usize,
    /// Bytes of an address unit.
    unit: usize,
}

/// A master that talks to one slave. Whatever ends it, the slave is disconnected, so that nothing goes on.
pub struct Master<'d> {
    /// The channel.
    pub speaking: Speaking<'d>,
    options: MasterOptions,
    counter: u8,
    connected: Option<Connected>,
}

/// The command's name.
fn name_of(is_ccp: bool, code: u8) -> String {
    let name = if is_ccp {
        ccp::find(code).map(|command| command.name)
    } else {
        xcp::find(code).map(|command| command.name)
    };
    name.map_or_else(|| format!("command {code:02X}"), str::to_owned)
}

/// What a refusal means, and what helps.
fn refusal(is_ccp: bool, code: u8) -> String {
    if is_ccp {
        let text = ccp::return_name(code).unwrap_or("unknown code");
        let advice = match code {
            0x32 | 0x33 => "; the ECU has nothing there, or not for reading or writing",
            0x35 => "; the ECU wants a key: unlock it with --unlock and --key-command",
            _ => "",
        };
        return format!("{text} ({code:02X}){advice}");
    }
    let text = xcp::error_name(code).unwrap_or("unknown error");
    let advice = match code {
        xcp::error::CMD_UNKNOWN => "; the ECU does not have it",
        xcp::error::OUT_OF_RANGE => "; the ECU has no such address, list or event",
        0x23 => "; it is not to be written",
        xcp::error::ACCESS_DENIED => "; the ECU has nothing there, or not for reading or writing",
        xcp::error::ACCESS_LOCKED => "; unlock it with --unlock and --key-command",
        xcp::error::DAQ_CONFIG | xcp::error::MEMORY_OVERFLOW => "; measure less at once",
        _ => "",
    };
    format!("{text} ({code:02X}){advice}")
}

impl<'d> Master<'d> {
    /// Over a device whose channel is open.
    pub const fn new(speaking: Speaking<'d>, options: MasterOptions) -> Self {
        Self { speaking, options, counter: 0, connected: None }
    }

    /// Passes on the events of our conversation since the last call, if they are wanted.
    ///
    /// # Errors
    ///
    /// They cannot be written.
    pub fn show(&mut self, mut is_wanted: impl FnMut(&Event) -> bool) -> std::io::Result<()> {
        let parties = self.options.parties;
        self.speaking.show(|event| is_ours(event, parties) && is_wanted(event))
    }

    /// The events of our conversation since the last call.
    pub fn take_events(&mut self) -> Vec<Event> {
        let parties = self.options.parties;
        let events = self.speaking.take_events().into_iter();
        events.filter(|event| is_ours(event, parties)).collect()
    }

    /// Whether it speaks CCP, whose packets have no stamps.
    pub const fn is_ccp(&self) -> bool {
        self.options.ccp.is_some()
    }

    /// The order of the slave's bytes, once it is connected.
    pub fn order(&self) -> Option<ByteOrder> {
        self.options.ccp.map(|(_, order)| order).or(self.connected.map(|connected| connected.order))
    }

    /// Bytes of one of the slave's address units: 1, 2 or 4.
    pub fn granularity(&self) -> usize {
        self.connected.map_or(1, |connected| connected.unit)
    }

    /// Sends a command and returns its answer.
    ///
    /// # Errors
    ///
    /// There is no answer, or a refusal.
    pub fn ask(&mut self, command: Vec<u8>, data: usize, is_repeatable: bool) -> anyhow::Result<Vec<u8>> {
        match self.ask_whether(command, data, is_repeatable)? {
            Ok(answer) => Ok(answer),
            Err((name, code)) => Err(anyhow!("the ECU refused {name}: {}", refusal(self.is_ccp(), code))),
        }
    }

    /// The same; a refusal is returned with the command's name.
    fn ask_whether(
        &mut self,
        command: Vec<u8>,
        data: usize,
        is_repeatable: bool,
    ) -> anyhow::Result<Result<Vec<u8>, (String, u8)>> {
        let name = name_of(self.is_ccp(), command.first().copied().unwrap_or_default());
        let dialect = if self.is_ccp() {
            let counter = self.counter;
            self.counter = counter.wrapping_add(1);
            Dialect::Ccp { counter }
        } else {
            Dialect::Xcp { is_padded: self.options.is_padded }
        };
        let ns = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX).min(u64::MAX / 4);
        let mut machine = CalibrationCommand::new(CommandRequest {
            parties: self.options.parties,
            dialect,
            command,
            data,
            skipped: self.granularity() - 1,
            is_repeatable,
            timeout_ns: ns(self.options.timeout),
            patience_ns: ns(self.options.patience),
        });
        self.speaking.run(&mut machine)?;
        match machine.finish() {
            Ok(answer) => Ok(Ok(answer)),
            Err(CommandError::Refused { code }) => Ok(Err((name, code))),
            Err(error) => {
                let circumstances = match error {
                    CommandError::NoAnswer { .. } => format!("; {}", self.speaking.circumstances()),
                    _ => String::new(),
                };
                if error == CommandError::Terminated {
                    self.connected = None;
                }
                bail!("{name} to {}: {error}{circumstances}", self.options.parties)
            }
        }
    }

    /// Begins a session.
    ///
    /// # Errors
    ///
    /// The slave does not answer, or not as the standard says.
    pub fn connect(&mut self) -> anyhow::Result<()> {
        if let Some((station, order)) = self.options.ccp {
            // From the first command on, the slave may be connected.
            self.connected = Some(Connected { order, max_cto: 8, max_dto: 8, unit: 1 });
            let [low, high] = station.to_le_bytes();
            let connected = self.ask(vec![ccp::command::CONNECT, low, high], 0, true);
            if connected.is_err() {
                self.connected = None;
            }
            connected?;
            self.ask(vec![ccp::command::GET_CCP_VERSION, 2, 1], 2, true)?;
            return Ok(());
        }
        let answer = self.ask(vec![command::CONNECT, 0], 0, true)?;
        // Whatever it says, it is to be disconnected.
        self.connected = Some(Connected { order: ByteOrder::Little, max_cto: 8, max_dto: 8, unit: 1 });
        let &[_, mode, max_cto, first, second, protocol, transport, ..] = &answer[..] else {
            bail!("the ECU's answer to CONNECT has {} bytes; it has to have 7", answer.len());
        };
        let order = if mode & 1 == 0 { ByteOrder::Little } else { ByteOrder::Big };
        self.connected = Some(Connected {
            order,
            max_cto: max_cto.into(),
            max_dto: order.number(&[first, second]) as usize,
            unit: 1 << (mode >> 1 & 3).min(2),
        });
        ensure!(mode & 6 != 6, "the ECU counts addresses in units that XCP does not have");
        ensure!(
            protocol == 1 && transport == 1 && max_cto >= 8 && order.number(&[first, second]) >= 8,
            "the ECU's answer to CONNECT is not XCP 1.x on CAN: version {protocol} and {transport}, packets of {max_cto} and {} bytes",
            order.number(&[first, second])
        );
        Ok(())
    }

    fn state(&self) -> anyhow::Result<Connected> {
        self.connected.context("not connected")
    }

    fn number(&self, number: u64, size: usize) -> Vec<u8> {
        self.order().unwrap_or(ByteOrder::Little).bytes(number, size)
    }

    /// What a slave says about itself, as far as it has it: its events show all of it.
    ///
    /// # Errors
    ///
    /// It stops answering.
    pub fn inquire(&mut self) -> anyhow::Result<()> {
        if self.is_ccp() {
            for command in [vec![ccp::command::EXCHANGE_ID], vec![ccp::command::GET_S_STATUS]] {
                let answer = self.ask_whether(command, 0, true)?;
                // The name follows, as long as it was said to be.
                if let Ok([length, 1, ..]) = answer.as_deref() {
                    let mut left = usize::from(*length);
                    while left > 0 {
                        let part = left.min(5);
                        let asked = self.ask_whether(vec![ccp::command::UPLOAD, part as u8], part, false)?;
                        left = if asked.is_ok() { left - part } else { 0 };
                    }
                }
            }
            return Ok(());
        }
        self.ask(vec![command::GET_STATUS], 0, true)?;
        self.ask_whether(vec![command::GET_COMM_MODE_INFO], 0, true)?.ok();
        if let Ok([mode, _, _, length @ ..]) = self.ask_whether(vec![command::GET_ID, 1], 0, true)?.as_deref()
            && mode & 1 == 0
            && length.len() >= 4
        {
            let length = self.state()?.order.number(&length[..4]).min(255) as usize;
            // Unanswered, it may have moved on: it is not asked again.
            self.upload_text(length)?;
        }
        let Ok(info) = self.ask_whether(vec![command::GET_DAQ_PROCESSOR_INFO], 0, true)? else {
            return Ok(());
        };
        self.ask_whether(vec![command::GET_DAQ_RESOLUTION_INFO], 0, true)?.ok();
        let events =
            info.get(3..5).map_or(0, |bytes| self.state().map_or(0, |state| state.order.number(bytes)));
        for event in 0..events.min(256) {
            let command = [&[command::GET_DAQ_EVENT_INFO, 0][..], &self.number(event, 2)].concat();
            let Ok(about) = self.ask_whether(command, 0, true)? else { break };
            self.upload_text(about.get(2).copied().unwrap_or_default().into())?;
        }
        Ok(())
    }

    /// Fetches a text of so many bytes, if it has any, which the slave has just offered.
    fn upload_text(&mut self, length: usize) -> anyhow::Result<()> {
        let elements = length.div_ceil(self.granularity());
        if elements > 0 {
            let data = elements * self.granularity();
            self.ask_whether(vec![command::UPLOAD, elements as u8], data, false)?.ok();
        }
        Ok(())
    }

    /// Reads so many bytes of the memory, from this address in the slave's units.
    ///
    /// # Errors
    ///
    /// The slave does not answer or refuses.
    pub fn read(&mut self, extension: u8, address: u32, length: u32) -> anyhow::Result<Vec<u8>> {
        ensure!(length <= MOST_READ, "at most {MOST_READ} bytes are read at once");
        let unit = self.granularity();
        // An answer's data begin at a whole unit.
        let room = if self.is_ccp() { 5 } else { self.state()?.max_cto.min(MOST_FRAME) - unit };
        let whole = (length as usize).next_multiple_of(unit);
        let mut data = Vec::new();
        while data.len() < whole {
            let at =
                address.checked_add((data.len() / unit) as u32).context("it is beyond the last address")?;
            let elements = (room / unit).min((whole - data.len()) / unit);
            let count = elements * unit;
            let place = self.number(at.into(), 4);
            let command = if self.is_ccp() {
                [&[ccp::command::SHORT_UP, count as u8, extension][..], &place].concat()
            } else {
                [&[command::SHORT_UPLOAD, elements as u8, 0, extension][..], &place].concat()
            };
            let answer = self.ask(command, count, true)?;
            data.extend_from_slice(&answer[..count]);
        }
        data.truncate(length as usize);
        Ok(data)
    }

    /// Writes memory, reads it back, and compares.
    ///
    /// # Errors
    ///
    /// The slave does not answer or refuses, or has something else there afterwards.
    pub fn write(&mut self, extension: u8, address: u32, bytes: &[u8]) -> anyhow::Result<()> {
        let unit = self.granularity();
        ensure!(
            bytes.len().is_multiple_of(unit),
            "the ECU's addresses count units of {unit} bytes; {} bytes are not a whole number of them",
            bytes.len()
        );
        let place = self.number(address.into(), 4);
        if self.is_ccp() {
            self.ask([&[ccp::command::SET_MTA, 0, extension][..], &place].concat(), 0, true)?;
            for part in bytes.chunks(5) {
                self.ask([&[ccp::command::DNLOAD, part.len() as u8][..], part].concat(), 0, false)?;
            }
        } else {
            self.ask([&[command::SET_MTA, 0, 0, extension][..], &place].concat(), 0, true)?;
            // Data begin at a whole unit.
            let head = unit.max(2);
            let room = (self.state()?.max_cto.min(MOST_FRAME) - head) / unit * unit;
            for part in bytes.chunks(room) {
                let mut command = vec![command::DOWNLOAD, (part.len() / unit) as u8];
                command.resize(head, 0);
                command.extend_from_slice(part);
                self.ask(command, 0, false)?;
            }
        }
        let back = self.read(extension, address, bytes.len() as u32)?;
        ensure!(
            back == bytes,
            "the ECU took it, and has something else there: {back:02X?} instead of {bytes:02X?}"
        );
        Ok(())
    }

    /// The seed for a resource; empty if it needs no key.
    ///
    /// # Errors
    ///
    /// The slave does not answer or refuses.
    pub fn seed(&mut self, resource: u8) -> anyhow::Result<Vec<u8>> {
        if self.is_ccp() {
            let answer = self.ask(vec![ccp::command::GET_SEED, resource], 1, true)?;
            let Some((&is_protected, seed)) = answer.split_first() else {
                bail!("the ECU's answer has no seed")
            };
            return Ok(if is_protected == 0 {
                Vec::new()
            } else {
                seed.iter().copied().take(CCP_SEED).collect()
            });
        }
        let (mut part, mut seed, mut left) = (0, Vec::new(), None);
        loop {
            let answer = self.ask(vec![command::GET_SEED, part, resource], 0, false)?;
            let Some((&length, bytes)) = answer.split_first() else { bail!("the ECU's answer has no seed") };
            let remaining = usize::from(length);
            let taken = bytes.len().min(remaining);
            ensure!(
                left.is_none_or(|left| left == remaining) && (taken > 0 || remaining == 0),
                "the lengths in the ECU's seed contradict each other"
            );
            seed.extend_from_slice(&bytes[..taken]);
            if taken == remaining {
                return Ok(seed);
            }
            (part, left) = (1, Some(remaining - taken));
        }
    }

    /// Sends a key.
    ///
    /// # Errors
    ///
    /// The slave refuses it; it has then ended the session.
    pub fn unlock(&mut self, key: &[u8]) -> anyhow::Result<()> {
        if self.is_ccp() {
            ensure!((1..=6).contains(&key.len()), "a key of CCP has 1 to 6 bytes");
            return self.ask([&[ccp::command::UNLOCK][..], key].concat(), 0, false).map(drop);
        }
        ensure!((1..=255).contains(&key.len()), "a key has 1 to 255 bytes");
        let mut left = key;
        while !left.is_empty() {
            let part = &left[..left.len().min(self.state()?.max_cto.min(MOST_FRAME) - 2)];
            self.ask([&[command::UNLOCK, left.len() as u8][..], part].concat(), 0, false)?;
            left = &left[part.len()..];
        }
        Ok(())
    }

    /// Ends the session: lists are stopped, the slave is disconnected. Also after Ctrl-C, and without waiting for answers.
    pub fn disconnect(&mut self) {
        if self.connected.take().is_none() {
            return;
        }
        let frames: Vec<Vec<u8>> = if let Some((station, _)) = self.options.ccp {
            let [low, high] = station.to_le_bytes();
            let next = self.counter.wrapping_add(1);
            vec![
                vec![ccp::command::START_STOP_ALL, self.counter, 0, 0, 0, 0, 0, 0],
                vec![ccp::command::DISCONNECT, next, 1, 0, low, high, 0, 0],
            ]
        } else {
            let mut frames = vec![vec![command::START_STOP_SYNCH, 0], vec![command::DISCONNECT]];
            if self.options.is_padded {
                for frame in &mut frames {
                    frame.resize(8, 0);
                }
            }
            frames
        };
        for data in frames {
            if let Some(frame) = Frame::data_frame(self.options.parties.master, &data) {
                // Whether it still arrives changes nothing here.
                let _ = self.speaking.send_last(frame);
            }
        }
    }
}

impl Drop for Master<'_> {
    fn drop(&mut self) {
        self.disconnect();
    }
}

/// Whether an event is from our conversation: others may be measured on the same bus.
fn is_ours(event: &Event, parties: MasterSlave) -> bool {
    let (master, slave) = (parties.master.into(), parties.slave.into());
    (event.from, event.to) == (master, slave) || (event.from, event.to) == (slave, master)
}
