//! Why an identifier's frames are sent.

/// Why frames are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// By itself.
    Sender,
    /// As a request: the tester sends it.
    Request,
    /// As the answer to a request.
    Answer,
}

impl Role {
    /// Its name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sender => "sender",
            Self::Request => "request",
            Self::Answer => "answer",
        }
    }
}
