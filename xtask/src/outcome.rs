//! How a step of `cargo xtask test` ended that did not fail.

/// What came of a step.
pub enum Outcome {
    /// All of it ran.
    Passed,
    /// It could not run here, for this reason.
    Skipped(String),
}
