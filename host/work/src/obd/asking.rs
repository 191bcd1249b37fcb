//! Asks a vehicle again and again without ever waiting: whoever has the device passes on its records and calls [`Asking::go_on`] often.
//!
//! One frame is on its way at a time, so that no more than that is left to send when it is to end. Frames of ours that never get onto the bus are
//! taken back.

use std::collections::VecDeque;
use std::fmt::Write as _;
use std::time::{Duration, Instant};

use cantap::wire::message::{Refusal, TxFrame};
use cantap::wire::record::ErrorState;
use cantap::{Channel, Device, DeviceError, Frame, TraceEvent, TraceRecord};
use cantap_protocols::active::Machine as _;
use cantap_protocols::active::exchange::{Exchange, ServerAnswer};
use cantap_protocols::diagnostics::Diagnostics;
use cantap_protocols::{Assembler as _, Event};
use cantap_trace::counted;

use super::{Vehicle, is_answer};
use crate::terms::failure_text;
use crate::uds::TransferOptions;

/// The tag of our frames: the scripts' are below.
const TAG: u32 = 1 << 24;
/// Trouble codes are asked for once in so many rounds: they change seldom.
const ROUNDS_PER_CODES: u64 = 20;
/// How long a frame may take to get onto the bus: the vehicle's own traffic may be before it.
const PATIENCE: Duration = Duration::from_secs(3);

/// How the asking is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum AskingState {
    /// Nothing is asked.
    #[default]
    Off,
    /// Who answers is being found out.
    Searching {
        /// The channel.
        channel: Channel,
    },
    /// Values are being asked for.
    Asking {
        /// The channel.
        channel: Channel,
        /// Where the ECUs answer from, as text.
        ecus: String,
        /// How many parameters they have.
        parameters: usize,
        /// Those that no ECU has answered the last time, as text.
        silent: String,
        /// Another tester asks the same ECUs: its answers are shown, too.
        is_shared: bool,
    },
    /// It has ended by itself, for this reason.
    Ended(String),
}

impl AskingState {
    /// Whether something is asked.
    pub const fn is_on(&self) -> bool {
        matches!(self, Self::Searching { .. } | Self::Asking { .. })
    }

    /// In a sentence.
    pub fn sentence(&self) -> String {
        match self {
            Self::Off => "Nothing is asked.".to_owned(),
            Self::Searching { channel } => {
                format!("Asking on channel {} who is there (7DF, 18DB33F1).", channel.number())
            }
            Self::Asking { channel, ecus, parameters, silent, is_shared } => {
                let number = channel.number();
                let mut text =
                    format!("Asking {ecus} on channel {number}, {}", counted(*parameters, "parameter"));
                if !silent.is_empty() {
                    let _ = write!(text, "; no answer to {silent}");
                }
                if *is_shared {
                    text.push_str("; ANOTHER TESTER asks the same ECUs");
                }
                text.push('.');
                text
            }
            Self::Ended(reason) => format!("Nothing is asked any more: {reason}."),
        }
    }
}

/// What has happened, to be shown.
#[derive(Clone, Debug)]
pub enum Asked {
    /// Everything is asked once more.
    Round,
    /// An answer, or a broken one.
    Answer(Event),
    /// It is so from now on.
    State(AskingState),
}

/// What is being asked.
#[derive(Clone, Copy, Debug)]
enum Step {
    Search,
    List,
    /// The VIN and trouble codes: the request at this place.
    Standing(usize),
    /// The parameter at this place.
    Value(usize),
    Pause {
        until_ns: u64,
    },
}

/// Asks for the VIN, trouble codes and all parameters, in rounds.
pub struct Asking {
    channel: Channel,
    /// Where else to try if nobody answers here.
    others: VecDeque<Channel>,
    p2: Duration,
    period: Duration,
    vehicle: Vehicle,
    witness: Diagnostics,
    events: Vec<Event>,
    step: Step,
    exchange: Option<Exchange>,
    parameters: Vec<u8>,
    silent: Vec<u8>,
    is_shared: bool,
    /// Frames for which the device had no room.
    waiting: VecDeque<Frame>,
    /// Frames that the device has, with when it got them.
    under_way: VecDeque<(Frame, Instant)>,
    started: Instant,
    round_ns: u64,
    /// Rounds begun.
    rounds: u64,
    asked: Vec<Asked>,
    /// Nothing new begins, but what is on its way must end.
    is_leaving: bool,
    is_over: bool,
}

impl Asking {
    /// Asks the ECUs on the first of these channels of a device on which any answers; each may take `p2` to begin its answer, and all are asked
    /// once in a `period`. Channels must be open in a mode that transmits.
    pub fn new(channels: impl IntoIterator<Item = Channel>, p2: Duration, period: Duration) -> Option<Self> {
        let mut others: VecDeque<Channel> = channels.into_iter().collect();
        let channel = others.pop_front()?;
        Some(Self {
            channel,
            others,
            p2,
            period,
            vehicle: Vehicle::new(p2),
            witness: Diagnostics::new(&[], false),
            events: Vec::new(),
            step: Step::Search,
            exchange: None,
            parameters: Vec::new(),
            silent: Vec::new(),
            is_shared: false,
            waiting: VecDeque::new(),
            under_way: VecDeque::new(),
            started: Instant::now(),
            round_ns: 0,
            rounds: 0,
            asked: vec![Asked::State(AskingState::Searching { channel })],
            is_leaving: false,
            is_over: false,
        })
    }

