//! One host at a time: what it sends is read here, and everything it receives is sent from here.
//!
//! The port speaks two languages. A first byte of 0 means the native protocol, a letter means slcan.
//! Runs below the tasks of priority 4, in the USB interrupt and the millisecond tick; nothing here
//! waits.

use cantap_wire::framing::{MAX_REQUEST, max_encoded_len, unseal_with};
use cantap_wire::message::{EndReason, read_send, why_unreadable};
use cantap_wire::{Channel, Command, Refusal, Reply, Request};

use crate::QUEUE_BYTES;
use crate::bus::queue::Consumer;
use crate::bus::sof::SofMarks;
use crate::port::answers::Answers;
use crate::port::board::Board;
use crate::port::command::{Commands, Identity, Step, Work, send};
use crate::port::inbox::Inbox;
use crate::port::outbox::Outbox;
use crate::port::sender::Sender;
use crate::port::slcan::{Answer, Slcan};
use crate::ports::{ON_ITS_WAY, PACKET, Port, PortHistory};

/// Longest request on the wire, zero byte included.
const MAX_REQUEST_ENCODED: usize = max_encoded_len(MAX_REQUEST);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Language {
    /// The host has said nothing yet.
    Unknown,
    /// Before and after `Hello`.
    Native {
        greeted: bool,
    },
    Slcan,
}

/// Who waits for the work under way.
#[derive(Clone, Copy, Debug)]
enum Origin {
    /// The request with this id.
    Request(u16),
    /// An slcan line.
    Line,
    /// Nobody.
    Device,
}

/// How far the device has come in ending a session on its own initiative.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    /// There is no such session, or its host knows that it has ended.
    No,
    /// It is to end as soon as the work under way allows.
    Wanted(EndReason),
    /// The channels leave their buses.
    Leaving(EndReason),
    /// The channels had left by this time, of which the host is informed after what is queued.
    Since(EndReason, u64),
}

/// What became of the gateway that is stored in the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stored {
    /// The device has just started.
    Unread,
    /// Its channels are being opened.
    Opening,
    /// It was started, and what no host reads is dropped.
    Started,
    /// There is none, or it could not be started.
    None,
}

/// The memory of a session: a dozen kilobytes, constructed in place, never on a stack.
pub struct Memory {
    sender: Sender,
    inbox: Inbox,
    outbox: Outbox,
    answers: Answers,
    /// The request being handled, and the packet being read: kept here, because clearing them on the stack takes time.
    request: [u8; MAX_REQUEST_ENCODED],
    packet: [u8; PACKET],
}

impl Memory {
    /// Nothing in it.
    pub const fn new() -> Self {
        Self {
            sender: Sender::new(),
            inbox: Inbox::new(),
            outbox: Outbox::new(),
            answers: Answers::new(),
            request: [0; MAX_REQUEST_ENCODED],
            packet: [0; PACKET],
        }
    }
}

impl Default for Memory {
    fn default() -> Self {
        Self::new()
    }
}

/// Everything between the record queue and the port.
pub struct Session<'q, const N: usize = QUEUE_BYTES> {
    queue: Consumer<'q, N>,
    sender: &'q mut Sender,
    slcan: Slcan,
    commands: Commands,
    inbox: &'q mut Inbox,
    outbox: &'q mut Outbox,
    language: Language,
    work: Option<(Work, Origin)>,
    ending: Ending,
    /// How far the device has come with the gateway that is stored in it.
    stored: Stored,
    /// As far as the device can tell, the host of a session that has ended is still there: what is left of the session is for it.
    is_heir: bool,
    /// What the host had done with the port at the last check.
    history: PortHistory,
    answers: &'q mut Answers,
    marks: SofMarks,
    request: &'q mut [u8; MAX_REQUEST_ENCODED],
    packet: &'q mut [u8; PACKET],
}

