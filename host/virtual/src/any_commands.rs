//! Whatever a host sends, in any order, on both channels, at any load, the device keeps answering, and every frame that
//! was on the bus is delivered or counted.
//!
//! Real firmware logic on the simulated bus, in model time that this host advances itself, so that a failing sequence fails
//! again. The sequences contain possible and impossible commands, repeated greetings, resets, the bootloader, garbage, a
//! port that closes and opens, slcan lines, and a host that does not read for a while.

#[path = "../../../tests/it/arbitrary/mod.rs"]
mod arbitrary;

use std::io::Write;
use std::slice::IterMut;
use std::sync::Arc;

use cantap_wire::framing::{self, CRC_LEN, MAX_REQUEST, max_encoded_len};
use cantap_wire::message::{ChannelConfig, DEVICE_TAG, Status};
use cantap_wire::record::LossStage;
use cantap_wire::{
    BitTiming, CHANNELS, Channel, Command, Decoded, Decoder, Event, PROTOCOL_VERSION, Record, Reply, Request,
    Response,
};
use proptest::prelude::*;

use self::arbitrary::{channel_config, command, gateway};
use super::Options;
use super::board::{Dtr, VirtualPort};
use super::machine::{Machine, Memory, Witness, World};
use crate::simbus::Frames;
use cantap::device::{PipeReader, PipeWriter, pipe};

/// Number of sequences, each on a new device.
const SEQUENCES: u32 = 10_000;
/// How often the firmware may start in one sequence.
const LIVES: usize = 5;
/// Model time within which a device must have answered: it waits 100 ms for a stuck bus before it leaves by force.
const PATIENCE_MS: u32 = 400;
const MS_NS: u64 = 1_000_000;
/// Bytes in flight in each direction.
const PIPE_BYTES: usize = 16 * 1024;

#[derive(Clone, Debug)]
enum Action {
    Ask(Box<Command>),
    /// A gateway is started, or saved.
    Gateway(Vec<Command>),
    /// A new session.
    Greet,
    /// The books are balanced, and the session continues.
    Balance,
    /// The firmware ends, through one of the two commands for it.
    End(Box<Command>),
    Garbage(Vec<u8>),
    Line(Vec<u8>),
    /// The program closes the port for this many milliseconds.
    Close(u8),
    Pass(u8),
    Read(bool),
    /// The host reads nothing for this many milliseconds: at full load the queue overflows.
    Stall(u16),
}

fn line() -> impl Strategy<Value = Vec<u8>> {
    const LINES: [&str; 36] = [
        "O",
        "L",
        "C",
        "S0",
        "S4",
        "S6",
        "S8",
        "S9",
        "s031C",
        "s00FF",
        "Z0",
        "Z1",
        "Z2",
        "X0",
        "X1",
        "P",
        "A",
        "F",
        "V",
        "N",
        "I",
        "Y",
        "t1232AABB",
        "T1FFFFFFF0",
        "r1230",
        "R000000018",
        "t8000",
        "t12",
        "M00000000",
        "mFFFFFFFF",
        "m00FF00FF",
        "W0",
        "W1",
        "Q0",
        "Q1",
        "",
    ];
    let end = prop::sample::select(vec!["\r", "\r\n", ""]);
    (prop::sample::select(LINES.to_vec()), end).prop_map(|(line, end)| format!("{line}{end}").into_bytes())
}

fn action() -> impl Strategy<Value = Action> {
    let end = prop::sample::select(vec![Command::Reset, Command::Bootloader]);
    prop_oneof![
        // Rare, because it takes much computing.
        40 => (600..1400_u16).prop_map(Action::Stall),
        4200 => command().prop_map(|command| Action::Ask(Box::new(command))),
        300 => gateway().prop_map(Action::Gateway),
        100 => Just(Action::Greet),
        100 => Just(Action::Balance),
        100 => end.prop_map(|command| Action::End(Box::new(command))),
        300 => prop::collection::vec(any::<u8>(), 0..200).prop_map(Action::Garbage),
        300 => line().prop_map(Action::Line),
        100 => (0..4_u8).prop_map(Action::Close),
        900 => (0..12_u8).prop_map(Action::Pass),
        600 => any::<bool>().prop_map(Action::Read),
    ]
}

