//! Requests of a diagnostic tester, over a session that everything else goes on using.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use cantap::{Direction, Frame, TraceEvent, TraceRecord};
use cantap_protocols::active::Machine;
use cantap_protocols::active::exchange::{Exchange, ExchangeError, ServerAnswer};
use cantap_protocols::diagnostics::{reason, uds_service};
use cantap_protocols::iso_tp::Pair;
use cantap_trace::TransmitFailure;
use cantap_wire::Channel;
use cantap_work::uds::TransferOptions;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use super::Device;
use super::fanout::{Listener, SentFrames, Wanted};
use super::session::{HowToSend, Sending, Session};
use super::transmissions::NOBODY;
use super::waiting::{duration, signals};
use crate::error::Error;
use crate::grammar::{OfDevice, Seconds};

/// Records that may wait while Python handles a signal.
const CAPACITY: usize = 1 << 16;
/// How often to check for Ctrl-C, and whether what was sent has left.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// A frame that no node acknowledges for this long will not leave.
const LEAVES_WITHIN: Duration = Duration::from_secs(1);

/// Whom to ask, and how long to wait.
pub struct Request {
    /// The tester's and the ECU's identifiers.
    pub pair: Pair,
    /// All ECUs are asked at once: with 7DF, or 18DB33F1 where identifiers have 29 bits.
    pub is_to_all: bool,
    /// Service and data.
    pub data: Vec<u8>,
    /// Until the beginning of the answer.
    pub p2: Duration,
    /// The same once the ECU has said that the answer is pending.
    pub p2_star: Duration,
    /// Altogether.
    pub patience: Duration,
    /// The byte that fills frames up.
    pub padding: Option<u8>,
}

impl Request {
    fn exchange(&self) -> Exchange {
        let Self { pair, is_to_all, ref data, p2, p2_star, patience, padding } = *self;
        TransferOptions { p2_star, patience, padding, ..TransferOptions::of_obd(pair, p2, is_to_all) }
            .exchange(data)
    }

    /// Asks, and returns the answers: a refusal is one, too.
    pub fn ask(&self, session: &Session, channel: Channel) -> Result<Vec<ServerAnswer>, Error> {
        let wanted = Wanted { channel: Some(channel.number()), filters: Vec::new(), sent: SentFrames::All };
        let listener = session.fanout.listen(wanted, CAPACITY);
        let mut exchange = self.exchange();
        Conversation {
            session,
            channel,
            listener: &listener,
            started: Instant::now(),
            under_way: VecDeque::new(),
        }
        .run(&mut exchange)?;
        let rivals = exchange.doubtful();
        let (answers, broken) = exchange.finish().map_err(|error| self.explain(&error))?;
        if rivals > 0 {
            return Err(Error::Address(format!(
                "{}: the answer may be to another tester, which asked the same meanwhile; ask again while it is silent",
                self.pair
            )));
        }
        match broken.first() {
            Some((from, error)) => Err(Error::Address(format!("the answer of {from} broke off: {error}"))),
            None => Ok(answers),
        }
    }

    fn explain(&self, error: &ExchangeError) -> Error {
        let advice = match error {
            ExchangeError::NoAnswer { .. } => "; is the ECU awake (ignition), and are its identifiers right?",
            _ => "",
        };
        Error::Address(format!("{}: {error}{advice}", self.pair))
    }
}

/// A frame that was passed to the device.
struct UnderWay {
    frame: Frame,
    since: Instant,
    /// How it ended, until that is known.
    sending: Option<Sending>,
}

/// Connects a client's state to the session.
struct Conversation<'a> {
    session: &'a Session,
    channel: Channel,
    listener: &'a Listener,
    started: Instant,
    /// Frames that were not on the bus yet.
    under_way: VecDeque<UnderWay>,
}

