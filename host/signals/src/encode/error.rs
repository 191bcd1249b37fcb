//! Why values cannot be encoded, with what to write instead.

use crate::select::Suggestion;

/// Why values cannot be encoded.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The text does not have the expected form.
    #[error("{text:?} is not a message with values; write it as Message:Signal=value,Signal=value")]
    Form {
        /// The text.
        text: String,
    },
    /// No database has the message.
    #[error("no database has a message {name:?}{near}")]
    UnknownMessage {
        /// The name.
        name: String,
        /// A similar name.
        near: Suggestion,
    },
    /// Databases of different channels have it.
    #[error("channels {first} and {second} both have a message {name:?}; choose the channel")]
    Ambiguous {
        /// The name.
        name: String,
        /// One channel.
        first: u8,
        /// Another.
        second: u8,
    },
    /// The message has no such signal.
    #[error("message {message} has no signal {name:?}{near}")]
    UnknownSignal {
        /// The message.
        message: String,
        /// The name.
        name: String,
        /// A similar name.
        near: Suggestion,
    },
    /// The signal is given twice.
    #[error("signal {0} is given twice")]
    Twice(String),
    /// The text is not a number and not in the value table.
    #[error("{text:?} is not a value for {signal}; it takes a number{choices}")]
    UnknownText {
        /// The signal.
        signal: String,
        /// The text.
        text: String,
        /// The texts that it accepts, ready for printing.
        choices: String,
    },
    /// The text stands for several raw values.
    #[error("{text:?} stands for several values of {signal}; choose one: {choices}")]
    AmbiguousText {
        /// The signal.
        signal: String,
        /// The text.
        text: String,
        /// The values, ready to be written instead of the text.
        choices: String,
    },
    /// A fraction was given for a signal whose values are states.
    #[error("{signal} has states and none between them, such as {value}; it takes a whole number{choices}")]
    Fraction {
        /// The signal.
        signal: String,
        /// The value.
        value: String,
        /// The texts that it accepts, ready for printing.
        choices: String,
    },
    /// The signal has too few bits for the value.
    #[error("{value} does not fit {signal}, which goes from {low} to {high}")]
    Range {
        /// The signal.
        signal: String,
        /// The value.
        value: String,
        /// The smallest it can hold.
        low: String,
        /// The largest it can hold.
        high: String,
    },
    /// The database forbids the value.
    #[error(
        "the database allows {signal} from {low} to {high}, not {value}; write raw:{raw} to send it anyway"
    )]
    Limits {
        /// The signal.
        signal: String,
        /// The value.
        value: String,
        /// The smallest allowed.
        low: f64,
        /// The largest allowed.
        high: f64,
        /// The bits that would be sent.
        raw: u64,
    },
    /// The signal is not present, because the multiplexer has another value.
    #[error("{signal} is only there when {switch} is {needed}, and it is {actual}")]
    Absent {
        /// The signal.
        signal: String,
        /// Its multiplexer.
        switch: String,
        /// The values for which the signal is present.
        needed: String,
        /// The value that was given.
        actual: u64,
    },
    /// No value of the multiplexer suits all given signals.
    #[error("{first} and {second} are never in the same frame ({switch} chooses between them)")]
    Exclusive {
        /// One signal.
        first: String,
        /// Another.
        second: String,
        /// Their multiplexer.
        switch: String,
    },
    /// The message is longer than a frame, or the signal lies beyond it.
    #[error("{what} needs {bytes} bytes; {room}")]
    TooLong {
        /// Message or signal.
        what: String,
        /// Bytes it needs.
        bytes: u32,
        /// A description of how much room there is.
        room: &'static str,
    },
}