fn world() -> impl Strategy<Value = Options> {
    let load = prop::sample::select(vec![0.0, 5.0, 40.0, 100.0, 100.0]);
    let frames =
        prop::sample::select(vec![Frames::Std0, Frames::Std8, Frames::Ext8, Frames::Rtr, Frames::Mix]);
    let bitrate = prop::sample::select(vec![None, Some(500_000), Some(1_000_000)]);
    let errors = prop::sample::select(vec![0.0, 0.0, 3.0, 60.0]);
    let disturb = prop::sample::select(vec![0, 0, 5, 40, u32::MAX]);
    (load, frames, bitrate, errors, disturb, any::<[bool; 2]>(), any::<u64>()).prop_map(
        |(load_percent, frames, bitrate_bps, error_percent, disturb, [acknowledge, joined], seed)| Options {
            load_percent,
            frames,
            bitrate_bps,
            error_percent,
            disturb,
            acknowledge,
            seed,
            joined,
            ..Options::default()
        },
    )
}

/// What is known of the current session.
#[derive(Default)]
struct Books {
    /// What each bus had carried when it began.
    heard_before: [u64; CHANNELS],
    received: [u64; CHANNELS],
    lost: [u64; CHANNELS],
    /// Frames that the device accepted for transmission, and those whose end it has reported.
    taken: [usize; CHANNELS],
    ended: [usize; CHANNELS],
    /// Frames whose transmission was confirmed, whoever had asked for it.
    sent: [u64; CHANNELS],
    /// It began beside a gateway: what the buses had carried by then is not known exactly.
    beside_gateway: bool,
    /// Everything that a decoder in a session should not report.
    complaints: Vec<String>,
}

/// A host and its device.
struct Rig<'q> {
    /// One for each life of the firmware.
    memories: IterMut<'q, Option<Box<Memory>>>,
    machine: Option<Machine<'q>>,
    from_device: PipeReader,
    to_device: PipeWriter,
    open: Arc<Dtr>,
    witness: Arc<Witness>,
    decoder: Box<Decoder>,
    /// Whether the host reads.
    reads: bool,
    next_id: u16,
    /// Requests waiting for their answer, with the frames that they carry.
    waiting: Vec<(u16, Option<(Channel, usize)>)>,
    answers: Vec<Response>,
    /// Answers that were not requested, or came twice.
    surplus: Vec<u16>,
    books: Option<Books>,
}

impl<'q> Rig<'q> {
    fn new(memories: &'q mut [Option<Box<Memory>>; LIVES], mut options: Options) -> Self {
        let (from_device, to_host) = pipe(PIPE_BYTES);
        let (from_host, to_device) = pipe(PIPE_BYTES);
        let (open, witness) = (Arc::new(Dtr::new(true)), Arc::new(Witness::default()));
        let port = VirtualPort::new(from_host, to_host, Arc::clone(&open));
        let world = World::new(&mut options, port, Arc::clone(&witness));
        let mut rig = Self {
            memories: memories.iter_mut(),
            machine: None,
            from_device,
            to_device,
            open,
            witness,
            decoder: Box::new(Decoder::new()),
            reads: true,
            next_id: 0,
            waiting: Vec::new(),
            answers: Vec::new(),
            surplus: Vec::new(),
            books: None,
        };
        rig.power_up(world);
        rig
    }

    fn power_up(&mut self, world: World) {
        let memory = self.memories.next().expect("no sequence has more lives").insert(Memory::new());
        self.machine = Some(Machine::power_up(memory, world));
    }

    /// Whatever was in progress is lost.
    fn forget(&mut self) {
        self.books = None;
        self.waiting.clear();
    }

    /// A millisecond passes.
    fn step(&mut self) {
        let Some(machine) = &mut self.machine else { return };
        machine.advance(machine.now_ns() + MS_NS);
        if self.reads {
            self.read();
        }
        if let Some(machine) = self.machine.take_if(|machine| machine.ending().is_some()) {
            // What it had said has already reached the host.
            self.read();
            self.forget();
            // After the bootloader, somebody switched it off and on.
            self.power_up(machine.power_down());
        }
    }

    fn pass(&mut self, ms: u32) {
        (0..ms).for_each(|_| self.step());
    }

    fn read(&mut self) {
        let Self { decoder, books, answers, waiting, surplus, witness, .. } = self;
        let mut bytes = [0; 4096];
        loop {
            let len = self.from_device.take(&mut bytes);
            if len == 0 {
                return;
            }
            decoder.push(&bytes[..len], |decoded| match decoded {
                Decoded::Record { record, .. } => {
                    if let Some(books) = books {
                        books.enter(&record);
                    }
                }
                Decoded::Response(response) => {
                    match waiting.iter().position(|(id, _)| *id == response.id) {
                        Some(at) => {
                            let (_, carried) = waiting.remove(at);
                            if let (Ok(Reply::Queued { .. }), Some((channel, frames)), Some(books)) =
                                (&response.result, carried, &mut *books)
                            {
                                books.taken[channel.index()] += frames;
                            }
                        }
                        None => surplus.push(response.id),
                    }
                    if matches!(response.result, Ok(Reply::Hello(_))) {
                        // Earlier requests may have been dropped with their session.
                        waiting.clear();
                        let heard_before = witness.activity().frames;
                        *books = Some(Books { heard_before, ..Books::default() });
                    }
                    answers.push(response.clone());
                }
                other => {
                    if let Some(books) = books {
                        books.complaints.push(format!("{other:?}"));
                    }
                }
            });
        }
    }

