//! How a step of `cargo xtask test` ended, if it did not fail.

/// The outcome of a step.
pub enum Outcome {
    /// All of it ran.
    Passed,
    /// It could not run here, for this reason.
    Skipped(String),
}
