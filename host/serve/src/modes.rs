//! The board's channels: opening and closing them for all who share them. A controller can change its mode only off the bus, and whoever
//! listens misses what is on the bus meanwhile; so a mode that was needed for sending is kept for a while.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use cantap_wire::message::{ChannelConfig, Mode};
use cantap_wire::{Channel, Command, Refusal};

use crate::News;
use crate::lock::lock;
use crate::shared::{Shared, only_listens};
use crate::state::{State, Then, for_all};
use crate::stream::ClientId;

/// A channel being closed has delivered its last record by this time.
const STOP_TIMEOUT: Duration = Duration::from_secs(1);
/// How often to check whether a mode was kept for long enough.
const LOOK_EVERY: Duration = Duration::from_millis(50);

impl Shared {
    /// How a channel is opened on the board for a client that wants it so.
    pub fn on_board(&self, channel: Channel, wanted: ChannelConfig) -> ChannelConfig {
        let config = for_all(wanted);
        // At another bit rate it would destroy frames.
        let is_base = self.state().base[channel.index()].is_some_and(|base| base.timing == wanted.timing);
        let joins = self.settings.always_acknowledges && is_base && only_listens(&config);
        if joins { ChannelConfig { mode: Mode::Normal, ..config } } else { config }
    }

    /// Closes a channel on the board and waits for everything it had to report. `closing` is the client that closes it; others that have it
    /// open see a gap from there on.
    pub fn close_channel(&self, channel: Channel, closing: Option<ClientId>) -> Result<(), Refusal> {
        let stopped = |state: &State| state.stops[channel.index()];
        let before = {
            let mut state = self.state();
            state.closing[channel.index()] = closing;
            stopped(&state)
        };
        let closed = self.ask(Command::Close { channel }, Then::Nothing);
        if closed.is_ok() {
            // If it never reports that, the link has lost the record.
            self.wait_for(STOP_TIMEOUT, |state| stopped(state) != before || state.hello.is_none());
        }
        let mut state = self.state();
        state.closing[channel.index()] = None;
        closed?;
        state.open[channel.index()] = None;
        state.kept[channel.index()] = None;
        Ok(())
    }

    /// Opens a channel again for those who have it open.
    pub fn reopen_channel(&self, channel: Channel, config: ChannelConfig) -> Result<(), Refusal> {
        let opened =
            self.ask(Command::Open { channel, config: Some(config) }, Then::Opened { client: None, channel });
        if opened.is_err() {
            // They must not believe that the bus is quiet.
            self.end_session("it does not open a channel again");
        }
        opened.map(|_| ())
    }

    /// Goes back to listening on a channel, if it was kept open for sending for long enough and nobody sends on it.
    fn listen_again(&self, channel: Channel) {
        let is_due = |state: &State| {
            let kept = state.kept[channel.index()];
            kept.is_some_and(|since| since.elapsed() >= self.settings.keep_mode)
        };
        if !is_due(&self.state()) {
            return;
        }
        let _setup = lock(&self.setup);
        let mut state = self.state();
        let (any, senders) = state.others_on(NOBODY, channel);
        let current = state.open[channel.index()];
        let Some(current) = current.filter(|_| is_due(&state) && any && !senders) else {
            if is_due(&state) {
                state.kept[channel.index()] = None;
            }
            return;
        };
        drop(state);
        let config = self.on_board(channel, ChannelConfig::listen_only(current.timing));
        // If the board does not respond, its thread notices.
        if self.close_channel(channel, None).is_ok() && self.reopen_channel(channel, config).is_ok() {
            let others = self.state().listeners(NOBODY, channel);
            self.tell(News::OffBus { client: None, channel, others });
        }
    }
}

/// No client has this number.
const NOBODY: ClientId = 0;

/// The body of a thread that ends with the board's.
pub fn run(shared: &Arc<Shared>) {
    while !shared.quit.load(Ordering::Relaxed) {
        for channel in Channel::ALL {
            shared.listen_again(channel);
        }
        std::thread::sleep(LOOK_EVERY);
    }
}