    fn now_ns(&self) -> u64 {
        self.started.elapsed().as_nanos() as u64
    }

    /// Whether an answer is awaited, so that records should be passed on at once.
    pub const fn is_urgent(&self) -> bool {
        self.exchange.is_some()
    }

    /// Whether nothing more will come of it.
    pub const fn is_over(&self) -> bool {
        self.is_over
    }

    /// What has happened since the last call.
    pub fn take_asked(&mut self) -> Vec<Asked> {
        std::mem::take(&mut self.asked)
    }

    /// Begins nothing any more. Call [`Self::go_on`] until [`Self::is_over`].
    pub fn leave(&mut self) {
        self.is_leaving = true;
        self.exchange = None;
        self.waiting.clear();
        self.asked.push(Asked::State(AskingState::Off));
    }

    fn end(&mut self, reason: String) {
        self.leave();
        self.asked.push(Asked::State(AskingState::Ended(reason)));
    }

    /// Takes the device's records, in order.
    pub fn take(&mut self, records: &[TraceRecord]) {
        let number = self.channel.number();
        for record in records.iter().filter(|record| record.channel == number) {
            self.record(record);
        }
    }

    fn record(&mut self, record: &TraceRecord) {
        self.witness.take(record, &mut self.events);
        let now_ns = self.now_ns();
        match record.event {
            TraceEvent::Frame { frame, .. } => {
                if let Some(place) = self.under_way.iter().position(|(own, _)| frame == *own) {
                    self.under_way.remove(place);
                    if let Some(exchange) = &mut self.exchange {
                        exchange.sent(now_ns);
                    }
                } else if let Some(exchange) = self.exchange.as_mut().filter(|_| !frame.is_remote()) {
                    exchange.hear(now_ns, frame.id(), frame.data());
                }
            }
            TraceEvent::Lost { .. } => {
                if let Some(exchange) = &mut self.exchange {
                    exchange.gap(now_ns);
                }
            }
            TraceEvent::TransmitFailed { tag: TAG, reason } if !self.is_leaving => {
                self.under_way.clear();
                self.end(format!("what was asked was not sent: {}", failure_text(reason)));
            }
            TraceEvent::State { state: ErrorState::BusOff, .. } if !self.is_leaving => {
                // By then it may be back, and send what was waiting, which nobody expects any more.
                self.end(format!("channel {} went bus-off", self.channel.number()));
            }
            _ => {}
        }
    }

    /// Sends what is to be sent now.
    ///
    /// # Errors
    /// The device refuses it, or is gone.
    pub fn go_on(&mut self, device: &Device) -> Result<(), DeviceError> {
        loop {
            self.show_answers();
            if self.under_way.front().is_some_and(|(_, since)| since.elapsed() >= PATIENCE) {
                self.give_up(device)?;
            }
            if self.is_leaving {
                self.is_over |= self.under_way.is_empty();
                return Ok(());
            }
            let now_ns = self.now_ns();
            if self.exchange.is_none() {
                self.exchange = self.begin(now_ns);
            }
            let Some(exchange) = &mut self.exchange else { return Ok(()) };
            while let Some(frame) = exchange.next(now_ns) {
                self.waiting.push_back(frame);
            }
            let is_done = exchange.is_done();
            self.hand_over(device)?;
            if !is_done || !self.waiting.is_empty() || !self.under_way.is_empty() {
                return Ok(());
            }
            if let Some(exchange) = self.exchange.take() {
                self.is_shared |= exchange.rivals() > 0;
                // Whoever does not answer, or not completely, has not answered.
                let answers = exchange.finish().map(|(answers, _)| answers).unwrap_or_default();
                self.show_answers();
                self.finished(&answers, now_ns);
            }
        }
    }

    /// What is asked next, if it is time.
    fn begin(&mut self, now_ns: u64) -> Option<Exchange> {
        if let Step::Pause { until_ns } = self.step {
            if now_ns < until_ns {
                return None;
            }
            self.begin_round(now_ns);
        }
        let (request, servers) = match self.step {
            Step::Search => (self.vehicle.search()?, None),
            Step::List => self.vehicle.list().map(|(request, servers)| (request, Some(servers)))?,
            // Not each ECU has each: whoever answers within the time does.
            Step::Standing(place) => (self.standing().nth(place)?, None),
            Step::Value(place) => {
                let pid = *self.parameters.get(place)?;
                (self.vehicle.services().value(pid), Some(self.vehicle.having(pid)))
            }
            Step::Pause { .. } => return None,
        };
        let mut exchange = self.vehicle.transfer().exchange(&request);
        if let Some(servers) = servers {
            exchange.expect(servers);
        }
        Some(exchange)
    }

