//! Times of records as text.

pub use cantap_trace::Seconds;
