//! How a step of `cargo xtask test` ended, if it did not fail.

/// The outcome of a step.
pub enum Outcome {
    /// All of it ran.
    Passed,
    /// All of it passed, but these tests only when they ran once more, alone: a defect of theirs.
    Flaky(Vec<String>),
    /// It could not run here, for this reason.
    Skipped(String),
}
