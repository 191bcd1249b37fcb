//! The compiled half of the Python package `cantap`. Python users see the folder `cantap/` beside it.

#![deny(unsafe_op_in_unsafe_fn)]

mod ahead;
mod database;
mod device;
mod error;
mod frame;
mod number;
mod numpy;
mod report;
mod scan;
mod source;
mod table;
mod traces;

use pyo3::prelude::*;

/// Devices, trace files and signals, for the package `cantap`.
#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    error::register(module)?;
    module.add_class::<database::Database>()?;
    module.add_class::<frame::Frame>()?;
    module.add_class::<frame::Record>()?;
    module.add_class::<report::Report>()?;
    device::register(module)?;
    traces::register(module)?;
    module.add_class::<scan::Scan>()?;
    module.add_class::<table::Table>()?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))
}