    fn say(&mut self, bytes: &[u8]) {
        self.to_device.write_all(bytes).unwrap();
    }

    fn ask(&mut self, command: Command) -> u16 {
        self.next_id += 1;
        let id = self.next_id;
        let carried = match &command {
            Command::Send { channel, frames } => Some((*channel, frames.len())),
            _ => None,
        };
        let mut message = [0; MAX_REQUEST + CRC_LEN];
        let mut encoded = vec![0; max_encoded_len(MAX_REQUEST)];
        let length = framing::encode(&Request { id, command }, &mut message, &mut encoded).unwrap();
        // The zero ends anything left in the device's input and selects our protocol.
        self.say(&[0]);
        self.say(&encoded[..length]);
        self.waiting.push((id, carried));
        id
    }

    /// Sends a request and reads until the answer arrives; `None` if an earlier reset request lost it.
    fn await_answer(&mut self, command: Command) -> Result<Option<Response>, TestCaseError> {
        self.reads = true;
        self.answers.clear();
        let (what, lives_left) = (format!("{command:?}"), self.memories.len());
        let id = self.ask(command);
        for _ in 0..PATIENCE_MS {
            self.step();
            if let Some(at) = self.answers.iter().position(|answer| answer.id == id) {
                return Ok(Some(self.answers.swap_remove(at)));
            }
            if self.memories.len() != lives_left {
                return Ok(None);
            }
        }
        Err(TestCaseError::fail(format!("no answer to {what}")))
    }

    fn greet(&mut self) -> Result<(), TestCaseError> {
        loop {
            // Like a host that tries again when nothing answers.
            let Some(answer) = self.await_answer(Command::Hello { protocol: PROTOCOL_VERSION })? else {
                continue;
            };
            prop_assert!(matches!(answer.result, Ok(Reply::Hello(_))), "{answer:?}");
            let status = self.await_answer(Command::Status)?.map(|answer| answer.result);
            let (Some(Ok(Reply::Status(status))), Some(books)) = (status, &mut self.books) else { continue };
            books.beside_gateway = status.channels.iter().any(|channel| channel.open.is_some());
            return Ok(());
        }
    }

    /// The status, once everything recorded has been read; `None` after a reset.
    fn drain(&mut self) -> Result<Option<Status>, TestCaseError> {
        // Answers overtake records: a full queue takes a tenth of a second.
        for _ in 0..PATIENCE_MS {
            match self.await_answer(Command::Status)?.map(|answer| answer.result) {
                Some(Ok(Reply::Status(status))) if status.queue_bytes == 0 => return Ok(Some(status)),
                Some(Ok(Reply::Status(_))) => {}
                None => return Ok(None),
                other => return Err(TestCaseError::fail(format!("{other:?} in place of a status"))),
            }
        }
        Err(TestCaseError::fail("the queue does not become empty"))
    }

    fn act(&mut self, action: Action) -> Result<(), TestCaseError> {
        match action {
            Action::Ask(command) => {
                self.ask(*command);
                self.step();
            }
            Action::Gateway(commands) => {
                for command in commands {
                    self.ask(command);
                    self.step();
                }
            }
            Action::Greet => self.greet()?,
            Action::Balance => self.balance()?,
            Action::End(command) => {
                if self.memories.len() > 0 {
                    self.ask(*command);
                    self.pass(60);
                }
            }
            Action::Garbage(bytes) | Action::Line(bytes) => {
                self.say(&bytes);
                self.step();
            }
            Action::Close(ms) => {
                self.open.set(false);
                self.pass(u32::from(ms) + 1);
                // The next program finds nothing of what was in progress.
                while self.from_device.take(&mut [0; 4096]) > 0 {}
                *self.decoder = Decoder::new();
                self.forget();
                self.open.set(true);
            }
            Action::Pass(ms) => self.pass(u32::from(ms)),
            Action::Read(reads) => self.reads = reads,
            Action::Stall(ms) => {
                self.reads = false;
                self.pass(u32::from(ms));
            }
        }
        Ok(())
    }

