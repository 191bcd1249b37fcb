//! A diagnostics client (UDS, KWP 2000, OBD-II): sends requests over a device and receives the answers.

use std::io;
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};
use cantap::DeviceError;
use cantap::wire::message::{Filter, FrameKind, Trigger};
use cantap::{Channel, Id};
use cantap_protocols::active::exchange::{Answerer, Exchange, ExchangeError, ResponseTiming, ServerAnswer};
use cantap_protocols::active::transfer::TransferSettings;
use cantap_protocols::diagnostics::{reason, uds_service};
use cantap_protocols::iso_tp::{Endpoint, Pair};
use cantap_protocols::{Event, EventKind, Party};
use cantap_trace::counted;

use crate::interrupt;
use crate::report::Reporter;
use crate::speaking::Speaking;

/// The device's reply slots, from 0 on, that may be used for flow control: all of them.
const FLOW_SLOTS: usize = 8;

/// The usual time between two "tester present": S3 of clients (ISO 14229-2, 2 s), of which servers wait 5 s.
pub const KEEP_ALIVE: Duration = Duration::from_secs(2);
/// "Tester present", not to be answered.
const TESTER_PRESENT: [u8; 2] = [0x3E, 0x80];
/// How long to wait for the refusal of a request that wants no answer: P2 of ISO 14229-2.
pub const REFUSAL: Duration = Duration::from_millis(50);

/// Whom to ask, and the parameters of transfers.
#[derive(Clone, Copy, Debug)]
pub struct TransferOptions {
    /// The identifier of requests, and that of answers.
    pub pair: Pair,
    /// Ask all ECUs at once: with 7DF, or with 18DB33F1 if the pair has 29-bit identifiers.
    pub functional: bool,
    /// How long to wait for the beginning of an answer (P2, plus delays by gateways).
    pub p2: Duration,
    /// The same after the ECU has said that its answer is pending (P2*).
    pub p2_star: Duration,
    /// Maximum time to wait for one answer, however often it is pending; also for sending a long request.
    pub patience: Duration,
    /// How long to wait for the next frame of an answer (N_Cr), and for flow control (N_Bs).
    pub frame_timeout: Duration,
    /// How often in a row the ECU's flow control may ask to wait (N_WFTmax).
    pub max_waits: u32,
    /// Minimum separation of an answer's frames (STmin), encoded as in flow control.
    pub separation: u8,
    /// Frames of an answer per flow control frame; 0 for all.
    pub block_size: u8,
    /// The byte that pads frames to eight bytes; `None` keeps them as short as possible.
    pub padding: Option<u8>,
    /// Who sends the first flow control frame of an answer.
    pub flow_control: FlowControl,
    /// How long a session that was opened may be without a request before "tester present" is sent.
    pub keep_alive: Duration,
}

/// Who sends the first flow control frame of an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlowControl {
    /// The device if the answer is longer than a frame by the standards, as a VIN; otherwise this computer.
    Auto,
    /// This computer, once it has seen that one is needed.
    Host,
    /// The device, within microseconds, after the ECU's next frame of any kind.
    Device,
}

impl TransferOptions {
    /// For OBD-II requests.
    pub fn of_obd(pair: Pair, p2: Duration, functional: bool) -> Self {
        Self {
            pair,
            functional,
            p2,
            p2_star: Duration::from_secs(5),
            patience: Duration::from_secs(30),
            frame_timeout: Duration::from_secs(1),
            max_waits: 10,
            separation: 0,
            block_size: 0,
            padding: Some(0),
            flow_control: FlowControl::Auto,
            keep_alive: KEEP_ALIVE,
        }
    }

    fn to(&self) -> Endpoint {
        let functional = |id| Endpoint { id, address: None };
        match (self.functional, self.pair.a.id.is_extended()) {
            (false, _) => self.pair.a,
            (true, false) => functional(Id::standard_truncated(0x7DF)),
            (true, true) => functional(Id::extended_truncated(0x18DB_33F1)),
        }
    }

    fn answerer(&self) -> Answerer {
        match (self.functional, self.pair.a.id.is_extended()) {
            (false, _) => Answerer::One { from: self.pair.b, flow_to: self.pair.a },
            (true, false) => Answerer::Any11Bit,
            (true, true) => Answerer::Any29Bit { tester: 0xF1 },
        }
    }

