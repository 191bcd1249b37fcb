//! The compiled half of the Python package `cantap`. Python users see the folder `cantap/` beside it.

#![deny(unsafe_op_in_unsafe_fn)]

mod ahead;
mod channels;
mod conversations;
mod database;
mod device;
mod encode;
mod error;
mod frame;
mod grammar;
mod inputs;
mod messages;
#[cfg(feature = "scripts")]
mod nodes;
#[cfg(not(feature = "scripts"))]
#[path = "no_nodes.rs"]
mod nodes;
mod number;
mod numpy;
mod report;
mod scan;
mod selection;
mod source;
mod table;
mod traces;
mod values;
mod write;

#[cfg(feature = "scripts")]
use cantap_scripts::Counting;
use mimalloc::MiMalloc;
use pyo3::prelude::*;

/// Columns are megabytes that are freed and wanted again. The system's allocator returns them to the kernel each time, and getting them back page by
/// page took a quarter of the time of decoding.
#[cfg(not(feature = "scripts"))]
#[global_allocator]
static ALLOCATOR: MiMalloc = MiMalloc;

/// The same, counted for scripts, whose memory is limited.
#[cfg(feature = "scripts")]
#[global_allocator]
static ALLOCATOR: Counting<MiMalloc> = Counting(MiMalloc);

/// Devices, trace files and signals, for the package `cantap`.
#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    error::register(module)?;
    module.add_class::<conversations::Conversations>()?;
    module.add_class::<database::Database>()?;
    module.add_class::<frame::Frame>()?;
    module.add_class::<frame::Record>()?;
    module.add_class::<report::Report>()?;
    grammar::register(module)?;
    device::register(module)?;
    device::diagnostics::register(module)?;
    device::disturb::register(module)?;
    device::selftest::register(module)?;
    module.add_class::<device::odx::Odx>()?;
    traces::register(module)?;
    write::register(module)?;
    encode::register(module)?;
    messages::register(module)?;
    nodes::register(module)?;
    module.add_class::<scan::Scan>()?;
    module.add_class::<table::Table>()?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))
}