impl<'q, const N: usize> Session<'q, N> {
    /// No host yet.
    pub const fn new(queue: Consumer<'q, N>, identity: Identity, memory: &'q mut Memory) -> Self {
        let Memory { sender, inbox, outbox, answers, request, packet } = memory;
        Self {
            queue,
            sender,
            slcan: Slcan::new(),
            commands: Commands::new(identity),
            inbox,
            outbox,
            language: Language::Unknown,
            work: None,
            ending: Ending::No,
            stored: Stored::Unread,
            is_heir: false,
            history: PortHistory { opened: 0, configured: 0 },
            answers,
            marks: SofMarks::new(),
            request,
            packet,
        }
    }

    /// Whether a host is talking to the device.
    pub fn is_active(&self) -> bool {
        self.language != Language::Unknown
    }

    /// Marks the start of a USB frame once a second. Call it every millisecond.
    pub fn tick(&mut self, board: &mut impl Board<'q, N>) {
        if self.stored != Stored::None {
            self.look_after_stored(board);
        }
        let reading = board.take_sof();
        // Only a native session has a place for marks.
        if matches!(self.language, Language::Native { greeted: true })
            && let Some(mark) = self.marks.tick(reading)
        {
            board.with_capture(|capture, _, _| capture.on_sof(mark));
        }
    }

    /// Starts the gateway that is stored in the device, once; and drops what it records while no host reads.
    fn look_after_stored(&mut self, board: &mut impl Board<'q, N>) {
        match self.stored {
            Stored::Unread if self.is_active() || self.work.is_some() => self.stored = Stored::None,
            Stored::Unread => {
                self.stored = Stored::Opening;
                self.go_on_with_stored(board);
            }
            Stored::Started if self.language == Language::Unknown && self.work.is_none() => {
                self.queue.clear();
                if !board.with_capture(|capture, _, _| capture.is_standalone()) {
                    // It has ended, and nobody else closes its channels.
                    self.stored = Stored::None;
                    self.begin(Work::Silence, Origin::Device, board);
                }
            }
            _ => {}
        }
    }

    /// Opens the next channel for the stored gateway, or starts it.
    fn go_on_with_stored(&mut self, board: &mut impl Board<'q, N>) {
        if let Some(work) = self.commands.begin_stored_gateway(board) {
            self.work = Some((work, Origin::Device));
            return;
        }
        let started = board.with_capture(|capture, _, _| capture.start_gateway(true)).is_ok();
        self.stored = if started { Stored::Started } else { Stored::None };
        if !started && Channel::ALL.iter().any(|&channel| board.is_open(channel)) {
            self.begin(Work::Silence, Origin::Device, board);
        }
    }

    /// Reads, works and writes as far as possible without waiting. Call it at every USB interrupt and
    /// every millisecond.
    pub fn poll(&mut self, port: &mut impl Port, board: &mut impl Board<'q, N>) {
        self.notice(port.history(), board);
        if port.is_suspended() {
            self.want_end(EndReason::Suspended);
        }
        self.begin_end(board);
        if port.is_suspended() {
            return self.look_after_work(board);
        }
        if !port.is_open() {
            return self.hang_up(port, board);
        }
        self.read(port);
        loop {
            self.look_after_work(board);
            if !self.is_holding_back() {
                self.outbox.pump(port);
            }
            let moved = self.outbox.is_empty() && self.fill_outbox(board);
            let handled = self.handle_next(board);
            if !moved && !handled {
                break;
            }
        }
        self.hold(port);
        if !self.is_holding_back() {
            self.outbox.end(port);
        }
    }

    /// Whether what is left of a session is held back until a request comes: its host may be gone, and the next host must not get
    /// any of it.
    fn is_holding_back(&self) -> bool {
        self.ending != Ending::No && !self.is_heir
    }

    /// Checks what the host has done with the port since the last call. A host that reconfigured the device may or may not have
    /// told the program that has the port open, so what is left of the session waits until a program sends a request. One that
    /// opens the port is a new program.
    fn notice(&mut self, now: PortHistory, board: &mut impl Board<'q, N>) {
        let seen = core::mem::replace(&mut self.history, now);
        if seen.opened != now.opened {
            self.forget_host(board);
        } else if seen.configured != now.configured {
            self.want_end(EndReason::Configured);
            self.is_heir = false;
        }
    }