    /// Whether an event is from our conversation: others may ask other ECUs meanwhile.
    pub fn is_ours(&self, event: &Event) -> bool {
        let is = |party: Party, endpoint: Endpoint| party == endpoint.into();
        match event.kind {
            EventKind::Exchange | EventKind::Refusal | EventKind::Request => is(event.from, self.to()),
            // A broken transfer is shown from its sender.
            EventKind::Broken if self.functional => true,
            EventKind::Broken => is(event.from, self.pair.a) || is(event.from, self.pair.b),
            _ => false,
        }
    }

    /// The client for a request.
    pub fn exchange(&self, request: &[u8]) -> Exchange {
        // Bounded so that deadlines can be added to it.
        let ns = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX).min(u64::MAX / 4);
        let settings = TransferSettings {
            padding: self.padding,
            block_size: self.block_size,
            separation: self.separation,
            flow_timeout_ns: ns(self.frame_timeout),
            next_timeout_ns: ns(self.frame_timeout),
            most_waits: self.max_waits,
        };
        let timing = ResponseTiming {
            p2_ns: ns(self.p2),
            p2_star_ns: ns(self.p2_star),
            patience_ns: ns(self.patience),
        };
        Exchange::new(self.to(), self.answerer(), request.to_vec(), settings, timing)
    }
}

/// A refusal's message; `who` is `the ECU`, or one of several.
fn refusal_text(who: &str, request: &[u8], code: u8) -> String {
    let sid = request.first().copied().unwrap_or_default();
    let service = uds_service(sid).map_or_else(|| format!("service {sid:02X}"), str::to_owned);
    let advice = match code {
        0x11 | 0x7F => "; another session may know it: see --session",
        0x12 | 0x7E => "; another session may have it: see --session",
        0x13 => "; check how long the request has to be",
        0x22 => "; the ECU is not in the state for it: check ignition, engine and speed",
        0x24 => "; something has to come before it",
        0x31 => "; the ECU has no such identifier, or not in this session",
        0x33 => "; unlock it with --security and --key-command",
        0x35 => "; the key is wrong: check --key-command",
        0x36 | 0x37 => "; wait before the next try, often ten seconds or more",
        0x21 => "; try again",
        _ => "",
    };
    format!("{who} refused {service}: {} ({code:02X}){advice}", reason(code))
}

/// Sends requests.
pub struct Client<'d> {
    /// The channel.
    pub speaking: Speaking<'d>,
    options: TransferOptions,
    reporter: Reporter,
    /// Who answers requests to all, as far as known.
    servers: Vec<Endpoint>,
    /// The first refusal, or the first answer that may be somebody else's, if these do not end everything.
    refused: Option<anyhow::Error>,
    /// It was said that there is another tester.
    has_rival: bool,
    /// When the last request was over, if a session other than the default one is open.
    kept: Option<Instant>,
}

impl<'d> Client<'d> {
    /// Over a device whose channel is open.
    pub const fn new(speaking: Speaking<'d>, options: TransferOptions, reporter: Reporter) -> Self {
        Self { speaking, options, reporter, servers: Vec::new(), refused: None, has_rival: false, kept: None }
    }

    /// Who answers requests to all.
    pub fn set_servers(&mut self, servers: Vec<Endpoint>) {
        self.servers = servers;
    }

    /// Passes on the events of our conversation since the last call.
    pub fn show(&mut self) -> io::Result<()> {
        self.show_if(|_| true)
    }

    /// The same, if they are also wanted.
    pub fn show_if(&mut self, mut is_wanted: impl FnMut(&Event) -> bool) -> io::Result<()> {
        let options = self.options;
        self.speaking.show(|event| options.is_ours(event) && is_wanted(event))
    }

    /// Addresses other ECUs, or uses other parameters.
    pub const fn set_transfer(&mut self, options: TransferOptions) {
        self.options = options;
    }

    /// How long anything that an ECU waits for may take.
    pub const fn patience(&self) -> Duration {
        self.options.patience
    }

    fn channel(&self) -> Channel {
        self.speaking.channel()
    }

