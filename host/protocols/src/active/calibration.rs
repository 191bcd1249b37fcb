//! A command of XCP or CCP with its answer, as the master.
//!
//! Where no answer comes, XCP's SYNCH asks whether the slave is still there and listens to commands; only then a command that may be
//! repeated is. A slave that is busy is asked again; one that says that its answer is pending is waited for.

use cantap_can::Frame;
use cantap_trace::Id;

use super::Machine;
use crate::calibration::MasterSlave;
use crate::ccp::codec as ccp;
use crate::xcp::codec as xcp;

/// How often a command is sent again when no answer came.
const MOST_REPEATS: u32 = 2;
/// How long to wait before a busy slave is asked again, in nanoseconds (T7 of XCP).
const BUSY_NS: u64 = 50_000_000;

/// Which language a command is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dialect {
    /// XCP; frames are filled up to eight bytes if `is_padded`.
    Xcp {
        /// Every frame has eight bytes.
        is_padded: bool,
    },
    /// CCP, with this counter.
    Ccp {
        /// The command's number, from 0 to 255 and round again.
        counter: u8,
    },
}

/// What to send, and what answers it.
#[derive(Clone, Debug)]
pub struct CommandRequest {
    /// The identifiers.
    pub parties: MasterSlave,
    /// The language.
    pub dialect: Dialect,
    /// The command's code and parameters; without the counter of CCP.
    pub command: Vec<u8>,
    /// How many bytes of data answer it, in one response of XCP or several.
    pub data: usize,
    /// Bytes between the first byte of such a response and its data: XCP's data begin at a whole address unit.
    pub skipped: usize,
    /// It does the same if it is sent twice.
    pub is_repeatable: bool,
    /// How long the answer may take, in nanoseconds.
    pub timeout_ns: u64,
    /// How long all of it may take, however often it is repeated or pending.
    pub patience_ns: u64,
}

/// Why there is no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CommandError {
    /// No answer came, to SYNCH neither.
    #[error("no answer within {after_ms} ms, nor after {repeats} repetitions")]
    NoAnswer {
        /// How long we waited for each.
        after_ms: u64,
        /// How often it was repeated.
        repeats: u32,
    },
    /// No answer came although the slave is there; the command may have been carried out, so it was not repeated.
    #[error(
        "no answer within {after_ms} ms, although the slave is there; it is unknown whether the command was carried out"
    )]
    Lost {
        /// How long we waited.
        after_ms: u64,
    },
    /// The slave has been busy, or has said that its answer is pending, all the time.
    #[error("the slave has been busy for {after_ms} ms")]
    Busy {
        /// For how long.
        after_ms: u64,
    },
    /// The slave refuses it.
    #[error("the slave refused it")]
    Refused {
        /// Its code.
        code: u8,
    },
    /// The slave has ended the session.
    #[error("the slave has ended the session")]
    Terminated,
    /// The answer has fewer bytes than were asked for.
    #[error("the slave's answer is too short: {got} bytes instead of {expected}")]
    TooShort {
        /// As many as were asked for.
        expected: usize,
        /// As many as there were.
        got: usize,
    },
    /// Another master uses the same identifier.
    #[error(
        "another master sends with the same identifier at the same time; the answers may be to its commands"
    )]
    OtherMaster,
    /// The command has more bytes than a frame.
    #[error("the command is longer than a frame")]
    TooLong,
    /// Frames from the bus were lost on the way to this computer.
    #[error("frames were lost on the way to this computer, the answer perhaps among them")]
    FramesLost,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// The command is to be sent.
    Ask,
    /// It is on its way, or was sent.
    Asked,
    /// After a time-out, SYNCH is to be sent.
    Synch,
    /// SYNCH was sent.
    Synching,
    /// The slave is busy: the command is sent again later.
    Busy,
}

/// One command.
#[derive(Clone, Debug)]
pub struct CalibrationCommand {
    request: CommandRequest,
    step: Step,
    begun_ns: Option<u64>,
    until_ns: Option<u64>,
    under_way: usize,
    repeats: u32,
    synchs: u32,
    gathered: Vec<u8>,
    end: Option<Result<Vec<u8>, CommandError>>,
}

