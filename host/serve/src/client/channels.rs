//! A client's channels: opening, sharing with others who have them open, and closing. Also its filters, and what it
//! stores.

use std::time::{Duration, Instant};

use cantap::device::channel_number;
use cantap_wire::message::{ChannelConfig, Filter, FrameKind, Mode, Role};
use cantap_wire::{Channel, Command, Refusal, Reply};

use super::Client;
use crate::News;
use crate::shared::only_listens;
use crate::state::{State, Then, for_all};

/// What a board captured before it was asked for its time has arrived by this time.
const SETTLE_TIMEOUT: Duration = Duration::from_millis(30);

/// How a client can get a channel.
enum Way {
    /// It is open as the client wants it.
    Attach(ChannelConfig),
    /// It is closed.
    Open,
    /// It is open, and may be opened again.
    Reopen(ChannelConfig),
}

impl Client {
    pub(super) fn is_open(&self, channel: Channel) -> bool {
        self.with(|_, member| member.views[channel.index()].config.is_some())
    }

    pub(super) fn open(&self, channel: Channel, config: Option<ChannelConfig>) -> Result<Reply, Refusal> {
        if self.is_open(channel) {
            return Err(Refusal::ChannelOpen);
        }
        let base = self.shared.state().base[channel.index()];
        let wanted = match config.or(base) {
            Some(config) => config,
            None => match self.shared.ask(Command::Defaults { channel }, Then::Nothing)? {
                Reply::Defaults(saved) => saved.config,
                _ => return Err(Refusal::NothingSaved),
            },
        };
        self.must_be_permitted(Role::Listen, |permit, number| {
            permit.channel(channel_number(number, channel))?;
            permit.mode(wanted.mode)
        })?;
        let way = self.way(channel, &wanted)?;
        let then = || Then::Opened { client: Some((self.id, wanted)), channel };
        let config = Some(self.shared.on_board(channel, wanted));
        match way {
            Way::Attach(current) => {
                let given = ChannelConfig { timing: current.timing, ..wanted };
                self.shared.state().attach(self.id, channel, given);
                return Ok(Reply::Opened(given));
            }
            Way::Open => {
                self.shared.ask(Command::Open { channel, config }, then())?;
            }
            Way::Reopen(before) => {
                self.shared.close_channel(channel, None)?;
                if let Err(refusal) = self.shared.ask(Command::Open { channel, config }, then()) {
                    self.shared.reopen_channel(channel, before)?;
                    return Err(refusal);
                }
                let others = self.shared.state().listeners(self.id, channel);
                if others > 0 {
                    self.shared.tell(News::OffBus { client: Some(self.name.clone()), channel, others });
                }
            }
        }
        Ok(Reply::Opened(wanted))
    }

    /// How the client can get the channel as it wants it, if it may.
    fn way(&self, channel: Channel, wanted: &ChannelConfig) -> Result<Way, Refusal> {
        let mut state = self.shared.state();
        let (any_other, other_sends) = state.others_on(self.id, channel);
        let (base, current) = (state.base[channel.index()], state.open[channel.index()]);
        let is_base = base.is_some_and(|base| base.timing == wanted.timing);
        if !only_listens(wanted) {
            self.must_be(Role::Send)?;
        }
        // A client that may only listen accepts the existing bit rate. Only one that chooses another configures.
        let hold = |state: &mut State| {
            let other = base.is_some() && self.role < Role::Configure;
            state
                .hold(self.id, &[channel])
                .map_err(|refusal| if other { Refusal::OtherSettings } else { refusal })
        };
        let Some(current) = current else {
            if !is_base {
                hold(&mut state)?;
            }
            return Ok(Way::Open);
        };
        let is_same = current.timing == wanted.timing;
        // Whoever listens would hear nothing of the bus, and be told of no loss.
        if any_other && hears_bus(wanted.mode) != hears_bus(current.mode) {
            return Err(Refusal::OtherSettings);
        }
        if is_same && (only_listens(wanted) || for_all(*wanted) == current) {
            return Ok(Way::Attach(current));
        }
        // Others' stamps and loads are computed with the timing they know, and senders rely on their mode.
        if (any_other && !is_same) || other_sends {
            return Err(Refusal::OtherSettings);
        }
        if !is_same {
            hold(&mut state)?;
        }
        Ok(Way::Reopen(current))
    }

