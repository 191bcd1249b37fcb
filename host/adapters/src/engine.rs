//! The thread in which the firmware runs on top of an adapter's driver.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::io::{self, Read};
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap::device::{Link, PipeReader, pipe};
use cantap_firmware::bus::capture::Capture;
use cantap_firmware::bus::gateway::Lane;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::transmit::TxQueue;
use cantap_firmware::port::board::Board as _;
use cantap_firmware::port::command::Identity;
use cantap_firmware::port::session::{self, Session};
use cantap_firmware::ports::{Clock, Outcome};
use cantap_trace::TraceFrame;
use cantap_wire::{CHANNELS, Channel, Event};
use heapless::String;

use crate::board::{AdapterBoard, Filters, HostClock, NoChip, NoMeter, PipePort};
use crate::driver::{At, Driver, Incoming};
use crate::in_order::InOrder;
use crate::loss_rows::LossRows;
use crate::mailboxes::{ControlSide, Mailboxes, Phase, TrafficSide};

/// Bytes on their way to the host, and to the device.
const PIPE_BYTES: usize = 64 * 1024;
/// How often the firmware's millisecond tick comes.
const TICK: Duration = Duration::from_millis(1);
/// With more than this in the record queue, nothing more is taken from the adapter: what waits does so in the system's buffers, and what can
/// wait at its source is not lost.
const HOLD_BACK_BYTES: u32 = 48 * 1024;
/// How long a channel that is being closed waits for the confirmation of what the adapter has taken.
const CONFIRM_WITHIN: Duration = Duration::from_millis(50);
/// How long what it had received may take to reach the host. What is left then is counted as lost where the record queue has no room.
const DELIVER_WITHIN: Duration = Duration::from_millis(1_500);
/// After an adapter's end, and with everything handed over, the firmware goes on for this many ticks: a batch waits for one.
const LAST_TICKS: u32 = 20;
/// Reports that found no room, at most; more are counted by kind in the status only.
const MAX_UNREPORTED: usize = 1024;

/// The memory that the firmware gets at its start.
struct Memory {
    records: RecordQueue,
    transmit: [TxQueue; CHANNELS],
    lanes: [Lane; CHANNELS],
    session: session::Memory,
}

/// Why the adapter has ended, for people.
type Reason = Arc<Mutex<Option<std::string::String>>>;

/// A running device side. It ends when this is dropped.
struct Running {
    quit: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.quit.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The host's reading end: at the end it says why.
struct Reader {
    pipe: PipeReader,
    reason: Reason,
}

impl Read for Reader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        match self.pipe.read(out) {
            Ok(0) if !out.is_empty() => {
                let reason = self.reason.lock().unwrap_or_else(PoisonError::into_inner).clone();
                Err(io::Error::new(
                    io::ErrorKind::ConnectionAborted,
                    reason.unwrap_or_else(|| "the adapter's thread has ended".to_owned()),
                ))
            }
            other => other,
        }
    }
}

/// Starts the device side of an adapter.
pub(crate) fn start(driver: Box<dyn Driver>) -> io::Result<Link> {
    let (pipe_reader, to_host) = pipe(PIPE_BYTES);
    let (from_host, writer) = pipe(PIPE_BYTES);
    let quit = Arc::new(AtomicBool::new(false));
    let reason = Reason::default();
    let port = PipePort::new(from_host, to_host, Arc::clone(&quit));
    let for_thread = Arc::clone(&reason);
    let thread = std::thread::Builder::new()
        .name("cantap-adapter".to_owned())
        .spawn(move || run(driver, port, &for_thread))?;
    let running = Running { quit, thread: Some(thread) };
    Ok(Link::new(Reader { pipe: pipe_reader, reason }, writer).keeping(running))
}

#[expect(clippy::large_stack_arrays, reason = "a computer's stack has room for them")]
fn run(driver: Box<dyn Driver>, port: PipePort, reason: &Reason) {
    let mut memory = Box::new(Memory {
        records: RecordQueue::new(),
        transmit: [const { TxQueue::new() }; CHANNELS],
        lanes: [const { Lane::new() }; CHANNELS],
        session: session::Memory::new(),
    });
    let Memory { records, transmit, lanes, session } = &mut *memory;
    let (producer, consumer) = records.split();
    let boxes = [(); CHANNELS].map(|()| Rc::new(RefCell::new(Mailboxes::new())));
    let side = |channel: usize| Rc::clone(&boxes[channel]);
    let serial: std::string::String =
        driver.serial().chars().filter(char::is_ascii_graphic).take(24).collect();
    let identity =
        Identity { board: driver.row().board, serial: String::try_from(serial.as_str()).unwrap_or_default() };
    let mut engine = Engine {
        board: AdapterBoard {
            capture: Capture::new(producer, transmit, lanes),
            traffic: [TrafficSide(side(0)), TrafficSide(side(1))],
            control: [ControlSide(side(0)), ControlSide(side(1))],
            boxes: [side(0), side(1)],
            clock: HostClock::start(),
            filters: Filters::open(),
            chip: NoChip((0, std::string::String::new())),
            meter: NoMeter,
            driver,
            held_at: None,
        },
        session: Session::new(consumer, identity, session),
        port,
        reports: VecDeque::new(),
        fresh: Vec::new(),
        order: InOrder::default(),
        losses: LossRows::default(),
        unreported: VecDeque::new(),
        leaving_since: [None; CHANNELS],
        closed: [false; CHANNELS],
        next_tick: Instant::now(),
    };
    let ended = engine.run();
    *reason.lock().unwrap_or_else(PoisonError::into_inner) = ended;
}

