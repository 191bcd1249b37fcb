//! Selects signals by patterns such as `Engine.*` or `*Temp`.

use std::fmt;

use glob::Pattern;

use super::model::{Message, Signal};

/// Patterns for signals; without any, all signals are selected.
///
/// A pattern with a dot is matched against `Message.Signal` (for a signal in a contained PDU against `Pdu.Signal` and `Message.Pdu.Signal`),
/// one without against the signal's name. `*` matches any text, `?` one character, `[a-z]` one of several. Matching is case-sensitive.
#[derive(Clone, Debug, Default)]
pub struct Selection {
    patterns: Vec<Pattern>,
}

/// Why a pattern cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SelectionError {
    /// It is not well formed.
    #[error("pattern {pattern:?}: {source}; use *, ? and [a-z]")]
    Malformed {
        /// The pattern.
        pattern: String,
        /// What is wrong with it.
        source: glob::PatternError,
    },
    /// No signal has a matching name.
    #[error("no signal of the databases matches {pattern:?}{near}")]
    NoMatch {
        /// The pattern.
        pattern: String,
        /// A name that may have been meant.
        near: Suggestion,
    },
}

impl Selection {
    /// Compiles patterns.
    pub fn new<T: AsRef<str>>(patterns: &[T]) -> Result<Self, SelectionError> {
        let compile = |pattern: &T| {
            let pattern = pattern.as_ref();
            Pattern::new(pattern)
                .map_err(|source| SelectionError::Malformed { pattern: pattern.to_owned(), source })
        };
        Ok(Self { patterns: patterns.iter().map(compile).collect::<Result<_, _>>()? })
    }

    /// Whether the signal is selected.
    pub fn matches(&self, message: &Message, signal: &Signal) -> bool {
        self.patterns.is_empty() || self.patterns.iter().any(|pattern| matches(pattern, message, signal))
    }

    /// Whether a pattern matches the message's name, or that of a PDU it may contain.
    pub fn names(&self, message: &Message) -> bool {
        let pdus = message.container.iter().flat_map(|container| &container.pdus);
        let mut names = std::iter::once(&message.name).chain(pdus.map(|pdu| &pdu.name));
        names.any(|name| self.patterns.iter().any(|pattern| pattern.matches(name)))
    }

    /// Fails if one of the patterns selects nothing in these messages, which is most likely a typing error.
    pub fn check<'a>(
        &self,
        messages: &(impl Iterator<Item = &'a Message> + Clone),
    ) -> Result<(), SelectionError> {
        for pattern in &self.patterns {
            let found = messages
                .clone()
                .any(|message| message.signals.iter().any(|signal| matches(pattern, message, signal)));
            if !found {
                let names =
                    messages.clone().flat_map(|message| message.signals.iter().map(|s| s.name.as_str()));
                let near = Suggestion::nearest(pattern.as_str(), names);
                return Err(SelectionError::NoMatch { pattern: pattern.as_str().to_owned(), near });
            }
        }
        Ok(())
    }
}

fn matches(pattern: &Pattern, message: &Message, signal: &Signal) -> bool {
    if pattern.as_str().contains('.') {
        let is_named = |of: &str| pattern.matches(&format!("{of}.{}", signal.name));
        match &signal.contained {
            None => is_named(&message.name),
            Some(pdu) => is_named(&pdu.name) || is_named(&format!("{}.{}", message.name, pdu.name)),
        }
    } else {
        pattern.matches(&signal.name)
    }
}

/// The end of a message about an unknown name: a similar name that may have been meant, if there is
/// one.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Suggestion(Option<String>);

impl Suggestion {
    /// Looks for the name most like `wanted`.
    pub fn nearest<'a>(wanted: &str, names: impl Iterator<Item = &'a str>) -> Self {
        /// If names are less similar than this, a suggestion is worse than none.
        const LIKE: f64 = 0.7;
        let wanted = wanted.to_lowercase();
        let scored = names.map(|name| (strsim::jaro_winkler(&wanted, &name.to_lowercase()), name));
        let best = scored.max_by(|(a, _), (b, _)| a.total_cmp(b)).filter(|&(like, _)| like >= LIKE);
        Self(best.map(|(_, name)| name.to_owned()))
    }

    /// Whether no name is similar.
    pub const fn is_none(&self) -> bool {
        self.0.is_none()
    }
}

impl fmt::Display for Suggestion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Some(name) => write!(f, "; did you mean {name}?"),
            None => Ok(()),
        }
    }
}
