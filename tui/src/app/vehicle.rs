//! The page on which a vehicle is asked by OBD-II. Asking is sending: it begins when the page is opened by its key or tab, and ends when it is left.

use super::super::model::Model;
use super::super::order::Order;
use super::line::PromptKind;
use super::state::{App, View};

impl App {
    /// Opens the page, and asks; where the view only listens, whether to take part in the bus comes first.
    pub(super) fn open_vehicle(&mut self, model: &Model) {
        self.show(View::Obd);
        if !model.vehicle.state.is_on() {
            self.begin_asking();
        }
    }

    /// Asks, or no more.
    pub(super) fn toggle_asking(&mut self, model: &Model) {
        if model.vehicle.state.is_on() {
            self.order(Order::Ask(false));
        } else {
            self.begin_asking();
        }
    }

    fn begin_asking(&mut self) {
        match &self.plan {
            None => "a file answers nothing; open a device with D".clone_into(&mut self.message),
            Some(plan) if plan.mode().transmits() => self.order(Order::Ask(true)),
            Some(_) => self.ask(PromptKind::Normal, ""),
        }
    }

    /// The view begins with this page.
    pub fn begin(&mut self) {
        if self.view == View::Obd {
            self.begin_asking();
        }
    }

    /// The page is not on display any more.
    pub fn set_aside(&mut self) {
        if self.view == View::Obd {
            self.order(Order::Ask(false));
        }
    }
}
