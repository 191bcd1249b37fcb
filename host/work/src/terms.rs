//! What devices report, in the usual terms.

use std::borrow::Cow;

use cantap_trace::TransmitFailure;

/// `1 frame`, `2 frames`.
pub fn counted(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

/// Why a frame was not sent, and how often.
pub fn failure_text(reason: TransmitFailure) -> Cow<'static, str> {
    match reason {
        TransmitFailure::Overtaken { periods: 1 } => "overtaken: its next period came first".into(),
        TransmitFailure::Overtaken { periods } => {
            format!("overtaken: its next {periods} periods came first").into()
        }
        reason => reason.name().into(),
    }
}
