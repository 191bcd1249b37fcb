//! Changes the device, bit rates, or mode.

use cantap::wire::message::Mode;
use cantap_address::{Address, AddressError};
use cantap_analysis::stats::Statistics;
use ratatui::crossterm::event::KeyCode;

use super::super::model::{LOAD_WINDOW, Model};
use super::super::order::Order;
use super::super::plan::Plan;
use super::line::PromptKind;
use super::state::{App, View};
use cantap_work::advice;
use cantap_work::requested_rate::RequestedRate;

impl App {
    /// Switches between listen-only and taking part, after asking: acknowledging changes the bus.
    pub(super) fn toggle_mode(&mut self) {
        match &self.plan {
            None => "a file has no mode".clone_into(&mut self.message),
            Some(plan) if plan.mode().transmits() => self.set_mode(Mode::ListenOnly),
            Some(_) => self.ask(PromptKind::Normal, ""),
        }
    }

    /// The answer to whether to take part: one key. Only a clear yes counts, and what is neither yes nor no is asked again.
    pub(super) fn answer_normal(&mut self, code: KeyCode) {
        match code {
            KeyCode::Char('y' | 'Y') => {
                self.prompt = None;
                self.set_mode(Mode::Normal);
                if self.view == View::Obd {
                    self.order(Order::Ask(true));
                }
            }
            KeyCode::Char('n' | 'N') | KeyCode::Esc | KeyCode::Enter => {
                self.prompt = None;
                "it stays listen-only".clone_into(&mut self.message);
            }
            _ => {}
        }
    }

    fn set_mode(&mut self, mode: Mode) {
        let Some(plan) = &mut self.plan else { return };
        plan.open.mode = Some(mode);
        let order = Order::Open(plan.clone());
        self.order(order);
    }

    pub(super) fn ask_bit_rate(&mut self, model: &Model) {
        let Some(plan) = &self.plan else {
            "a file has no bit rate; start with -b for the load".clone_into(&mut self.message);
            return;
        };
        let rates: Vec<_> = plan
            .channels
            .iter()
            .filter_map(|number| Some(format!("{number}:{}", model.options().bitrate_of(*number)?)))
            .collect();
        self.ask(PromptKind::BitRate, &rates.join(" "));
    }

    pub(super) fn set_bit_rates(&mut self, text: &str, model: &Model) -> Result<(), String> {
        let Some(plan) = &self.plan else {
            return Ok(());
        };
        let rates =
            text.split_whitespace().map(str::parse::<RequestedRate>).collect::<Result<Vec<_>, _>>()?;
        if rates.is_empty() {
            return Err("give a bit rate, such as 500k, one for each channel: 1:500k 2:250k, or auto to find it by listening".to_owned());
        }
        let mut plan = plan.clone();
        plan.set_bit_rates(rates);
        plan.open.timing.check_channels(plan.addresses.len()).map_err(|error| error.to_string())?;
        // A device that runs is not given up for what it would refuse.
        for (board, device) in model.seen.devices.iter().enumerate() {
            let timing = plan.open.timing.on_board(board);
            for channel in plan.channels_of(board) {
                let request = timing.request(channel).map_err(|error| error.to_string())?;
                if let (Some(request), Some(can_clock_hz)) = (request, device.can_clock_hz) {
                    request.resolve(can_clock_hz).map_err(|error| advice::explained(&error))?;
                }
            }
        }
        self.open(plan, model)
    }

    pub(super) fn set_device(&mut self, text: &str, model: &Model) -> Result<(), String> {
        let addresses = text.split(" + ").map(|address| address.trim().parse::<Address>());
        let addresses =
            addresses.collect::<Result<Vec<_>, _>>().map_err(|error: AddressError| error.to_string())?;
        let plan = match &self.plan {
            Some(plan) => plan.at(addresses),
            None => Plan::listening(addresses, model.options()),
        };
        self.open(plan, model)
    }

    /// Opens another device, or other bit rates: what the user agreed to before concerned another bus, so it only listens.
    fn open(&mut self, mut plan: Plan, model: &Model) -> Result<(), String> {
        if plan.mode() != Mode::ListenOnly {
            plan.open.mode = Some(Mode::ListenOnly);
            "listen-only now; m takes part in the bus".clone_into(&mut self.message);
        }
        let options =
            cantap_analysis::stats::Options { window: LOAD_WINDOW, ..plan.options(model.options()) };
        Statistics::new(options).map_err(|error| error.to_string())?;
        self.plan = Some(plan.clone());
        self.order(Order::Open(plan));
        Ok(())
    }
}