impl CalibrationCommand {
    /// For a command that is not sent yet.
    pub const fn new(request: CommandRequest) -> Self {
        Self {
            request,
            step: Step::Ask,
            begun_ns: None,
            until_ns: None,
            under_way: 0,
            repeats: 0,
            synchs: 0,
            gathered: Vec::new(),
            end: None,
        }
    }

    /// What the slave has answered, when this is done: of XCP, the response without its first byte, or the data of a block; of CCP, what
    /// follows the counter.
    ///
    /// # Errors
    ///
    /// There was no such answer.
    pub fn finish(self) -> Result<Vec<u8>, CommandError> {
        let after_ms = self.request.timeout_ns / 1_000_000;
        self.end.unwrap_or(Err(CommandError::NoAnswer { after_ms, repeats: self.repeats }))
    }

    fn frame(&self, bytes: &[u8]) -> Option<Frame> {
        let mut data = bytes.to_vec();
        match self.request.dialect {
            Dialect::Xcp { is_padded: true } => data.resize(data.len().max(8), 0),
            Dialect::Xcp { is_padded: false } => {}
            Dialect::Ccp { counter } => {
                data.insert(1.min(data.len()), counter);
                data.resize(data.len().max(8), 0);
            }
        }
        Frame::data_frame(self.request.parties.master, &data)
    }

    fn fail(&mut self, error: CommandError) {
        self.end = Some(Err(error));
    }

    fn time_out(&mut self, now_ns: u64) {
        let after_ms = self.request.timeout_ns / 1_000_000;
        self.until_ns = None;
        let begun_ns = self.begun_ns.unwrap_or(now_ns);
        match self.step {
            Step::Busy => {
                self.step = Step::Ask;
                return;
            }
            _ if now_ns.saturating_sub(begun_ns) >= self.request.patience_ns => {}
            Step::Asked => match self.request.dialect {
                // CONNECT is what wakes a slave up: there is nothing before it.
                Dialect::Xcp { .. } if self.request.command.first() != Some(&xcp::command::CONNECT) => {
                    self.step = Step::Synch;
                    return;
                }
                _ if self.request.is_repeatable && self.repeats < MOST_REPEATS => {
                    self.repeats += 1;
                    self.step = Step::Ask;
                    return;
                }
                _ => {}
            },
            Step::Synching if self.synchs <= MOST_REPEATS => {
                self.step = Step::Synch;
                return;
            }
            _ => {}
        }
        self.fail(CommandError::NoAnswer { after_ms, repeats: self.repeats });
    }

    /// The slave is there, and has not answered.
    fn synchronized(&mut self) {
        self.until_ns = None;
        self.gathered.clear();
        if self.request.is_repeatable && self.repeats < MOST_REPEATS {
            self.repeats += 1;
            self.step = Step::Ask;
        } else {
            self.fail(CommandError::Lost { after_ms: self.request.timeout_ns / 1_000_000 });
        }
    }

    /// Waits, unless that has gone on for too long.
    fn wait(&mut self, now_ns: u64, time_ns: u64) {
        let begun_ns = self.begun_ns.unwrap_or(now_ns);
        if now_ns.saturating_sub(begun_ns) >= self.request.patience_ns {
            self.fail(CommandError::Busy { after_ms: self.request.patience_ns / 1_000_000 });
            return;
        }
        self.until_ns = Some(now_ns.saturating_add(time_ns));
    }

