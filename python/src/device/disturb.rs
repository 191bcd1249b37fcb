//! Error frames on purpose, for Python.

use std::sync::Arc;
use std::time::Duration;

use cantap::TraceRecord;
use cantap_work::disturbance::{self, Disturbance, Plan, When};
use pyo3::prelude::*;

use super::Device;
use super::fanout::{Listener, SentFrames, Wanted};
use super::waiting::{duration, signals};
use crate::error::Error;
use crate::grammar::{Identifier, OfDevice, Seconds};
use crate::number::Whole;
use crate::report::from_json;

/// Records that may wait while Python handles a signal.
const CAPACITY: usize = 1 << 16;

/// The device's records until an exception.
struct Source(Arc<Listener>);

impl disturbance::Records for Source {
    fn next(&mut self, wait: Duration) -> anyhow::Result<Option<Vec<TraceRecord>>> {
        signals()?;
        let Some(records) = self.0.pop(wait) else {
            let failure = self.0.failure();
            return Err(Error::Address(failure.unwrap_or_else(|| "the device was closed".to_owned())).into());
        };
        Ok(Some(records))
    }
}

fn error(error: anyhow::Error) -> Error {
    match error.downcast::<Error>() {
        Ok(error) => error,
        Err(error) => Error::Address(format!("{error:#}")),
    }
}

/// Disturbs a bus: at a time from now on, or onto the frames of an identifier. Returns what became of each, as `cantap disturb --json` prints it.
#[expect(clippy::too_many_arguments, reason = "what Python's half passes, each by its name")]
#[pyfunction]
fn disturb(
    py: Python<'_>,
    device: Py<Device>,
    number: OfDevice,
    at: Option<Seconds>,
    id: Option<Identifier>,
    nth: Option<Whole<u64>>,
    length: Whole<u8>,
    count: Whole<u32>,
    every: Seconds,
) -> PyResult<Vec<Bound<'_, PyAny>>> {
    let session = device.get().session()?;
    let when = match (at, id) {
        (Some(first), None) => When::At { first: duration(first)?, every: duration(every)? },
        (None, Some(id)) => When::Onto { id: id.checked(None)?, nth: nth.map(|nth| nth.0) },
        _ => return Err(Error::argument("give either at=, a time, or id=, whose frames are hit").into()),
    };
    let outcomes = py.detach(|| -> Result<Vec<Disturbance>, Error> {
        let device = session.device()?;
        disturbance::unlock(device, &session.address).map_err(error)?;
        let open = device.open_channels().into_iter().find(|(channel, _)| *channel == number.0);
        let Some((channel, config)) = open else {
            return Err(Error::Address(format!(
                "channel {} is closed; open it with mode=\"normal\"",
                number.0.number()
            )));
        };
        let bitrate_bps = config.timing.bitrate_bps(device.hello().can_clock_hz);
        let plan = Plan { channel, bitrate_bps, when, bits: length.0, count: count.0 };
        let wanted = Wanted { channel: Some(channel.number()), filters: Vec::new(), sent: SentFrames::All };
        let mut records = Source(session.fanout.listen(wanted, CAPACITY));
        let mut outcomes = Vec::new();
        disturbance::disturb(device, &plan, &mut records, |outcome| {
            outcomes.push(*outcome);
            Ok(())
        })
        .map_err(error)?;
        Ok(outcomes)
    })?;
    outcomes.iter().map(|outcome| from_json(py, &outcome.json(number.0).to_string())).collect()
}

/// Adds the function to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(disturb, module)?)
}
