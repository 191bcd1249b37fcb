//! How to open a channel, from Python.

use pyo3::prelude::*;

use crate::grammar::BitRate;
use crate::number::{Whole, entry};

/// How to open a channel, as passed by the Python half.
pub struct ChannelOptions {
    pub bitrate: Option<u32>,
    pub mode: String,
    pub sample_point: Option<f64>,
    pub sjw: Option<u8>,
    /// Prescaler, segment 1, segment 2, jump width.
    pub segments: Option<(u16, u8, u8, u8)>,
    pub one_shot: bool,
    pub manual_recovery: bool,
    pub filters: Vec<String>,
}

/// Prescaler, segment 1, segment 2, jump width.
type Segments = (Whole<u16>, Whole<u8>, Whole<u8>, Whole<u8>);

impl<'py> FromPyObject<'_, 'py> for ChannelOptions {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let bitrate: Option<BitRate> = entry(object, "bitrate", "bitrate")?;
        let sjw: Option<Whole<u8>> = entry(object, "sjw", "sjw")?;
        let segments: Option<Segments> = entry(object, "segments", "segments")?;
        Ok(Self {
            bitrate: bitrate.map(|bitrate| bitrate.0),
            mode: entry(object, "mode", "mode")?,
            sample_point: entry(object, "sample_point", "sample_point")?,
            sjw: sjw.map(|sjw| sjw.0),
            segments: segments
                .map(|(prescaler, first, second, jump)| (prescaler.0, first.0, second.0, jump.0)),
            one_shot: entry(object, "one_shot", "one_shot")?,
            manual_recovery: entry(object, "manual_recovery", "manual_recovery")?,
            filters: entry(object, "filters", "filter")?,
        })
    }
}