    /// Closes both channels and balances the books, if there is a session.
    fn balance(&mut self) -> Result<(), TestCaseError> {
        self.reads = true;
        // Half a line in the device's input would become the beginning of the next request.
        self.say(&[0]);
        self.pass(1);
        if self.books.is_none() {
            return Ok(());
        }
        for channel in Channel::ALL {
            let Some(closed) = self.await_answer(Command::Close { channel })? else { return Ok(()) };
            prop_assert_eq!(closed.result, Ok(Reply::Done));
        }
        let Some(status) = self.drain()? else { return Ok(()) };
        self.pass(3);
        let Some(books) = &self.books else { return Ok(()) };
        // Only requests that found no room in the device's input, which are counted, may stay unanswered.
        prop_assert!(self.waiting.len() <= status.bad_requests as usize, "{:?} of {status:?}", self.waiting);
        prop_assert!(books.complaints.is_empty(), "{:?}", books.complaints);
        let heard = self.witness.activity().frames;
        for channel in Channel::ALL {
            let index = channel.index();
            let counted = &status.channels[index];
            let on_the_bus = heard[index] - books.heard_before[index];
            // Confirmations of a gateway's that found no room are lost frames of this channel.
            let untold = u64::from(counted.transmitted).wrapping_sub(books.sent[index]);
            if !books.beside_gateway {
                let ours = books.received[index] + books.lost[index];
                prop_assert_eq!(ours, on_the_bus + untold, "{:?}", channel);
            }
            prop_assert_eq!(u64::from(counted.lost_queue), books.lost[index]);
            prop_assert_eq!((counted.tx_pending, counted.open), (0, None));
            prop_assert_eq!(books.ended[index], books.taken[index], "transmissions of {:?}", channel);
        }
        prop_assert!(self.surplus.is_empty(), "answered though not asked: {:?}", self.surplus);
        Ok(())
    }

    /// After all of it, the device serves the next host as if nothing had happened.
    fn settle(mut self) -> Result<(), TestCaseError> {
        self.reads = true;
        self.pass(60);
        self.balance()?;
        self.greet()?;
        // It may have started as a gateway.
        for channel in Channel::ALL {
            self.await_answer(Command::Close { channel })?;
        }
        self.greet()?;
        let timing = BitTiming::choose(cantap_firmware::CAN_CLOCK_HZ, 1_000_000, None).unwrap();
        let config = Some(ChannelConfig::listen_only(timing));
        for channel in Channel::ALL {
            let opened = self.await_answer(Command::Open { channel, config })?.map(|answer| answer.result);
            prop_assert!(matches!(opened, Some(Ok(Reply::Opened(_)))), "{opened:?}");
        }
        self.pass(3);
        self.balance()
    }
}

impl Books {
    fn enter(&mut self, record: &Record) {
        match record {
            Record::Received(received) => self.received[received.channel.index()] += 1,
            Record::ReceivedFd(received) => self.complaints.push(format!("{received:?}")),
            Record::TransmittedFd(sent) => self.complaints.push(format!("{sent:?}")),
            Record::Event(Event::Lost { channel, stage: LossStage::Queue, count, .. }) => {
                self.lost[channel.index()] += u64::from(*count);
            }
            Record::Event(
                event
                @ (Event::Transmitted { channel, tag, .. } | Event::TransmitFailed { channel, tag, .. }),
            ) => {
                self.sent[channel.index()] += u64::from(matches!(event, Event::Transmitted { .. }));
                self.ended[channel.index()] += usize::from(*tag < DEVICE_TAG);
            }
            Record::Event(Event::Lost { stage: LossStage::Gateway, .. }) => {}
            Record::Event(event @ Event::Lost { .. }) => self.complaints.push(format!("{event:?}")),
            Record::Event(_) => {}
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: SEQUENCES, max_shrink_iters: 5000, ..ProptestConfig::default() })]
    #[test]
    fn any_sequence_leaves_the_device_answering_and_the_counting_law_intact(
        options in world(),
        configs in [prop::option::weighted(0.9, channel_config()), prop::option::weighted(0.9, channel_config())],
        actions in prop::collection::vec(action(), 1..24),
    ) {
        let mut memories: [Option<Box<Memory>>; LIVES] = Default::default();
        let mut rig = Rig::new(&mut memories, options);
        rig.greet()?;
        for (channel, config) in Channel::ALL.into_iter().zip(configs) {
            if config.is_some() {
                rig.ask(Command::Open { channel, config });
            }
        }
        rig.pass(1);
        for action in actions {
            rig.act(action)?;
        }
        rig.settle()?;
    }
}
