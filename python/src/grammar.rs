//! Identifiers, times, rates and channels from Python: numbers, or texts in the command's grammar (docs/grammar.md).

use std::time::Duration;

use cantap::Channel;
use cantap_trace::{Id, grammar};
use cantap_work::channel_bitrate::ChannelBitrate;
use pyo3::exceptions::{PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDelta;

use crate::error::Error;
use crate::number::{Whole, short};

/// The text, if it is one.
fn text(object: Borrowed<'_, '_, PyAny>) -> Option<String> {
    object.extract::<String>().ok()
}

/// A text that is not what was wanted, in words; it may be long.
fn not_understood(text: &str, words: impl std::fmt::Display) -> PyErr {
    let words = words.to_string();
    let short: String = text.chars().take(40).collect();
    let more = if short.len() < text.len() { "…" } else { "" };
    PyValueError::new_err(if words.contains(&short) { words } else { format!("'{short}{more}': {words}") })
}

fn not_one_of(what: &str, object: Borrowed<'_, '_, PyAny>) -> PyErr {
    let kind = object.get_type().name().map(|name| name.to_string()).unwrap_or_default();
    PyTypeError::new_err(format!("{what}, not {kind}"))
}

/// One of a device's channels: its number, or an interface such as `can0`, which is channel 1.
#[derive(Clone, Copy)]
pub struct OfDevice(pub Channel);

impl<'py> FromPyObject<'_, 'py> for OfDevice {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let number = match (text(object), object.extract::<i64>()) {
            (Some(text), _) => grammar::channel(&text).map_or(-1, i64::from),
            (None, Ok(number)) => number,
            // A number all the same.
            (None, Err(error)) if error.is_instance_of::<PyOverflowError>(object.py()) => -1,
            (None, Err(_)) => {
                return Err(not_one_of("a channel is 1 or 2, or an interface such as 'can0'", object));
            }
        };
        let found = Channel::ALL.into_iter().find(|channel| i64::from(channel.number()) == number);
        found.map(Self).ok_or_else(|| {
            PyValueError::new_err(format!("there is no channel {}; a device has 1 and 2", short(object)))
        })
    }
}

/// A channel of a trace, by its number or as an interface: most count from 1, but some formats have a channel 0.
#[derive(Clone, Copy)]
pub struct OfTrace(pub u8);

impl<'py> FromPyObject<'_, 'py> for OfTrace {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let none = || {
            let words =
                format!("there is no channel {}; a trace's have numbers from 0 to 255", short(object));
            Err(PyValueError::new_err(words))
        };
        if let Some(text) = text(object) {
            return if text == "0" {
                Ok(Self(0))
            } else {
                grammar::channel(&text).map_or_else(none, |number| Ok(Self(number)))
            };
        }
        match object.extract::<u8>() {
            Ok(number) => Ok(Self(number)),
            Err(error) if error.is_instance_of::<PyOverflowError>(object.py()) => none(),
            Err(_) => Err(not_one_of("a channel is a number, or an interface such as 'can0'", object)),
        }
    }
}

/// A bit rate in bit/s.
#[derive(Clone, Copy)]
pub struct BitRate(pub u32);

impl<'py> FromPyObject<'_, 'py> for BitRate {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        if let Some(text) = text(object) {
            let rate = text.parse::<ChannelBitrate>().map_err(|error| not_understood(&text, error))?;
            return match rate.channel {
                None => Ok(Self(rate.bitrate_bps)),
                Some(_) => Err(not_understood(
                    &text,
                    "the channel is given already; write the bit rate alone, such as 500k",
                )),
            };
        }
        // `5e5` is a float.
        let whole = object.extract::<f64>().ok().filter(|value| value.fract() == 0.0 && value.abs() < 1e15);
        let number = match object.extract::<Whole<u32>>() {
            Ok(number) => number.0,
            Err(error) if error.is_instance_of::<PyValueError>(object.py()) => return Err(error),
            Err(_) => match whole {
                Some(value) if (0.0..=f64::from(u32::MAX)).contains(&value) => value as u32,
                Some(value) => {
                    return Err(PyValueError::new_err(format!("{value} is not a bit rate in bit/s")));
                }
                None => {
                    return Err(not_one_of(
                        "a bit rate is a whole number in bit/s, or a text such as '500k'",
                        object,
                    ));
                }
            },
        };
        // The k may have been forgotten.
        grammar::bit_rate(&number.to_string()).map(Self).map_err(PyValueError::new_err)
    }
}

