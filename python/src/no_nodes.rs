//! In place of a bus with scripts as nodes, in a build without them.

use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::error::Error;

/// A bus, which this build cannot make.
#[pyclass(module = "cantap._native", frozen)]
pub struct NodeBus;

#[pymethods]
impl NodeBus {
    /// Says what to install.
    #[new]
    #[pyo3(signature = (*_arguments, **_keywords))]
    fn new(_arguments: &Bound<'_, PyTuple>, _keywords: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let missing = "this build of cantap has no scripts, of which the nodes of cantap.bench are made; build it with the feature 'scripts', \
                       or install the package as it is released";
        Err(Error::Format(missing.to_owned()).into())
    }
}

/// There are none.
#[pyfunction]
const fn ready_nodes() -> Vec<(&'static str, &'static str)> {
    Vec::new()
}

/// Adds them to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<NodeBus>()?;
    module.add_function(wrap_pyfunction!(ready_nodes, module)?)
}