    /// Closes a channel for this client. If nobody else has it open, the board closes it; if nobody else sends, it goes back to only
    /// listening, after a while, because the next sender would take it off the bus again.
    pub(super) fn close(&self, channel: Channel) -> Result<(), Refusal> {
        self.clear_budget(channel);
        if !self.is_open(channel) {
            return Ok(());
        }
        let sends = self.with(|_, member| member.views[channel.index()].transmits());
        let (any_other, other_sends) = self.shared.state().others_on(self.id, channel);
        if sends && any_other {
            self.clear_entries(channel);
            self.withdraw(channel, true)?;
        }
        let current = self.shared.state().open[channel.index()];
        let closed = match current {
            _ if !any_other => self.shared.close_channel(channel, Some(self.id)),
            Some(current) if sends && !other_sends => {
                let listening = self.shared.on_board(channel, ChannelConfig::listen_only(current.timing));
                if listening == current {
                    self.settle()
                } else if current.mode == Mode::Normal && !self.shared.settings.keep_mode.is_zero() {
                    let settled = self.settle();
                    self.shared.state().kept[channel.index()] = Some(Instant::now());
                    settled
                } else {
                    // In any other mode, those who listen do not hear the bus.
                    let closed = self.shared.close_channel(channel, Some(self.id));
                    self.shared.state().detach(self.id, channel);
                    closed.and_then(|()| self.shared.reopen_channel(channel, listening))
                }
            }
            _ => self.settle(),
        };
        self.shared.state().detach(self.id, channel);
        closed
    }

    /// Waits for everything that the board has captured so far.
    fn settle(&self) -> Result<(), Refusal> {
        if let Reply::Time(ticks) = self.shared.ask(Command::Time, Then::Nothing)? {
            self.shared.wait_for(SETTLE_TIMEOUT, |state| state.latest_ticks >= ticks);
        }
        Ok(())
    }

    /// Filters are applied by the server: each client has its own, and the board receives for all.
    pub(super) fn set_filters(&self, channel: Channel, filters: &[Filter]) -> Result<Reply, Refusal> {
        if !filters.iter().all(Filter::is_valid) {
            return Err(Refusal::BadId);
        }
        let mut state = self.shared.state();
        let banks_total = state.hello.as_ref().map_or(0, |hello| hello.filter_banks);
        let Some(member) = state.clients.get_mut(&self.id) else { return Err(Refusal::NoSession) };
        let view = &mut member.views[channel.index()];
        if view.config.is_some() {
            return Err(Refusal::ChannelOpen);
        }
        view.filters = filters.to_vec();
        Ok(Reply::Filters { banks_used: banks_of(filters).min(banks_total), banks_total })
    }

    /// Stores the client's configuration, including its filters, which the board otherwise does not have.
    pub(super) fn save_defaults(&self) -> Result<Reply, Refusal> {
        let _setup = self.setup();
        self.shared.state().hold(self.id, &Channel::ALL)?;
        let filters = self.with(|_, member| Some(member.views.clone())).ok_or(Refusal::NoSession)?;
        for (channel, view) in Channel::ALL.into_iter().zip(&filters) {
            let filters = heapless::Vec::from_slice(&view.filters).map_err(|_| Refusal::Malformed)?;
            self.shared.ask(Command::SetFilters { channel, filters }, Then::Nothing)?;
        }
        let saved = self.shared.ask(Command::SaveDefaults, Then::Nothing);
        for channel in Channel::ALL {
            let filters = heapless::Vec::new();
            self.shared.ask(Command::SetFilters { channel, filters }, Then::Nothing)?;
        }
        saved
    }
}

/// Whether a controller receives what others send.
const fn hears_bus(mode: Mode) -> bool {
    matches!(mode, Mode::ListenOnly | Mode::Normal)
}

/// Banks that filters would need on the board (docs/wire-protocol.md).
fn banks_of(filters: &[Filter]) -> u8 {
    let is_exact = |filter: &&Filter| {
        let all = if filter.extended { cantap_wire::Id::MAX_EXTENDED } else { cantap_wire::Id::MAX_STANDARD };
        filter.mask == all && filter.kind != FrameKind::Any
    };
    let count = |extended: bool, exact: bool| {
        filters.iter().filter(|filter| filter.extended == extended && is_exact(filter) == exact).count()
    };
    let banks = count(true, false)
        + count(true, true).div_ceil(2)
        + count(false, false).div_ceil(2)
        + count(false, true).div_ceil(4);
    banks.clamp(1, usize::from(u8::MAX)) as u8
}
