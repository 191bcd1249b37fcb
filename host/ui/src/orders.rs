//! What pages ask for, done or refused.

use anyhow::{Context, bail};
use cantap::Channel;
use cantap::wire::message::{Mode, Role};
use cantap::wire::record::ErrorState;
use cantap_signals::named::NamedFilter;
use cantap_trace::filter::Filter;
use cantap_work::advice;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::live::Lines;
use cantap_work::requested_rate::RequestedRate;
use serde_json::{Value, json};

use crate::bus::Bus;
use crate::device::Device;
use crate::request::{Only, Request};
use crate::shared::Order;
use crate::state::ChannelState;
use crate::visits::Visit;
use crate::{recorder, sender};

/// Below this no controller works, in bit/s.
const LEAST_BITRATE: u32 = 1000;
/// Most letters of a reason for whoever runs the server: it may have the page's own text in it.
const MOST_REASON: usize = 300;
/// More filters than anybody needs.
const MOST_FILTERS: usize = 64;

impl Bus {
    /// Does what a page asks for, and tells whoever runs the server.
    pub(crate) fn obey(&mut self, order: Order) {
        let Order { request, page, answer } = order;
        let what = request.to_string();
        let result = self.check(page.role, &request).and_then(|()| self.follow(request));
        let result = result.map_err(|error| advice::sentence(&error));
        let visit = match &result {
            Ok(_) => Visit::Asked(what),
            Err(reason) => Visit::NotDone(format!("{what}: {reason:.MOST_REASON$}")),
        };
        (self.visits)(&page.name, visit);
        // The page may have gone.
        let _ = answer.try_send(result);
    }

    /// Whether a page with this role may ask for it.
    fn check(&self, role: Role, request: &Request) -> anyhow::Result<()> {
        let needs = request.needs();
        if role < needs {
            let (command, option) = (self.device.command(), self.device.option(needs));
            bail!("pages of this server may only {role}; start it with {command} {option}");
        }
        Ok(())
    }

    fn follow(&mut self, request: Request) -> anyhow::Result<Value> {
        match request {
            Request::Record { name, only } => {
                if let Some(recording) = self.shared.state().recording {
                    bail!("{} is being recorded; stop that first", recording.name);
                }
                let Device { folder, decoder, .. } = &self.device;
                let folder = folder.as_ref().context(
                    "this server records nothing for pages; save what the page has, or use cantap capture",
                )?;
                self.recording = Some(recorder::create(folder, &name, only.as_ref(), decoder)?);
                self.note(match only {
                    Some(Only { around, .. }) => format!("{name} begins when {around}"),
                    None => format!("recording to {name}"),
                });
                self.show_figures();
            }
            Request::StopRecording {} => self.stop_recording(),
            Request::Bitrate { channel, bitrate } => self.set_bitrate(channel, bitrate)?,
            Request::Filters { filters } => {
                if filters.len() > MOST_FILTERS {
                    bail!("{} filters are too many; give at most {MOST_FILTERS}", filters.len());
                }
                let filters = filters.iter().map(|text| self.filter(text)).collect::<anyhow::Result<_>>()?;
                self.reconnect(self.device.open.clone(), filters)?;
            }
            Request::Mode { normal, confirmed } => self.set_mode(normal, confirmed)?,
            Request::Send { channel, frame } => {
                let lines = self.sending_lines()?;
                sender::send(lines, channel, sender::frame(&self.device.decoder, channel, &frame)?)?;
            }
            Request::Periodic { channel, frame, period_ms, modifiers } => {
                let lines = self.sending_lines()?;
                let frame = sender::frame(&self.device.decoder, channel, &frame)?;
                let entries = self.shared.state().periodic;
                let entry = sender::start(lines, &entries, channel, frame, period_ms, &modifiers)?;
                let slot = entry.slot;
                self.shared.change(|state| state.periodic.push(entry));
                return Ok(json!({ "slot": slot }));
            }
            Request::StopPeriodic { channel, slot } => {
                let lines = self.lines.as_ref().context("no device is open")?;
                sender::stop(lines, channel, slot)?;
                self.shared.change(|state| {
                    state.periodic.retain(|entry| (entry.channel, entry.slot) != (channel, slot));
                });
            }
            Request::Recover {} => self.recover()?,
            Request::AskVehicle { on: false } => {
                self.vehicle.leave();
                self.show_vehicle();
            }
            Request::AskVehicle { .. } => {
                self.sending_lines()?;
                let first = self.lines.iter().flat_map(Lines::devices).find(|(board, _)| *board == 0);
                let (_, device) = first.context("the first device is away; a vehicle is asked through it")?;
                self.vehicle.begin(device)?;
                self.show_vehicle();
            }
        }
        Ok(json!({}))
    }