    /// The session is to end, if there is one or one is just beginning.
    fn want_end(&mut self, reason: EndReason) {
        if self.ending == Ending::No && self.is_active() {
            self.ending = Ending::Wanted(reason);
            self.is_heir = reason != EndReason::Configured;
        }
    }

    /// Ends the session if requested: the channels leave their buses. What is queued stays, and so, after a suspension, does
    /// what the USB controller has already taken: the host receives all of it, and then the session's end.
    fn begin_end(&mut self, board: &mut impl Board<'q, N>) {
        let Ending::Wanted(reason) = self.ending else { return };
        // A session that is just beginning is begun first, and a requested restart is carried out.
        if matches!(self.work, Some((Work::Keep | Work::Silence | Work::Restart | Work::Bootloader, _))) {
            return;
        }
        let in_session = match self.language {
            Language::Unknown => false,
            Language::Native { greeted } => greeted,
            Language::Slcan => true,
        };
        if !in_session {
            self.ending = Ending::No;
            return;
        }
        if matches!(Work::fresh(board), Work::Keep) {
            // The gateway's channels do not leave their buses, so there is no end to report: the host finds that nobody answers.
            return self.forget_host(board);
        }
        self.ending = Ending::Leaving(reason);
        if let Some((_, Origin::Request(id))) = self.work {
            self.answers.add(id, &Err(Refusal::NoSession));
        }
        if let Language::Native { greeted } = &mut self.language {
            *greeted = false;
        }
        self.begin(Work::Retreat, Origin::Device, board);
    }

    /// The host is gone: the channels leave the bus, and nothing of the session remains.
    fn hang_up(&mut self, port: &mut impl Port, board: &mut impl Board<'q, N>) {
        port.hold(false);
        while port.read(self.packet).is_some() {}
        self.forget_host(board);
        self.look_after_work(board);
    }

    fn forget_host(&mut self, board: &mut impl Board<'q, N>) {
        if self.is_active() {
            self.language = Language::Unknown;
            self.ending = Ending::No;
            self.inbox.clear();
            self.outbox.clear();
            self.answers.clear();
            // A host that requested a restart may be gone before it happens.
            if !matches!(self.work, Some((Work::Restart | Work::Bootloader, _))) {
                self.begin(Work::fresh(board), Origin::Device, board);
            }
        }
    }

    /// Takes every packet available: one left in the USB peripheral would hold up the control pipe behind it. So the host is
    /// made to wait while there is still room for what is on its way. If there is no room nevertheless, the packet is dropped
    /// and counted.
    fn read(&mut self, port: &mut impl Port) {
        loop {
            self.hold(port);
            let Some(len) = port.read(self.packet) else { break };
            if !self.inbox.push(&self.packet[..len]) {
                self.commands.bad_requests = self.commands.bad_requests.wrapping_add(1);
            }
        }
    }

    fn hold(&self, port: &mut impl Port) {
        port.hold(self.inbox.room() < ON_ITS_WAY * PACKET);
    }

    fn begin(&mut self, work: Work, origin: Origin, board: &mut impl Board<'q, N>) {
        self.commands.begin(work, board);
        self.work = Some((work, origin));
    }

