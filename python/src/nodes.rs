//! A bus with scripts as nodes, and Python as one more: simulated, or through a device.

mod on_device;

use std::sync::{Arc, Mutex};

use cantap_scripts::{Bench, BenchBus, Script, Simulation, library};
use cantap_signals::Decoder;
use cantap_trace::TraceRecord;
use pyo3::prelude::*;

use self::on_device::{OnDevice, SEED};
use crate::database::Database;
use crate::error::Error;
use crate::frame::{AnyFrame, Record};
use crate::grammar::{BitRate, OfDevice};

/// Simulated buses have this bit rate unless the options fix another, in bit/s.
const SIMULATED_BPS: u32 = 500_000;

/// A bus.
#[pyclass(module = "cantap._native", frozen)]
pub struct NodeBus(Mutex<Kind>);

enum Kind {
    Simulated(Box<Simulation>),
    Device(OnDevice),
    Closed,
}

/// A ready node by its name after `node:`, or a script of one's own.
fn script(name: String, source: Option<String>) -> Result<Script, Error> {
    if let Some(source) = source {
        return Ok(Script::new(name, source));
    }
    let ready = name.strip_prefix(library::PREFIX).unwrap_or(&name);
    library::script(ready).map_err(Error::argument)
}

impl NodeBus {
    /// Does something with it while other Python threads run.
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        act: impl FnOnce(&mut Kind) -> Result<T, Error> + Send,
    ) -> PyResult<T> {
        let result = py.detach(|| act(&mut self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner)));
        result.map_err(PyErr::from)
    }
}

fn closed() -> Error {
    Error::Address("the bus is closed".to_owned())
}

#[pymethods]
impl NodeBus {
    /// On simulated buses if the address is none; otherwise on this channel of the device there.
    #[new]
    fn new(
        py: Python<'_>,
        address: Option<String>,
        channel: OfDevice,
        bitrate: Option<BitRate>,
        options: String,
        database: Option<&Database>,
    ) -> PyResult<Self> {
        let decoder = database
            .map_or_else(|| Arc::new(Decoder::new(Vec::new())), |database| Arc::clone(&database.decoder));
        let bitrate_bps = bitrate.map(|bitrate| bitrate.0);
        let channel = channel.0;
        let kind = match address {
            None => {
                let bus: BenchBus = options.parse().map_err(Error::argument)?;
                let bench = Bench {
                    options: bus.options,
                    faults: bus.faults,
                    bitrates_bps: [bitrate_bps.unwrap_or(SIMULATED_BPS); 2],
                    decoder,
                    seed: SEED,
                    keys: Vec::new(),
                    readable: None,
                    duration_ns: u64::MAX,
                };
                Kind::Simulated(Box::new(bench.start()))
            }
            Some(address) => {
                Kind::Device(py.detach(|| OnDevice::open(&address, channel, bitrate_bps, decoder))?)
            }
        };
        Ok(Self(Mutex::new(kind)))
    }

    /// One more node; returns its number.
    fn add(&self, py: Python<'_>, name: String, source: Option<String>) -> PyResult<usize> {
        let script = script(name, source)?;
        self.with(py, |kind| match kind {
            Kind::Simulated(simulation) => simulation.add(&script).map_err(Error::argument),
            Kind::Device(device) => device.add(script),
            Kind::Closed => Err(closed()),
        })
    }

    /// Ends a node.
    fn end(&self, py: Python<'_>, node: usize) -> PyResult<()> {
        self.with(py, |kind| match kind {
            Kind::Simulated(simulation) => {
                simulation.end(node);
                Ok(())
            }
            Kind::Device(device) => device.end(node),
            Kind::Closed => Ok(()),
        })
    }

    /// Sends a frame.
    fn send(&self, py: Python<'_>, channel: OfDevice, frame: AnyFrame) -> PyResult<()> {
        let (channel, frame) = (channel.0, frame.classic("what a test sends")?);
        self.with(py, |kind| match kind {
            Kind::Simulated(simulation) => {
                simulation.send(channel, frame);
                Ok(())
            }
            Kind::Device(device) => device.send(channel, frame),
            Kind::Closed => Err(closed()),
        })
    }

    /// Sends a frame again and again, until the next call with this handle; without a frame, no more.
    fn repeat(
        &self,
        py: Python<'_>,
        handle: u32,
        channel: OfDevice,
        frame: Option<AnyFrame>,
        period_ns: u64,
    ) -> PyResult<()> {
        let channel = channel.0;
        let frame = frame.map(|frame| frame.classic("what a test sends")).transpose()?;
        let repeated = frame.map(|frame| (channel, frame, period_ns));
        self.with(py, |kind| match kind {
            Kind::Simulated(simulation) => {
                simulation.repeat(handle, repeated);
                Ok(())
            }
            Kind::Device(device) => device.repeat(handle, repeated),
            Kind::Closed => Err(closed()),
        })
    }

    /// Nanoseconds: of simulated time since the beginning, or of UTC by the device's clock.
    fn now_ns(&self, py: Python<'_>) -> PyResult<i64> {
        self.with(py, |kind| match kind {
            Kind::Simulated(simulation) => Ok(simulation.now_ns() as i64),
            Kind::Device(device) => device.now_ns(),
            Kind::Closed => Err(closed()),
        })
    }

    /// Lets time pass up to `until_ns`, or until something was on the bus, which it returns.
    fn advance(&self, py: Python<'_>, until_ns: i64) -> PyResult<Vec<Record>> {
        let records: Vec<TraceRecord> = self.with(py, |kind| match kind {
            Kind::Simulated(simulation) => {
                let until_ns = u64::try_from(until_ns).unwrap_or(0);
                let mut records = simulation.take_records();
                while records.is_empty() && simulation.now_ns() < until_ns {
                    simulation.advance(until_ns);
                    records = simulation.take_records();
                }
                Ok(records)
            }
            Kind::Device(device) => device.advance(until_ns),
            Kind::Closed => Err(closed()),
        })?;
        py.check_signals()?;
        Ok(records.into_iter().map(Record).collect())
    }

    /// What scripts have logged since the last call: seconds since the beginning, script, text.
    fn messages(&self, py: Python<'_>) -> PyResult<Vec<(f64, String, String)>> {
        let messages = self.with(py, |kind| match kind {
            Kind::Simulated(simulation) => Ok(simulation.take_messages()),
            Kind::Device(device) => device.messages(),
            Kind::Closed => Ok(Vec::new()),
        })?;
        let row =
            |message: cantap_scripts::Message| (message.at_ns as f64 / 1e9, message.script, message.text);
        Ok(messages.into_iter().map(row).collect())
    }

    /// Scripts that have ended with an error, and the error.
    fn errors(&self, py: Python<'_>) -> PyResult<Vec<(String, String)>> {
        self.with(py, |kind| match kind {
            Kind::Simulated(simulation) => Ok(simulation.errors()),
            Kind::Device(device) => device.errors(),
            Kind::Closed => Ok(Vec::new()),
        })
    }

    /// Ends all nodes and leaves the bus.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        self.with(py, |kind| {
            *kind = Kind::Closed;
            Ok(())
        })
    }
}

/// The names of the ready nodes, and what each of them is.
#[pyfunction]
fn ready_nodes() -> Vec<(&'static str, &'static str)> {
    library::ReadyNode::all().iter().map(|node| (node.name, node.title())).collect()
}

/// Adds them to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<NodeBus>()?;
    module.add_function(wrap_pyfunction!(ready_nodes, module)?)
}
