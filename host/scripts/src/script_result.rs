//! What the functions of a script return.

use rhai::EvalAltResult;

/// A value, or why the script cannot go on.
pub type Result<T> = std::result::Result<T, Box<EvalAltResult>>;