    /// Sends a request, and returns the answers; refusals among them are remembered for [`Self::all_agreed`].
    pub fn ask(&mut self, request: &[u8]) -> anyhow::Result<Vec<ServerAnswer>> {
        let answers = self.ask_so_many(request, None).map_err(|failure| self.explain(failure))?;
        self.note_session(request, &answers);
        Ok(answers)
    }

    /// The same, showing what was said; returns the first answer, if none is a refusal.
    ///
    /// # Errors
    ///
    /// No answer, or a refusal.
    pub fn ask_and_show(&mut self, request: &[u8]) -> anyhow::Result<ServerAnswer> {
        let asked = self.ask(request);
        self.show()?;
        let answer = first(asked?)?;
        self.all_agreed()?;
        Ok(answer)
    }

    /// Which session is open, by what was asked and answered.
    fn note_session(&mut self, request: &[u8], answers: &[ServerAnswer]) {
        let is_positive = answers.iter().any(|answer| answer.refusal().is_none());
        match request {
            [0x10, kind, ..] if is_positive => self.kept = (kind & 0x7F != 1).then(Instant::now),
            // After a reset, an ECU is in its default session.
            [0x11, ..] if is_positive => self.kept = None,
            _ if self.kept.is_some() => self.kept = Some(Instant::now()),
            _ => {}
        }
    }