    fn hear_xcp(&mut self, now_ns: u64, data: &[u8]) {
        match (data, self.step) {
            (&[xcp::ERR, xcp::error::CMD_SYNCH, ..], Step::Synching) => self.synchronized(),
            (&[xcp::EV, xcp::EV_CMD_PENDING, ..], _) => {
                self.wait(now_ns, self.request.timeout_ns);
            }
            (&[xcp::EV, xcp::EV_SESSION_TERMINATED, ..], _) => self.fail(CommandError::Terminated),
            (&[xcp::ERR, xcp::error::CMD_BUSY, ..], Step::Asked) => {
                self.wait(now_ns, BUSY_NS);
                self.step = Step::Busy;
            }
            (&[xcp::ERR, code, ..], Step::Asked) => self.fail(CommandError::Refused { code }),
            (&[xcp::ERR], Step::Asked) => self.fail(CommandError::TooShort { expected: 2, got: 1 }),
            (&[xcp::RES, ref rest @ ..], Step::Asked) => {
                let expected = self.request.data;
                if expected == 0 {
                    self.end = Some(Ok(rest.to_vec()));
                    return;
                }
                let left = expected - self.gathered.len();
                let part = rest.get(self.request.skipped..).unwrap_or_default();
                self.gathered.extend_from_slice(&part[..part.len().min(left)]);
                let got = self.gathered.len();
                if got == expected {
                    self.end = Some(Ok(std::mem::take(&mut self.gathered)));
                } else if rest.len() < 7 {
                    // Only the last response of a block is shorter than a frame.
                    self.fail(CommandError::TooShort { expected, got });
                } else {
                    self.until_ns = Some(now_ns.saturating_add(self.request.timeout_ns));
                }
            }
            _ => {}
        }
    }

    fn hear_ccp(&mut self, now_ns: u64, data: &[u8], counter: u8) {
        let [ccp::COMMAND_RETURN, code, answered, ref rest @ ..] = *data else { return };
        if answered != counter || self.step != Step::Asked {
            return;
        }
        match code {
            0 if rest.len() < self.request.data => {
                self.fail(CommandError::TooShort { expected: self.request.data, got: rest.len() });
            }
            0 => self.end = Some(Ok(rest.to_vec())),
            // Processors that are busy, and time-outs within the ECU.
            0x10..=0x12 => {
                self.wait(now_ns, BUSY_NS);
                self.step = Step::Busy;
            }
            code => self.fail(CommandError::Refused { code }),
        }
    }
}

impl Machine for CalibrationCommand {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        if self.end.is_some() || self.under_way > 0 {
            return None;
        }
        if self.until_ns.is_some_and(|until_ns| now_ns >= until_ns) {
            self.time_out(now_ns);
        }
        let frame = match self.step {
            _ if self.end.is_some() => None,
            Step::Ask => {
                self.begun_ns.get_or_insert(now_ns);
                self.gathered.clear();
                self.step = Step::Asked;
                self.frame(&self.request.command)
            }
            Step::Synch => {
                self.synchs += 1;
                self.step = Step::Synching;
                self.frame(&[xcp::command::SYNCH])
            }
            _ => return None,
        };
        if frame.is_none() && self.end.is_none() {
            self.fail(CommandError::TooLong);
        }
        self.under_way += usize::from(frame.is_some());
        frame
    }

    fn sent(&mut self, now_ns: u64) {
        self.under_way = self.under_way.saturating_sub(1);
        if self.end.is_none() {
            self.until_ns = Some(now_ns.saturating_add(self.request.timeout_ns));
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        if self.end.is_some() || self.begun_ns.is_none() {
            return;
        }
        if id == self.request.parties.master {
            self.fail(CommandError::OtherMaster);
        } else if id == self.request.parties.slave {
            match self.request.dialect {
                Dialect::Xcp { .. } => self.hear_xcp(now_ns, data),
                Dialect::Ccp { counter } => self.hear_ccp(now_ns, data, counter),
            }
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        // What is not there in time is asked for again; only a block may lack a part that nobody would miss.
        if self.end.is_none() && !self.gathered.is_empty() {
            self.fail(CommandError::FramesLost);
        }
    }

    fn due_ns(&self) -> Option<u64> {
        if self.under_way > 0 { None } else { self.until_ns.or_else(|| self.end.is_none().then_some(0)) }
    }

    fn is_done(&self) -> bool {
        self.end.is_some() && self.under_way == 0
    }
}
