//! Another device, other bit rates, another mode.

use cantap::wire::message::Mode;
use cantap_analysis::stats::Statistics;

use super::super::model::{LOAD_WINDOW, Model};
use super::super::source::{Order, Plan};
use super::line::PromptKind;
use super::state::App;
use crate::address::{Address, AddressError};
use crate::channel_bitrate::ChannelBitrate;

impl App {
    /// Between listen-only and taking part.
    pub(super) fn toggle_mode(&mut self) {
        let Some(plan) = &mut self.plan else {
            "a file has no mode".clone_into(&mut self.message);
            return;
        };
        let other = if plan.mode().transmits() { Mode::ListenOnly } else { Mode::Normal };
        plan.open.set_mode(other);
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
            .filter_map(|channel| {
                let number = channel.number();
                Some(format!("{number}:{}", model.options().bitrate_of(number)?))
            })
            .collect();
        self.ask(PromptKind::BitRate, &rates.join(" "));
    }

    pub(super) fn set_bit_rates(&mut self, text: &str, model: &Model) -> Result<(), String> {
        let Some(plan) = &self.plan else {
            return Ok(());
        };
        let rates =
            text.split_whitespace().map(str::parse::<ChannelBitrate>).collect::<Result<Vec<_>, _>>()?;
        if rates.is_empty() {
            return Err("give a bit rate, such as 500k, or one for each channel: 1:500k 2:250k".to_owned());
        }
        let mut plan = plan.clone();
        plan.set_bit_rates(rates);
        plan.open.timing.check_channels().map_err(|error| error.to_string())?;
        self.open(plan, model)
    }

    pub(super) fn set_device(&mut self, text: &str, model: &Model) -> Result<(), String> {
        let address: Address = text.parse().map_err(|error: AddressError| error.to_string())?;
        let plan = match &self.plan {
            Some(plan) => Plan { address, ..plan.clone() },
            None => Plan::listening(address, model.options()),
        };
        self.open(plan, model)
    }

    fn open(&mut self, plan: Plan, model: &Model) -> Result<(), String> {
        let options =
            cantap_analysis::stats::Options { window: LOAD_WINDOW, ..plan.options(model.options()) };
        Statistics::new(options).map_err(|error| error.to_string())?;
        self.plan = Some(plan.clone());
        self.order(Order::Open(plan));
        Ok(())
    }
}
