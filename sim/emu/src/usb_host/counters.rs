//! The host's books.

/// What a host counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Bulk IN packets.
    pub in_packets: u64,
    /// Bulk IN bytes.
    pub in_bytes: u64,
    /// Bulk OUT packets.
    pub out_packets: u64,
    /// Packets on the notification pipe.
    pub notifications: u64,
    /// Data packets with the same toggle as the one before: repetitions after a lost handshake.
    pub repeated: u64,
    /// OUT packets that the device acknowledged and threw away because of their toggle.
    pub thrown_away: u64,
    /// Transactions on configured pipes that the device left unanswered.
    pub silences: u64,
    /// STALLs on configured pipes.
    pub stalls: u64,
    /// Handshakes dropped on request.
    pub dropped_handshakes: u64,
    /// Enumerations that succeeded.
    pub enumerations: u64,
}
