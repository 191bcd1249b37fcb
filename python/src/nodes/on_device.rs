//! Nodes on a device, in a thread of their own: they have their turns also while Python does something else.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, TryRecvError, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use cantap::device::Ticks;
use cantap::{DeviceError, TraceRecord};
use cantap_address::{Address, OpenDevice};
use cantap_scripts::{Live, LiveError, LiveRun, Message, Script};
use cantap_signals::Decoder;
use cantap_trace::Frame;
use cantap_wire::message::{ChannelConfig, Mode, capability};
use cantap_wire::{BitTiming, Channel};

use crate::error::Error;

/// The seed of random numbers, as the command's.
pub const SEED: u64 = 1;
/// How long an order waits at most for the nodes' thread.
const TURN: Duration = Duration::from_millis(1);
/// How long after its time a record may arrive.
const LATENESS: Duration = Duration::from_millis(100);

type Answer<T> = Sender<Result<T, LiveError>>;

enum Order {
    Add(Script, Answer<usize>),
    End(usize, Answer<()>),
    Send(Channel, Frame, Answer<()>),
    Repeat(u32, Option<(Channel, Frame, u64)>, Answer<()>),
    Now(Answer<i64>),
    Messages(Answer<Vec<Message>>),
    Errors(Answer<Vec<(String, String)>>),
}

/// Nodes on a device.
pub struct OnDevice {
    orders: Option<Sender<Order>>,
    records: Receiver<TraceRecord>,
    thread: Option<JoinHandle<Result<(), LiveError>>>,
}

impl OnDevice {
    /// Opens a device and joins the bus of a channel.
    pub fn open(
        address: &str,
        channel_of: Channel,
        bitrate_bps: Option<u32>,
        decoder: Arc<Decoder>,
    ) -> Result<Self, Error> {
        let device = address.parse::<Address>().map_err(Error::argument)?.open()?;
        if let Some(bitrate_bps) = bitrate_bps.or_else(|| device.bitrate_of_bus(channel_of)) {
            device.join(channel_of, bitrate_bps)?;
        } else if device.hello().capabilities & capability::NO_BIT_RATE != 0 {
            let unknown = ChannelConfig::listen_only(BitTiming::UNKNOWN);
            device.open_channel(channel_of, Some(ChannelConfig { mode: Mode::Normal, ..unknown }))?;
        } else {
            return Err(Error::argument(format!("'{address}' has no bit rate that is known; give one")));
        }
        let (orders, received) = channel();
        let (passed, records) = channel();
        let body = move || {
            run(&device, &Live { decoder, seed: SEED, readable: None, duration: None }, &received, &passed)
        };
        let thread = std::thread::Builder::new().name("cantap-nodes".to_owned()).spawn(body);
        let thread = thread.map_err(|error| Error::Device(DeviceError::Thread(error)))?;
        Ok(Self { orders: Some(orders), records, thread: Some(thread) })
    }

    fn ask<T>(&mut self, order: impl FnOnce(Answer<T>) -> Order) -> Result<T, Error> {
        let (answer, answered) = channel();
        let is_taken = self.orders.as_ref().is_some_and(|orders| orders.send(order(answer)).is_ok());
        let answer = if is_taken { answered.recv().ok() } else { None };
        match answer {
            Some(answer) => answer.map_err(error),
            None => Err(self.over()),
        }
    }

    /// Why its thread has ended.
    fn over(&mut self) -> Error {
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(Err(reason))) => error(reason),
            _ => Error::Address("the device is gone".to_owned()),
        }
    }

    pub fn add(&mut self, script: Script) -> Result<usize, Error> {
        self.ask(|answer| Order::Add(script, answer))
    }

    pub fn end(&mut self, node: usize) -> Result<(), Error> {
        self.ask(|answer| Order::End(node, answer))
    }

    pub fn send(&mut self, channel: Channel, frame: Frame) -> Result<(), Error> {
        self.ask(|answer| Order::Send(channel, frame, answer))
    }

    pub fn repeat(&mut self, handle: u32, repeated: Option<(Channel, Frame, u64)>) -> Result<(), Error> {
        self.ask(|answer| Order::Repeat(handle, repeated, answer))
    }

    /// UTC by the device's clock, in nanoseconds since 1970.
    pub fn now_ns(&mut self) -> Result<i64, Error> {
        self.ask(Order::Now)
    }

    pub fn messages(&mut self) -> Result<Vec<Message>, Error> {
        self.ask(Order::Messages)
    }

    pub fn errors(&mut self) -> Result<Vec<(String, String)>, Error> {
        self.ask(Order::Errors)
    }

    /// The next records, also later ones; empty if none comes for a while, or by `until_ns`. At 0, it waits for none.
    pub fn advance(&mut self, until_ns: i64) -> Result<Vec<TraceRecord>, Error> {
        if until_ns == 0 {
            return Ok(self.records.try_iter().collect());
        }
        let left_ns = until_ns.saturating_sub(self.now_ns()?).max(0) as u64;
        let wait = Duration::from_nanos(left_ns).min(LATENESS);
        // In slices, so that Ctrl-C is seen; at the end, what was under way has time to arrive.
        let wait = if left_ns == 0 { LATENESS } else { wait };
        match self.records.recv_timeout(wait) {
            Ok(first) => Ok(std::iter::once(first).chain(self.records.try_iter()).collect()),
            Err(RecvTimeoutError::Timeout) => Ok(Vec::new()),
            Err(RecvTimeoutError::Disconnected) => Err(self.over()),
        }
    }
}

impl Drop for OnDevice {
    fn drop(&mut self) {
        self.orders = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn error(error: LiveError) -> Error {
    match error {
        LiveError::Device(error) => error.into(),
        other => Error::argument(other),
    }
}

/// The thread: turn after turn, until nobody gives orders any more.
fn run(
    device: &OpenDevice,
    live: &Live,
    orders: &Receiver<Order>,
    passed: &Sender<TraceRecord>,
) -> Result<(), LiveError> {
    let mut run = live.start(device);
    let mut records = device.records();
    loop {
        loop {
            match orders.try_recv() {
                Ok(order) => follow(device, &mut run, order),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    run.finish();
                    return Ok(device.stop().map(drop)?);
                }
            }
        }
        let wait = run.turn()?;
        let Some(batch) = records.next_batch(wait.min(TURN))? else { return Ok(()) };
        for record in batch {
            // If nobody takes them any more, the orders end, too.
            let _ = passed.send(run.take_record(record)?);
        }
    }
}

/// Whoever has asked and does not wait any more needs no answer.
fn follow(device: &OpenDevice, run: &mut LiveRun<'_>, order: Order) {
    match order {
        Order::Add(script, answer) => drop(answer.send(run.add(&script).map_err(LiveError::from))),
        Order::End(node, answer) => drop(answer.send(run.end(node))),
        Order::Send(channel, frame, answer) => drop(answer.send(run.send(channel, frame))),
        Order::Repeat(handle, repeated, answer) => drop(answer.send(run.repeat(handle, repeated))),
        Order::Now(answer) => {
            let now = device.time().map(|ticks| device.clock_map().utc(Ticks(ticks)).0);
            drop(answer.send(now.map_err(LiveError::from)));
        }
        Order::Messages(answer) => drop(answer.send(Ok(run.take_messages()))),
        Order::Errors(answer) => drop(answer.send(Ok(run.errors()))),
    }
}
