//! What a trace may say of its channels. It has a file of its own because formats use it that the options of writers name.

/// What is known of a channel before anything is heard on it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChannelInfo {
    /// From 1.
    pub channel: u8,
    /// The bus's bit rate, in bit/s.
    pub bitrate_bps: Option<u32>,
    /// A description of where it is and how it was opened.
    pub description: String,
}
