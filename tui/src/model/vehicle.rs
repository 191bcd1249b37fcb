//! What a vehicle answers by OBD-II.

use cantap_work::obd::{Asked, AskingState, Table};

/// Its parameters, and how the asking is.
#[derive(Clone, Debug, Default)]
pub struct VehicleSeen {
    /// The latest value of each, with the least and the most.
    pub table: Table,
    /// Whether it is asked.
    pub state: AskingState,
    /// The device is a virtual vehicle's.
    pub is_there: bool,
}

impl VehicleSeen {
    /// Takes what has happened.
    pub fn take(&mut self, asked: Vec<Asked>) {
        for asked in asked {
            match asked {
                Asked::Round => self.table.begin_round(),
                Asked::Answer(event) => self.table.take(&event),
                Asked::State(state) => self.state = state,
            }
        }
    }
}