    /// Waits while there is nothing to ask, and keeps the session that is open: the time ends it otherwise.
    ///
    /// # Errors
    ///
    /// The device is gone, or "tester present" cannot be sent. A refusal is remembered for [`Self::all_agreed`].
    pub fn wait(&mut self, time: Duration) -> anyhow::Result<()> {
        let until = Instant::now() + time;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let due = self.kept.map(|last| self.options.keep_alive.saturating_sub(last.elapsed()));
            if due == Some(Duration::ZERO) && !interrupt::requested() {
                self.request_only(&TESTER_PRESENT, REFUSAL.min(self.options.keep_alive / 2))?;
                // A request that may not be answered is over all the same.
                self.kept = Some(Instant::now());
                continue;
            }
            self.speaking.listen(due.map_or(left, |due| due.min(left)))?;
            if left.is_zero() || interrupt::requested() {
                return Ok(());
            }
        }
    }

    /// Like [`Self::ask`], but answers are optional.
    pub fn ask_whoever(
        &mut self,
        request: &[u8],
        servers: Option<usize>,
    ) -> anyhow::Result<Vec<ServerAnswer>> {
        let asked = self.ask_so_many(request, servers);
        self.none_is_no_failure(asked)
    }

    fn none_is_no_failure(
        &self,
        asked: Result<Vec<ServerAnswer>, Failure>,
    ) -> anyhow::Result<Vec<ServerAnswer>> {
        match asked {
            Ok(answers) => Ok(answers),
            Err(Failure::Exchange(ExchangeError::NoAnswer { .. })) => Ok(Vec::new()),
            Err(failure) => Err(self.explain(failure)),
        }
    }

    /// Like [`Self::ask_whoever`], where it is not known yet whether anybody answers at all: what looks like the beginning of an answer
    /// may be others' frames, and is only reported. A refusal is no failure of anything that was asked for, and is not remembered.
    pub fn ask_unknown(&mut self, request: &[u8]) -> anyhow::Result<Vec<ServerAnswer>> {
        let before = self.refused.take();
        let asked = self.ask_so_many(request, None);
        self.refused = before;
        if let Err(Failure::Exchange(error @ ExchangeError::Answer { .. })) = asked {
            self.reporter.note(error.to_string());
            return Ok(Vec::new());
        }
        self.none_is_no_failure(asked)
    }

    /// Sends a request that wants no answer, and waits this long for a refusal.
    pub fn request_only(&mut self, request: &[u8], wait: Duration) -> anyhow::Result<()> {
        let p2 = std::mem::replace(&mut self.options.p2, wait);
        let asked = self.ask(request);
        self.options.p2 = p2;
        asked.map(|_| ())
    }

    fn ask_so_many(&mut self, request: &[u8], servers: Option<usize>) -> Result<Vec<ServerAnswer>, Failure> {
        let mut exchange = self.options.exchange(request);
        if let Some(servers) = servers {
            exchange.expect(servers);
        }
        let slots = self.flow_by_device(&mut exchange)?;
        let ran = self.speaking.run(&mut exchange);
        for slot in 0..slots {
            let cleared = self.speaking.device().set_trigger(self.channel(), slot, None);
            cleared.map_err(|error| Failure::Other(error.into()))?;
        }
        ran.map_err(Failure::Other)?;
        self.look_for_rivals(&exchange);
        let (answers, broken) = exchange.finish().map_err(Failure::Exchange)?;
        for (from, error) in broken {
            self.reporter.note(format!("the answer of {from} broke off: {error}"));
        }
        let refusal = answers.iter().find_map(|answer| Some((answer.from, answer.refusal()?)));
        if let Some((from, code)) = refusal {
            let who = if self.options.answerer().is_many() { from.to_string() } else { "the ECU".to_owned() };
            self.refused.get_or_insert_with(|| anyhow!(refusal_text(&who, request, code)));
        }
        Ok(answers)
    }

    /// Reports that another tester asks the same ECU; its answers must not be taken for ours in silence.
    fn look_for_rivals(&mut self, exchange: &Exchange) {
        let asked = self.options.to();
        if exchange.rivals() > 0 && !std::mem::replace(&mut self.has_rival, true) {
            self.reporter.note(format!(
                "another tester asks the same ECU as {asked} at the same time; answers are compared with both requests"
            ));
        }
        if exchange.doubtful() > 0 {
            self.refused.get_or_insert_with(|| {
                anyhow!(
                    "{asked}: the answer may be to the request of another tester, which asked the same meanwhile; run this again \
                     while the other is silent"
                )
            });
        }
    }

    /// Has the device send flow control, if that is wanted. Returns how many of its reply slots are set.
    fn flow_by_device(&self, exchange: &mut Exchange) -> Result<u8, Failure> {
        let replies = match self.options.flow_control {
            FlowControl::Host => Vec::new(),
            // Of an ECU behind an address, others may be listening to the same identifier.
            FlowControl::Auto if !exchange.has_long_answer() || self.options.pair.b.address.is_some() => {
                Vec::new()
            }
            _ => exchange.device_replies(&self.servers),
        };
        let mut slots = 0;
        for (from, reply) in replies.into_iter().take(FLOW_SLOTS) {
            let extended = from.id.is_extended();
            let mask = if extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
            let filter = Filter { extended, kind: FrameKind::Data, id: from.id.raw(), mask };
            let entry = Some(Trigger { filter, reply, count: 1 });
            match self.speaking.device().set_trigger(self.channel(), slots, entry) {
                Ok(()) => exchange.flow_by_device(from),
                // Others who use the device may have all of its slots.
                Err(DeviceError::Refused { .. }) if self.options.flow_control == FlowControl::Auto => break,
                Err(error) => return Err(Failure::Other(error.into())),
            }
            slots += 1;
        }
        Ok(slots)
    }

    /// An error if anything was refused.
    pub fn all_agreed(&mut self) -> anyhow::Result<()> {
        self.refused.take().map_or(Ok(()), Err)
    }

    fn explain(&self, failure: Failure) -> anyhow::Error {
        let error = match failure {
            Failure::Other(error) => return error,
            Failure::Exchange(error) => error,
        };
        let asked = self.options.to();
        match error {
            ExchangeError::NoAnswer { others, .. } => {
                let others = match others {
                    0 => String::new(),
                    others => {
                        format!("; {} came that answer something else", counted(others as usize, "message"))
                    }
                };
                anyhow!(
                    "{asked}: {error}; {}{others}; check that the ECU is awake (ignition), the bit rate, and --pair",
                    self.speaking.circumstances()
                )
            }
            ExchangeError::Request(_) => {
                anyhow!("{asked}: {error}; {}; check --pair", self.speaking.circumstances())
            }
            _ => anyhow!("{asked}: {error}"),
        }
    }
}

enum Failure {
    Exchange(ExchangeError),
    Other(anyhow::Error),
}

/// The first answer, for callers that need at least one.
pub fn first(answers: Vec<ServerAnswer>) -> anyhow::Result<ServerAnswer> {
    match answers.into_iter().next() {
        Some(answer) => Ok(answer),
        None => bail!("nobody answered"),
    }
}