impl Conversation<'_> {
    fn now_ns(&self) -> u64 {
        self.started.elapsed().as_nanos() as u64
    }

    fn run(&mut self, machine: &mut dyn Machine) -> Result<(), Error> {
        let result = self.run_to_its_end(machine);
        if result.is_err() && !self.under_way.is_empty() {
            // It must not surprise anyone by being sent later. If the device is gone, nothing is.
            let _ = self.session.device()?.abort(self.channel);
        }
        result
    }

    fn run_to_its_end(&mut self, machine: &mut dyn Machine) -> Result<(), Error> {
        loop {
            while let Some(frame) = machine.next(self.now_ns()) {
                let deadline = Instant::now() + LEAVES_WITHIN;
                let how = HowToSend { sender: NOBODY, at_ticks: None, is_told: true, deadline };
                let sending = Some(self.session.send(self.channel, &[frame.into()], how, signals)?);
                self.under_way.push_back(UnderWay { frame, since: Instant::now(), sending });
            }
            if machine.is_done() && self.under_way.is_empty() {
                return Ok(());
            }
            let due_ns = machine.due_ns().filter(|_| !machine.is_done());
            let left = due_ns.map_or(LOOK_EVERY, |due_ns| {
                Duration::from_nanos(due_ns.saturating_sub(self.now_ns())).min(LOOK_EVERY)
            });
            let Some(records) = self.listener.pop(left) else {
                let failure = self.listener.failure();
                return Err(Error::Address(failure.unwrap_or_else(|| "the device was closed".to_owned())));
            };
            for record in &records {
                self.take(record, machine);
            }
            self.check_under_way()?;
            if self.under_way.front().is_some_and(|first| first.since.elapsed() > LEAVES_WITHIN) {
                return Err(Error::Address(format!(
                    "the request was not sent on channel {} within {} s, and was taken back; does another node acknowledge, at the same \
                     bit rate?",
                    self.channel.number(),
                    LEAVES_WITHIN.as_secs()
                )));
            }
            signals()?;
        }
    }

    fn take(&mut self, record: &TraceRecord, machine: &mut dyn Machine) {
        let now_ns = self.now_ns();
        match record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                let own = self.under_way.iter().position(|own| frame == own.frame);
                if let (Direction::Tx, Some(place)) = (direction, own) {
                    self.under_way.remove(place);
                    machine.sent(now_ns);
                } else if !frame.is_remote() {
                    machine.hear(now_ns, frame.id(), frame.data());
                }
            }
            TraceEvent::Lost { .. } => machine.gap(now_ns),
            _ => {}
        }
    }

    /// An error if one of the frames will not be sent.
    fn check_under_way(&mut self) -> Result<(), Error> {
        for own in &mut self.under_way {
            let Some(sending) = &own.sending else { continue };
            let Some(ends) = sending.wait(Instant::now(), Duration::ZERO, || Ok(()))? else { continue };
            own.sending = None;
            if let Some(failure) = ends.iter().find_map(|end| end.result.err()) {
                return Err(Error::Address(format!(
                    "the request was not sent on channel {}: {}",
                    self.channel.number(),
                    TransmitFailure::name(failure)
                )));
            }
        }
        Ok(())
    }
}

/// Asks an ECU, or all of them: who answered, and what. `pair` is `7E0:7E8`; times are P2, P2* and for everything, in seconds.
#[expect(clippy::too_many_arguments, reason = "what Python's half passes, each by its name")]
#[pyfunction]
fn ask_ecu<'py>(
    py: Python<'py>,
    device: Py<Device>,
    number: OfDevice,
    pair: &str,
    is_to_all: bool,
    data: Vec<u8>,
    times: (Seconds, Seconds, Seconds),
    padding: Option<u8>,
) -> PyResult<Vec<(String, Bound<'py, PyBytes>)>> {
    let session = device.get().session()?;
    let (p2, p2_star, patience) = (duration(times.0)?, duration(times.1)?, duration(times.2)?);
    let pair = pair.parse::<Pair>().map_err(Error::argument)?;
    if data.is_empty() {
        return Err(Error::argument("a request has at least one byte, its service").into());
    }
    let request = Request { pair, is_to_all, data, p2, p2_star, patience, padding };
    let answers = py.detach(|| request.ask(&session, number.0))?;
    Ok(answers.into_iter().map(|answer| (answer.from.to_string(), PyBytes::new(py, &answer.data))).collect())
}

/// What a negative response to a request stands for: the service's name, and the reason.
#[pyfunction]
fn refusal_text(service: u8, code: u8) -> (String, &'static str) {
    let name = uds_service(service).map_or_else(|| format!("service {service:02X}"), str::to_owned);
    (name, reason(code))
}

/// Adds the functions to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(ask_ecu, module)?)?;
    module.add_function(wrap_pyfunction!(refusal_text, module)?)
}
