//! What the functions of a script return, and how their errors are described.

use rhai::EvalAltResult;

/// A value, or why the script cannot go on.
pub type Result<T> = std::result::Result<T, Box<EvalAltResult>>;

/// Whether nothing of a script may run after this.
pub fn is_final(error: &EvalAltResult) -> bool {
    match error {
        EvalAltResult::ErrorTerminated(..) => true,
        EvalAltResult::ErrorInFunctionCall(_, _, inner, _) => is_final(inner),
        _ => false,
    }
}

/// An error for people: its reason, and the line where it happened.
pub fn describe(error: &EvalAltResult) -> String {
    match error {
        EvalAltResult::ErrorInFunctionCall(_, _, inner, _) => describe(inner),
        EvalAltResult::ErrorTerminated(reason, at) | EvalAltResult::ErrorRuntime(reason, at) => {
            with_line(&reason.to_string(), *at)
        }
        EvalAltResult::ErrorStackOverflow(at) => with_line(
            "Stack overflow: too many calls are nested; while a function waits, the others are called, and it again",
            *at,
        ),
        other => other.to_string(),
    }
}

fn with_line(reason: &str, at: rhai::Position) -> String {
    at.line().map_or_else(|| reason.to_owned(), |line| format!("line {line}: {reason}"))
}