    /// A filter as the command takes it, with the databases' names of messages.
    fn filter(&self, text: &str) -> anyhow::Result<Filter> {
        let named = text.parse::<NamedFilter>().map_err(|error| anyhow::anyhow!("{error}"))?;
        Ok(named.resolve(&self.device.decoder)?)
    }

    /// The devices, if they may send now.
    fn sending_lines(&self) -> anyhow::Result<&Lines> {
        if !self.shared.state().is_normal {
            bail!(
                "the channels only listen; choose normal mode first, in which they take part in their buses"
            );
        }
        self.lines.as_ref().context("no device is open")
    }

    fn set_mode(&mut self, normal: bool, confirmed: bool) -> anyhow::Result<()> {
        let mode = if normal {
            if !confirmed {
                bail!(
                    "normal mode acknowledges frames and takes part in the bus; the user has to confirm it"
                );
            }
            Mode::Normal
        } else {
            Mode::ListenOnly
        };
        if normal == self.shared.state().is_normal {
            return Ok(());
        }
        let open = ChannelOptions { mode: Some(mode), ..self.device.open.clone() };
        self.reconnect(open, self.device.filters.clone())?;
        self.note(if normal { "the channels take part in their buses" } else { "the channels only listen" });
        Ok(())
    }

    /// Another bit rate for a channel, in bit/s, or the one that is found by listening.
    fn set_bitrate(&mut self, channel: u8, bitrate_bps: Option<u32>) -> anyhow::Result<()> {
        let state = self.shared.state();
        if let Some(bitrate_bps) = bitrate_bps
            && bitrate_bps < LEAST_BITRATE
        {
            bail!("{bitrate_bps} bit/s is no bit rate of a bus; give for example 500000");
        }
        if state.channels.iter().all(|open| open.channel != channel) {
            bail!("channel {channel} is not open; choose one that is");
        }
        let mut open = self.at_rates(&state.channels);
        open.timing.set_bit_rate_of(RequestedRate { channel: Some(channel), bitrate_bps });
        // The user has agreed to take part at another bit rate.
        open.mode = Some(Mode::ListenOnly);
        self.reconnect(open, self.device.filters.clone())?;
        let listens = if state.is_normal { ", and all channels only listen now" } else { "" };
        let now = self.shared.state().channels.into_iter().find(|open| open.channel == channel);
        match now {
            Some(ChannelState { bitrate: Some(bitrate_bps), .. }) => {
                self.note(format!("channel {channel} is at {bitrate_bps} bit/s{listens}"));
            }
            _ => self.note(format!("channel {channel} is away{listens}")),
        }
        Ok(())
    }

    fn recover(&self) -> anyhow::Result<()> {
        let lines = self.sending_lines()?;
        let mut recovered = 0;
        for (_, device) in lines.devices() {
            let status = device.status()?;
            for (channel, state) in Channel::ALL.into_iter().zip(&status.channels) {
                if state.open.is_some() && state.state == ErrorState::BusOff {
                    device.recover(channel)?;
                    recovered += 1;
                }
            }
        }
        if recovered == 0 {
            bail!("no channel is bus-off");
        }
        Ok(())
    }
}
