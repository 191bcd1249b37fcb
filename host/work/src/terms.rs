//! What devices report, in the usual terms.

pub use cantap_trace::event_text::failure_text;