    fn look_after_work(&mut self, board: &mut impl Board<'q, N>) {
        let Some((work, origin)) = self.work else { return };
        let Some(result) = self.commands.progress(work, board) else { return };
        self.work = None;
        if self.stored == Stored::Opening && matches!(work, Work::Open(..)) {
            if result.is_ok() {
                self.go_on_with_stored(board);
            } else {
                self.stored = Stored::None;
                self.begin(Work::Silence, Origin::Device, board);
            }
        }
        if matches!(work, Work::Silence | Work::Keep) {
            if !matches!(self.ending, Ending::Wanted(_)) {
                self.ending = Ending::No;
            }
            let Self { queue, .. } = self;
            // Under one lock: beside a gateway, records are written at any time.
            let now = board.with_capture(|capture, traffic, clock| {
                queue.clear();
                match work {
                    Work::Keep => capture.restart_beside_gateway(traffic, clock),
                    _ => capture.restart(clock),
                }
            });
            self.sender.restart(now);
            self.slcan.restart(now);
            self.marks = SofMarks::new();
        }
        if let (Work::Retreat, Ending::Leaving(reason)) = (work, self.ending) {
            let at = board.with_capture(|capture, _, clock| capture.now(clock));
            self.ending = Ending::Since(reason, at);
        }
        match origin {
            Origin::Request(id) => {
                if matches!(work, Work::Silence | Work::Keep) {
                    self.language = Language::Native { greeted: result.is_ok() };
                    self.outbox.clear();
                    self.answers.clear();
                }
                self.answers.add(id, &result);
            }
            Origin::Line => self.slcan.answer(if result.is_ok() { Answer::Ok } else { Answer::Refused }),
            Origin::Device => {}
        }
    }

    /// Handles one request or line, unless something is still under way or there is no room for its answer. Returns whether there
    /// was one.
    fn handle_next(&mut self, board: &mut impl Board<'q, N>) -> bool {
        if self.work.is_some() || !self.answers.have_room() || self.slcan.is_answering() {
            return false;
        }
        if self.language == Language::Unknown || self.inbox.first() == Some(0) {
            return self.choose_language(board);
        }
        if self.inbox.first().is_none() {
            return false;
        }
        match self.language {
            Language::Native { greeted } => self.handle_request(greeted, board),
            Language::Slcan => self.handle_line(board),
            Language::Unknown => false,
        }
    }

    /// The first byte decides the language. A zero switches to the native one at any time.
    fn choose_language(&mut self, board: &mut impl Board<'q, N>) -> bool {
        let Some(first) = self.inbox.first() else { return false };
        match first {
            0 => {
                self.inbox.skip(1);
                if self.inbox.end_skipping() {
                    self.commands.bad_requests = self.commands.bad_requests.wrapping_add(1);
                }
                if !matches!(self.language, Language::Native { .. }) {
                    self.language = Language::Native { greeted: false };
                }
            }
            b'\r' | b'A'..=b'Z' | b'a'..=b'z' => {
                self.language = Language::Slcan;
                self.begin(Work::fresh(board), Origin::Device, board);
            }
            _ => self.inbox.skip(1),
        }
        true
    }

    fn handle_request(&mut self, greeted: bool, board: &mut impl Board<'q, N>) -> bool {
        let Self { inbox, request, .. } = self;
        let taken = inbox.take_until(0, MAX_REQUEST_ENCODED, |encoded| {
            unseal_with(encoded, &mut request[..], |message| board.crc32(message)).map(<[u8]>::len)
        });
        let Some(len) = taken else { return false };
        let Some(Ok(len)) = len else {
            // Damaged: the id of the request to answer is unknown.
            self.commands.bad_requests = self.commands.bad_requests.wrapping_add(1);
            return true;
        };
        if !(greeted && self.execute_send(len, board)) {
            self.execute(len, greeted, board);
        }
        true
    }

    /// Queues the frames of the request to send, of this many bytes; returns whether it is one.
    ///
    /// Not inlined, nor is the function for the other requests: neither should use the stack that only the other needs.
    #[inline(never)]
    fn execute_send(&mut self, len: usize, board: &mut impl Board<'q, N>) -> bool {
        let mut frames = heapless::Vec::new();
        let Some((id, channel)) = read_send(&self.request[..len], &mut frames) else { return false };
        let queued = send(channel, &frames, board);
        self.answers.add(id, &queued.map(|free| Reply::Queued { free }));
        true
    }

