//! What a board can show on its own, for Python.

use std::sync::{Arc, Mutex};

use cantap_address::Address;
use cantap_work::boards::the_one_connected;
use cantap_work::selftest::{Patience, Report, ReportLines, TestPlan, run};
use pyo3::prelude::*;

use super::lock::lock;
use super::waiting::{duration, signals};
use crate::error::Error;
use crate::grammar::Seconds;
use crate::report::from_json;

/// Tests the device at an address, or the one that is connected. Returns what `cantap selftest --json` prints.
#[pyfunction]
fn selftest(
    py: Python<'_>,
    address: Option<String>,
    has_loop: bool,
    load_time: Seconds,
    restarts: bool,
) -> PyResult<Bound<'_, PyAny>> {
    let plan = TestPlan { has_loop, load_time: duration(load_time)?, restarts };
    if plan.load_time.is_zero() {
        return Err(Error::argument("load_time: a load lasts longer than 0 s").into());
    }
    let address = address.map(|address| address.parse::<Address>().map_err(Error::argument)).transpose()?;
    // Ctrl-C, or what else a handler of signals raises.
    let raised = Arc::new(Mutex::new(None));
    let report = py.detach(|| -> Result<String, Error> {
        let one = || the_one_connected().map_err(|error| Error::Address(error.to_string()));
        let address = address.map_or_else(one, Ok)?;
        let device = address.open()?;
        let kept = Arc::clone(&raised);
        let patience = Patience::until(move || {
            let mut raised = lock(&kept);
            if raised.is_none() {
                *raised = signals().err();
            }
            raised.is_some()
        });
        let mut report = Report::new(&address, &device, ReportLines::Kept, patience);
        run(plan, &address, device, &mut report);
        serde_json::to_string(&report).map_err(|error| Error::Address(error.to_string()))
    })?;
    match lock(&raised).take() {
        Some(error) => Err(error.into()),
        None => from_json(py, &report),
    }
}

/// Adds the function to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(selftest, module)?)
}