struct Engine<'q> {
    board: AdapterBoard<'q>,
    session: Session<'q>,
    port: PipePort,
    /// What the driver has reported and the firmware has not taken yet.
    reports: VecDeque<Incoming>,
    /// The driver's last reports, for a moment.
    fresh: Vec<Incoming>,
    order: InOrder,
    losses: LossRows,
    /// Events that found no room in the record queue.
    unreported: VecDeque<(Event, u64)>,
    /// Since when a channel is being closed.
    leaving_since: [Option<Instant>; CHANNELS],
    /// The driver has closed a channel that is being closed.
    closed: [bool; CHANNELS],
    next_tick: Instant,
}

impl Engine<'_> {
    /// Runs until the host or the adapter is gone. Returns why the adapter is.
    fn run(&mut self) -> Option<std::string::String> {
        let mut gone = None;
        let mut ticks_left = LAST_TICKS;
        while !self.is_over() {
            let wait = self.board.clock.until_alarm().unwrap_or(TICK).min(TICK);
            self.take_reports();
            if gone.is_none() && self.reports.is_empty() {
                gone = self.ask_driver(wait);
            } else {
                std::thread::sleep(wait.min(TICK / 10));
            }
            let ticked = self.tick();
            self.close_channels(gone.is_some());
            self.hand_over();
            self.session.poll(&mut self.port, &mut self.board);
            if gone.is_some() && ticked && self.reports.is_empty() && self.board.capture.fill().0 == 0 {
                ticks_left -= 1;
                if ticks_left == 0 {
                    break;
                }
            }
        }
        for channel in Channel::ALL {
            if self.board.boxes[channel.index()].borrow().phase != Phase::Off {
                self.board.driver.close(channel);
            }
        }
        gone
    }

    fn is_over(&self) -> bool {
        self.port.quit.load(Ordering::Relaxed) || self.port.to_host.is_closed()
    }

    /// What time demands: the alarm, and once a millisecond the tick. Returns whether there was one.
    fn tick(&mut self) -> bool {
        let Self { board, session, .. } = self;
        if board.clock.take_alarm() {
            board.capture.on_alarm(&mut board.traffic, &board.clock);
        }
        let now = Instant::now();
        if now < self.next_tick {
            return false;
        }
        // After a pause, ticks are not made up for: only the next counts.
        self.next_tick = now + TICK;
        board.capture.on_tick(&mut board.traffic, &board.clock);
        session.tick(board);
        while let Some((event, at)) = self.unreported.pop_front() {
            if !board.capture.on_reported(&event, at) {
                self.unreported.push_front((event, at));
                break;
            }
        }
        true
    }

    /// Lets the driver report, for up to `wait`. Returns why it has ended, if it has.
    fn ask_driver(&mut self, wait: Duration) -> Option<std::string::String> {
        let ended = self.board.driver.poll(wait, &mut self.fresh).err();
        self.order.correct(&mut self.fresh);
        self.losses.pass(&mut self.fresh, Instant::now(), &mut self.reports);
        if ended.is_some() {
            self.losses.flush(&mut self.reports);
        }
        self.take_reports();
        ended
    }

    /// Takes what was reported, as long as the record queue has room.
    fn take_reports(&mut self) {
        while self.board.capture.fill().0 < HOLD_BACK_BYTES
            && let Some(incoming) = self.reports.pop_front()
        {
            self.take(incoming);
        }
    }

    fn take(&mut self, incoming: Incoming) {
        let board = &mut self.board;
        let ticks = |board: &AdapterBoard<'_>, at: At| board.clock.ticks_at(at.instant);
        let is_on = |board: &AdapterBoard<'_>, channel: Channel| {
            matches!(board.boxes[channel.index()].borrow().phase, Phase::On | Phase::Leaving)
        };
        match incoming {
            Incoming::Received { channel, frame, at } => {
                if !is_on(board, channel) || !board.filters.pass(channel, &frame) {
                    return;
                }
                let ticks = ticks(board, at);
                match frame {
                    TraceFrame::Classic(frame) => {
                        let traffic = &mut board.traffic[channel.index()];
                        board.capture.on_stamped_frame(
                            channel,
                            frame,
                            ticks,
                            at.stamp,
                            traffic,
                            &board.clock,
                        );
                    }
                    TraceFrame::Fd(frame) => {
                        board.capture.on_stamped_fd_frame(channel, frame, ticks, at.stamp);
                    }
                }
            }
            Incoming::Sent { channel, mailbox, at } | Incoming::NotSent { channel, mailbox, at } => {
                let is_sent = matches!(incoming, Incoming::Sent { .. });
                let outcome = if is_sent { Outcome::Sent } else { Outcome::Aborted };
                let finished = board.boxes[channel.index()].borrow_mut().finish(mailbox, outcome);
                if finished {
                    let entered = ticks(board, at) as u32;
                    board.capture.on_transmit(channel, &mut board.traffic, &board.clock, Some(entered));
                }
            }
            Incoming::BusError { channel, kind, at } if is_on(board, channel) => {
                board.boxes[channel.index()].borrow_mut().error = Some(kind);
                let entered = ticks(board, at) as u32;
                board.capture.on_error(channel, &mut board.traffic[channel.index()], entered);
            }
            Incoming::State { channel, state, counters, at } if is_on(board, channel) => {
                {
                    let mut boxes = board.boxes[channel.index()].borrow_mut();
                    (boxes.state, boxes.counters) = (state, counters);
                }
                let entered = ticks(board, at) as u32;
                board.capture.on_error(channel, &mut board.traffic[channel.index()], entered);
            }
            Incoming::BusErrors { channel, count, at } if is_on(board, channel) => {
                let at = ticks(board, at);
                self.report(Event::ErrorsSuppressed { channel, count }, at);
            }
            Incoming::Lost { channel, stage, count, at_least, at } if is_on(board, channel) => {
                let at = ticks(board, at);
                self.report(Event::Lost { channel, stage, count, at_least }, at);
            }
            // Of a channel that is closed.
            Incoming::BusError { .. }
            | Incoming::State { .. }
            | Incoming::BusErrors { .. }
            | Incoming::Lost { .. } => {}
        }
    }

    fn report(&mut self, event: Event, at: u64) {
        let in_turn = self.unreported.is_empty();
        if !(in_turn && self.board.capture.on_reported(&event, at)) && self.unreported.len() < MAX_UNREPORTED
        {
            self.unreported.push_back((event, at));
        }
    }

    /// Gives the adapter what is to be sent.
    fn hand_over(&mut self) {
        let board = &mut self.board;
        for channel in Channel::ALL {
            loop {
                let next = board.boxes[channel.index()].borrow().waiting.front().copied();
                let Some((mailbox, frame)) = next else { break };
                let taken = match frame {
                    TraceFrame::Classic(frame) => board.driver.send(channel, mailbox, &frame),
                    TraceFrame::Fd(frame) => board.driver.send_fd(channel, mailbox, &frame),
                };
                if !taken {
                    break;
                }
                board.boxes[channel.index()].borrow_mut().taken();
            }
            if board.boxes[channel.index()].borrow().has_finished() {
                let now = board.clock.now();
                board.capture.on_transmit(channel, &mut board.traffic, &board.clock, Some(now));
            }
        }
    }

    /// Closes what the firmware has stopped, after what the adapter has taken is confirmed, and with everything it had received.
    fn close_channels(&mut self, is_gone: bool) {
        self.hold_time();
        for channel in Channel::ALL {
            let boxes = Rc::clone(&self.board.boxes[channel.index()]);
            if boxes.borrow().phase != Phase::Leaving {
                self.leaving_since[channel.index()] = None;
                continue;
            }
            let since = *self.leaving_since[channel.index()].get_or_insert_with(Instant::now);
            if !is_gone && boxes.borrow().has_handed() && since.elapsed() < CONFIRM_WITHIN {
                continue;
            }
            if !is_gone && !self.closed[channel.index()] {
                self.board.driver.close(channel);
                self.closed[channel.index()] = true;
                // If it says why it ended, the next poll says so again.
                let _ = self.ask_driver(Duration::ZERO);
                self.losses.flush(&mut self.reports);
                self.take_reports();
            }
            if since.elapsed() > DELIVER_WITHIN {
                while let Some(incoming) = self.reports.pop_front() {
                    self.take(incoming);
                }
            }
            if !self.reports.is_empty() {
                continue;
            }
            self.closed[channel.index()] = false;
            boxes.borrow_mut().switch_off();
        }
    }

    /// While a channel is being closed, the firmware's commands see no time pass: a controller leaves its bus in milliseconds, and what a socket
    /// holds may take longer.
    fn hold_time(&mut self) {
        let board = &mut self.board;
        let is_leaving = Channel::ALL.into_iter().any(|channel| {
            let phase = board.boxes[channel.index()].borrow().phase;
            phase == Phase::Leaving || phase == Phase::Off && board.is_open(channel)
        });
        board.held_at = is_leaving.then(|| board.held_at.unwrap_or_else(|| board.clock.now()));
    }
}