    fn begin_round(&mut self, now_ns: u64) {
        let has_standing = self.rounds.is_multiple_of(ROUNDS_PER_CODES);
        self.step = if has_standing { Step::Standing(0) } else { Step::Value(0) };
        self.rounds += 1;
        self.round_ns = now_ns;
        self.silent.clear();
        self.asked.push(Asked::Round);
    }

    /// The requests for trouble codes; the first time also for the VIN.
    fn standing(&self) -> impl Iterator<Item = Vec<u8>> + use<> {
        let services = self.vehicle.services();
        let [vin, ..] = services.identification();
        let vin = (self.rounds == 1).then_some(vin);
        vin.into_iter().chain(services.codes().map(|(_, request)| request.to_vec()))
    }

    fn hand_over(&mut self, device: &Device) -> Result<(), DeviceError> {
        while let Some(frame) = self.waiting.front().copied() {
            let sent = device.send(self.channel, &[TxFrame { tag: TAG, frame, at_ticks: None }]);
            match sent {
                Ok(_) => {
                    self.waiting.pop_front();
                    self.under_way.push_back((frame, Instant::now()));
                }
                Err(DeviceError::Refused { refusal: Refusal::QueueFull { .. }, .. }) => return Ok(()),
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Our frame does not get onto the bus.
    fn give_up(&mut self, device: &Device) -> Result<(), DeviceError> {
        device.abort(self.channel)?;
        self.under_way.clear();
        if !self.is_leaving && !self.try_elsewhere() {
            self.end(format!(
                "in {} s nothing that was asked got onto the bus of channel {}, and what waits to be sent there was withdrawn; check that a node is there, \
                 and the bit rate",
                PATIENCE.as_secs(),
                self.channel.number()
            ));
        }
        Ok(())
    }

    /// Begins anew on the next channel; false if nobody was found on any.
    fn try_elsewhere(&mut self) -> bool {
        if !self.vehicle.servers().is_empty() {
            return false;
        }
        let Some(channel) = self.others.pop_front() else { return false };
        (self.channel, self.vehicle, self.step) = (channel, Vehicle::new(self.p2), Step::Search);
        (self.exchange, self.witness) = (None, Diagnostics::new(&[], false));
        self.waiting.clear();
        self.asked.push(Asked::State(AskingState::Searching { channel }));
        true
    }

    fn finished(&mut self, answers: &[ServerAnswer], now_ns: u64) {
        match self.step {
            Step::Search => {
                self.vehicle.take_search(answers);
                if !self.vehicle.servers().is_empty() {
                    self.step = Step::List;
                    self.list_is_known(now_ns);
                } else if self.vehicle.search().is_none() && !self.try_elsewhere() {
                    self.end(
                        "no ECU answers, neither to 7DF nor to 18DB33F1, by OBD-II's own services or over UDS; check that the ignition is on, and the \
                         bit rate: vehicles have 500k or 250k"
                            .to_owned(),
                    );
                }
            }
            Step::List => {
                self.vehicle.take_list(answers);
                self.list_is_known(now_ns);
            }
            Step::Standing(place) => {
                let is_last = place + 1 >= self.standing().count();
                self.step = if is_last { Step::Value(0) } else { Step::Standing(place + 1) };
            }
            Step::Value(place) => {
                if answers.is_empty() {
                    self.silent.extend(self.parameters.get(place));
                }
                self.step = Step::Value(place + 1);
                if place + 1 >= self.parameters.len() {
                    let period_ns = u64::try_from(self.period.as_nanos()).unwrap_or(u64::MAX);
                    self.step = Step::Pause { until_ns: self.round_ns.saturating_add(period_ns) };
                    self.show_state();
                }
            }
            Step::Pause { .. } => {}
        }
    }

    /// Begins with the values, if there is no other list.
    fn list_is_known(&mut self, now_ns: u64) {
        if self.vehicle.list().is_some() {
            return;
        }
        self.parameters = self.vehicle.parameters().into_keys().collect();
        if self.parameters.is_empty() {
            return self.end("the ECUs answer, and have no parameters".to_owned());
        }
        self.show_state();
        self.begin_round(now_ns);
    }

    fn show_state(&mut self) {
        let ecus: Vec<_> = self.vehicle.servers().iter().map(ToString::to_string).collect();
        let silent: Vec<_> = self.silent.iter().map(|pid| format!("{pid:02X}")).collect();
        self.asked.push(Asked::State(AskingState::Asking {
            channel: self.channel,
            ecus: ecus.join(", "),
            parameters: self.parameters.len(),
            silent: silent.join(", "),
            is_shared: self.is_shared,
        }));
    }

    /// Hands out the answers to what is asked here; those about who is there are no values.
    fn show_answers(&mut self) {
        let options: TransferOptions = self.vehicle.transfer();
        let is_value =
            matches!(self.step, Step::Standing(_) | Step::Value(_) | Step::Pause { .. }) && !self.is_leaving;
        let events = self.events.drain(..);
        let own = events.filter(|event| is_value && options.is_ours(event) && is_answer(event));
        self.asked.extend(own.map(Asked::Answer));
    }
}
