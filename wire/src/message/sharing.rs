//! What a client of a shared board may do.

use core::fmt;

use serde::{Deserialize, Serialize};

/// What a server lets a client do with the board that it shares. Each role includes those before
/// it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Role {
    /// Hear what the board hears.
    #[default]
    Listen,
    /// Choose bit rates, store settings, restart the board; one client at a time.
    Configure,
    /// Send frames, acknowledge others'.
    Send,
}

impl Role {
    /// All roles, the lowest first.
    pub const ALL: [Self; 3] = [Self::Listen, Self::Configure, Self::Send];

    /// The name as users type it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Listen => "listen",
            Self::Configure => "configure",
            Self::Send => "send",
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_role_includes_those_before_it_and_nobody_has_more_than_listening_unasked() {
        assert!(Role::ALL.is_sorted() && Role::default() == Role::Listen);
        assert_eq!(Role::ALL.map(|role| role.to_string()), ["listen", "configure", "send"]);
    }
}