    /// Carries out the request of this many bytes.
    #[inline(never)]
    fn execute(&mut self, len: usize, greeted: bool, board: &mut impl Board<'q, N>) {
        let message = &self.request[..len];
        let (id, result) = match postcard::from_bytes(message) {
            Ok(Request { id, command }) if greeted || matches!(command, Command::Hello { .. }) => {
                (id, self.commands.execute(command, board))
            }
            Ok(Request { id, .. }) => {
                self.is_heir = true;
                (id, Err(Refusal::NoSession))
            }
            Err(_) => {
                self.commands.bad_requests = self.commands.bad_requests.wrapping_add(1);
                let Ok((id, _)) = postcard::take_from_bytes(message) else { return };
                // It arrived undamaged, but is something that this device does not know.
                (id, Err(why_unreadable(message)))
            }
        };
        match result {
            Ok(Step::Done(reply)) => self.answers.add(id, &Ok(reply)),
            Ok(Step::Begun(work)) => {
                if matches!(work, Work::Restart | Work::Bootloader) {
                    // It ends in a restart: the answer goes first.
                    self.answers.add(id, &Ok(Reply::Done));
                    self.work = Some((work, Origin::Device));
                } else {
                    self.work = Some((work, Origin::Request(id)));
                }
            }
            Err(refusal) => self.answers.add(id, &Err(refusal)),
        }
    }

    fn handle_line(&mut self, board: &mut impl Board<'q, N>) -> bool {
        // The next program speaks the native language: half a line of the last one must not swallow its greeting.
        if self.inbox.drop_unfinished(b'\r') {
            return true;
        }
        // Terminal programs end lines with CR LF.
        if self.inbox.first() == Some(b'\n') {
            self.inbox.skip(1);
            return true;
        }
        if self.slcan.must_wait(self.inbox.first(), board) {
            return false;
        }
        let mut line = heapless::Vec::<u8, { Slcan::MAX_LINE }>::new();
        let Some(taken) =
            self.inbox.take_until(b'\r', Slcan::MAX_LINE, |bytes| line.extend_from_slice(bytes))
        else {
            return false;
        };
        if matches!(self.ending, Ending::Since(..)) && !self.is_heir {
            // The end of the session, sent after the rest of it, is the answer.
            self.is_heir = true;
            return true;
        }
        if taken.is_none_or(|copied| copied.is_err()) {
            self.slcan.answer(Answer::Refused);
            return true;
        }
        if let Some(work) = self.slcan.line(&line, &mut self.commands, board) {
            self.work = Some((work, Origin::Line));
        }
        true
    }

    /// Fills the empty outbox with what is to be sent next: the answers, then what was captured. Returns whether there was
    /// something.
    ///
    /// Answers wait until the end of an ended session has been sent: a host takes the first refusal for that end, and stops
    /// listening.
    fn fill_outbox(&mut self, board: &mut impl Board<'q, N>) -> bool {
        if self.is_holding_back() {
            return false;
        }
        let Self { queue, sender, slcan, outbox, answers, ending, .. } = self;
        let untold = matches!(ending, Ending::Leaving(_) | Ending::Since(..));
        match self.language {
            Language::Unknown => {}
            Language::Native { .. } => outbox.fill(|out| {
                let answered = if untold { 0 } else { answers.take(out) };
                let rest = &mut out[answered..];
                let mut len = sender.next_batch(queue, board.now(), rest, |message| board.crc32(message));
                if let (0, Ending::Since(reason, at)) = (len, *ending) {
                    len = sender.end(queue, reason, at, rest);
                    if len > 0 {
                        *ending = Ending::No;
                    }
                }
                answered + len
            }),
            Language::Slcan => {
                outbox.fill(|out| slcan.next_lines(queue, out));
                if outbox.is_empty() && matches!(ending, Ending::Since(..)) {
                    *ending = Ending::No;
                    slcan.answer(Answer::Refused);
                    outbox.fill(|out| slcan.next_lines(queue, out));
                }
            }
        }
        !self.outbox.is_empty()
    }
}
