//! What devices report, in the usual terms.

pub use cantap_trace::event_text::failure_text;

/// `1 frame`, `2 frames`.
pub fn counted(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}