/// A time: seconds, a text such as `400ms`, or a `timedelta` of Python, pandas or NumPy.
#[derive(Clone, Copy)]
pub struct Seconds(pub f64);

impl Seconds {
    /// The time as `what`, which is not below zero.
    pub fn duration(self, what: &str) -> Result<Duration, Error> {
        let seconds = self.0;
        Duration::try_from_secs_f64(seconds)
            .map_err(|_| Error::argument(format!("{seconds} s is not a valid {what}")))
    }
}

impl<'py> FromPyObject<'_, 'py> for Seconds {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        if let Some(text) = text(object) {
            let time = grammar::duration(&text).map_err(|error| not_understood(&text, error))?;
            return Ok(Self(time.as_secs_f64()));
        }
        if object.is_instance_of::<PyDelta>() {
            return object.call_method0("total_seconds")?.extract().map(Self);
        }
        if object.get_type().name()? == "timedelta64" {
            let ns: i64 =
                object.call_method1("astype", ("m8[ns]",))?.call_method1("astype", ("int64",))?.extract()?;
            // NumPy's NaT is no time.
            return Ok(Self(if ns == i64::MIN { f64::NAN } else { ns as f64 / 1e9 }));
        }
        object.extract::<f64>().map(Self).map_err(|_| {
            not_one_of("a time is a number of seconds, a text such as '400ms', or a timedelta", object)
        })
    }
}

/// An identifier, and how many bits it has if that was written: three digits have 11, eight have 29.
#[derive(Clone, Copy)]
pub struct Identifier {
    /// Not checked.
    pub raw: u32,
    /// Whether it has 29 bits; `None` if a number does not say.
    pub extended: Option<bool>,
}

impl Identifier {
    /// Of 29 bits if the caller or what was written says so, or if it is too large for 11.
    pub fn checked(self, extended: Option<bool>) -> Result<Id, Error> {
        let raw = self.raw;
        let is_extended = extended.or(self.extended).unwrap_or(raw > Id::MAX_STANDARD);
        let id = if is_extended { Id::extended(raw) } else { Id::standard(raw) };
        id.ok_or_else(|| Error::argument(no_identifier(&format!("{raw:#X}"))))
    }
}

fn no_identifier(what: &str) -> String {
    format!("{what} is not an identifier; 0x7FF is the last standard one, 0x1FFFFFFF the last extended one")
}

impl<'py> FromPyObject<'_, 'py> for Identifier {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        if let Some(text) = text(object) {
            let id = grammar::identifier(&text).map_err(|error| not_understood(&text, error))?;
            return Ok(Self { raw: id.raw(), extended: Some(id.is_extended()) });
        }
        match object.extract::<Whole<u32>>() {
            Ok(number) => Ok(Self { raw: number.0, extended: None }),
            Err(error) if error.is_instance_of::<PyValueError>(object.py()) => {
                Err(PyValueError::new_err(no_identifier(&object.to_string())))
            }
            Err(_) => {
                Err(not_one_of("an identifier is a number such as 0x123, or a text such as '123'", object))
            }
        }
    }
}

/// The number of a device's channel.
#[pyfunction]
fn channel_number(channel: OfDevice) -> u8 {
    channel.0.number()
}

/// A bit rate in bit/s.
#[pyfunction]
fn bit_rate(rate: BitRate) -> u32 {
    rate.0
}

/// A time in seconds, not below zero.
#[pyfunction]
fn seconds(time: Seconds) -> PyResult<f64> {
    Ok(time.duration("time")?.as_secs_f64())
}

/// An identifier, and whether it has 29 bits.
#[pyfunction]
fn identifier(id: Identifier) -> PyResult<(u32, bool)> {
    let id = id.checked(None)?;
    Ok((id.raw(), id.is_extended()))
}

/// Adds the functions to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(channel_number, module)?)?;
    module.add_function(wrap_pyfunction!(bit_rate, module)?)?;
    module.add_function(wrap_pyfunction!(seconds, module)?)?;
    module.add_function(wrap_pyfunction!(identifier, module)?)
}
