//! Asks a vehicle by OBD-II for the pages: its VIN, trouble codes and values. It is asked on the first device, and only while channels take part in
//! their buses and a page is there.

use std::time::Duration;

use anyhow::{Context, bail};
use cantap::{Device, TraceRecord};
use cantap_work::advice;
use cantap_work::obd::{Asked, Asking, AskingState, Table};

use crate::state::{VehicleRow, VehicleState};

/// As `cantap obd` has them without options.
const P2: Duration = Duration::from_millis(200);
const PERIOD: Duration = Duration::from_secs(1);

/// What is asked, and what came of it.
#[derive(Default)]
pub struct Vehicle {
    asking: Option<Asking>,
    state: AskingState,
    table: Table,
}

impl Vehicle {
    /// Begins anew on a device's channels that take part in their buses.
    pub fn begin(&mut self, device: &Device) -> anyhow::Result<()> {
        if self.state.is_on() {
            bail!("the vehicle is being asked");
        }
        let open = device.open_channels().into_iter();
        let channels = open.filter(|(_, config)| config.mode.transmits()).map(|(channel, _)| channel);
        self.asking = Some(
            Asking::new(channels, P2, PERIOD)
                .context("no channel of the first device takes part in its bus")?,
        );
        self.table = Table::default();
        self.take_asked();
        Ok(())
    }

    /// Asks nothing any more; what is on its way ends.
    pub fn leave(&mut self) {
        if let Some(asking) = &mut self.asking {
            asking.leave();
            self.take_asked();
        }
    }

    /// The device's session is over.
    pub fn forget(&mut self, reason: &str) {
        if self.asking.take().is_some() && self.state.is_on() {
            self.state = AskingState::Ended(reason.trim_end_matches('.').to_owned());
        }
    }

    /// Whether it is asked.
    pub const fn is_asked(&self) -> bool {
        self.state.is_on()
    }

    /// Whether an answer is awaited, so that records should be passed on at once.
    pub fn is_urgent(&self) -> bool {
        self.asking.as_ref().is_some_and(Asking::is_urgent)
    }

    /// Takes the devices' records, in order; channels 1 and 2 are those of the first.
    pub fn take(&mut self, records: &[TraceRecord]) {
        if let Some(asking) = &mut self.asking {
            asking.take(records);
        }
    }

    /// Sends what is due. Returns whether there is something new to show.
    pub fn go_on(&mut self, device: Option<&Device>) -> bool {
        let (Some(asking), Some(device)) = (&mut self.asking, device) else { return false };
        let result = asking.go_on(device);
        let is_over = asking.is_over();
        let has_news = self.take_asked();
        match result {
            Err(error) => self.forget(&advice::explained(&error)),
            Ok(()) if is_over => self.asking = None,
            Ok(()) => return has_news,
        }
        true
    }

    fn take_asked(&mut self) -> bool {
        let asked = self.asking.as_mut().map(Asking::take_asked).unwrap_or_default();
        let has_news = !asked.is_empty();
        for asked in asked {
            match asked {
                Asked::Round => self.table.begin_round(),
                Asked::Answer(event) => self.table.take(&event),
                Asked::State(state) => self.state = state,
            }
        }
        has_news
    }

    /// What pages show of it; `None` before it was asked the first time.
    pub fn state(&self) -> Option<VehicleState> {
        if self.state == AskingState::Off && self.table.is_empty() {
            return None;
        }
        let rows = self.table.rows().into_iter();
        let row = |row: cantap_work::obd::TableRow<'_>| VehicleRow {
            parameter: row.parameter,
            name: row.name.to_owned(),
            ecu: row.ecu.to_owned(),
            value: row.value.to_owned(),
            is_current: row.is_current,
            range: row.range,
        };
        Some(VehicleState {
            is_asked: self.is_asked(),
            text: self.state.sentence(),
            rows: rows.map(row).collect(),
        })
    }
}
