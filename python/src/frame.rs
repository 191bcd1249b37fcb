//! Frames and records, for Python.

use cantap_columns::FrameColumns;
use cantap_trace::grammar::any_frame;
use cantap_trace::{
    BusErrorKind, DeviceNs, Direction, FdFrame, Frame as ClassicFrame, LinFault, LinFrame, LossStage,
    TraceEvent, TraceFrame, TraceRecord, TransmitFailure,
};
use pyo3::exceptions::{PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::error::Error;
use crate::grammar::Identifier;
use crate::number::Whole;
use crate::table::Table;

/// A CAN frame: classical, or of CAN FD.
#[pyclass(module = "cantap", frozen, eq, hash)]
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Frame(pub TraceFrame);

#[pymethods]
impl Frame {
    #[new]
    #[expect(clippy::too_many_arguments, clippy::fn_params_excessive_bools, reason = "each by its name")]
    #[pyo3(signature = (id, data=None, *, extended=None, remote=false, dlc=None, fd=false, brs=false, esi=false))]
    fn new(
        id: &Bound<'_, PyAny>,
        data: Option<Bytes>,
        extended: Option<bool>,
        remote: bool,
        dlc: Option<Whole<u8>>,
        fd: bool,
        brs: bool,
        esi: bool,
    ) -> PyResult<Self> {
        let wrong = |words: &str| Err(PyValueError::new_err(words.to_owned()));
        if let Ok(text) = id.extract::<String>()
            && text.contains('#')
        {
            if data.is_some() || extended.is_some() || dlc.is_some() || remote || fd || brs || esi {
                return wrong(
                    "'123#1122' is a whole frame already; give nothing else, or the identifier alone, as '123'",
                );
            }
            return Self::parse(&text);
        }
        let id: Identifier = id.extract()?;
        let id = id.checked(extended)?;
        let dlc = dlc.map(|dlc| dlc.0);
        let data = data.map(|data| data.0).unwrap_or_default();
        if fd || brs || esi {
            if remote {
                return wrong("CAN FD has no remote frames");
            }
            let frame = FdFrame::new(id, brs, esi, &data);
            let Some(frame) = frame.filter(|frame| dlc.is_none_or(|dlc| dlc == frame.dlc())) else {
                return wrong(
                    "a CAN FD frame carries 0 to 8, 12, 16, 20, 24, 32, 48 or 64 bytes, from which its dlc follows; leave dlc out",
                );
            };
            return Ok(Self(frame.into()));
        }
        let frame = if remote {
            if !data.is_empty() {
                return wrong("a remote frame has no data; give dlc, the length that it asks for");
            }
            ClassicFrame::remote_frame(id, dlc.unwrap_or(0))
        } else {
            if dlc.is_some_and(|dlc| usize::from(dlc) != data.len()) {
                return wrong("a data frame's dlc is the number of its bytes; leave it out");
            }
            ClassicFrame::data_frame(id, &data)
        };
        match frame {
            Some(frame) => Ok(Self(frame.into())),
            None => wrong("a frame carries 0 to 8 bytes, and one of CAN FD (fd=True) up to 64"),
        }
    }

    /// The identifier.
    #[getter]
    fn id(&self) -> u32 {
        self.0.id().raw()
    }

    /// Whether the identifier has 29 bits.
    #[getter]
    fn extended(&self) -> bool {
        self.0.id().is_extended()
    }

    /// Whether it asks for data and has none.
    #[getter]
    fn remote(&self) -> bool {
        self.0.is_remote()
    }

    /// Whether it is a CAN FD frame.
    #[getter]
    fn fd(&self) -> bool {
        self.0.is_fd()
    }

    /// Whether its data have a bit rate of their own.
    #[getter]
    fn brs(&self) -> bool {
        self.0.fd().is_some_and(FdFrame::brs)
    }

    /// Whether it says that its sender is error passive.
    #[getter]
    fn esi(&self) -> bool {
        self.0.fd().is_some_and(FdFrame::esi)
    }

    /// The length code, as on the bus.
    #[getter]
    fn dlc(&self) -> u8 {
        self.0.dlc()
    }

    /// The data bytes.
    #[getter]
    fn data<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.0.data())
    }

    fn __str__(&self) -> String {
        self.0.to_string()
    }

    fn __repr__(&self) -> String {
        format!("<cantap.Frame {}>", self.0)
    }

    fn __reduce__(&self, py: Python<'_>) -> PyResult<(Py<PyAny>, (String,))> {
        Ok((py.get_type::<Self>().getattr("parse")?.unbind(), (self.0.to_string(),)))
    }

    /// Parses a frame as `cantap send` takes it: `123#1122`, `1#00`, `0x18FEF100#11.22`, `00000123#R3`, `123##11122`.
    #[staticmethod]
    fn parse(text: &str) -> PyResult<Self> {
        let frame = any_frame(text, false);
        frame.map(Self).map_err(|error| {
            // Somebody may have passed a whole file.
            let end = text.char_indices().nth(40).map_or(text.len(), |(at, _)| at);
            let more = if end < text.len() { "…" } else { "" };
            PyValueError::new_err(format!("'{}{more}' is not a frame: {error}", &text[..end]))
        })
    }
}

/// Data bytes.
struct Bytes(Vec<u8>);

impl<'py> FromPyObject<'_, 'py> for Bytes {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        object.extract::<Vec<u8>>().map(Self).map_err(|error| {
            let py = object.py();
            if error.is_instance_of::<PyOverflowError>(py) {
                PyValueError::new_err("a byte of the data is out of range: give 0 to 255")
            } else {
                let kind = object.get_type().name().map(|name| name.to_string()).unwrap_or_default();
                PyTypeError::new_err(format!("the data are bytes, or numbers from 0 to 255, not {kind}"))
            }
        })
    }
}

/// A frame, or a text that can be parsed as one.
pub struct AnyFrame(pub TraceFrame);

impl AnyFrame {
    /// The frame, where only a classical one will do.
    pub fn classic(&self, what: &str) -> PyResult<ClassicFrame> {
        self.0.classic().copied().ok_or_else(|| {
            PyValueError::new_err(format!("{what} is a classical frame, and {} is one of CAN FD", self.0))
        })
    }
}

impl<'py> FromPyObject<'_, 'py> for AnyFrame {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        if let Ok(frame) = object.cast::<Frame>() {
            return Ok(Self(frame.get().0));
        }
        if let Ok(text) = object.extract::<String>() {
            return Frame::parse(&text).map(|frame| Self(frame.0));
        }
        let kind = object.get_type().name()?;
        Err(PyTypeError::new_err(format!(
            "a cantap.Frame is wanted, or a text such as '123#1122', not {kind}"
        )))
    }
}

/// An event on a bus: a frame, an error, a loss.
#[pyclass(module = "cantap", frozen, eq, hash)]
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Record(pub TraceRecord);

impl Record {
    fn frame(&self) -> Option<&TraceFrame> {
        self.0.frame()
    }
}

#[pymethods]
impl Record {
    /// Seconds since 1970, UTC.
    #[getter]
    fn time_s(&self) -> f64 {
        self.0.time_ns as f64 / 1e9
    }

    /// Nanoseconds since 1970, UTC. For a frame it is the end.
    #[getter]
    fn time_ns(&self) -> i64 {
        self.0.time_ns
    }

    /// The same moment by the device's own clock, in nanoseconds, corrected by nothing; `None` where it is not known.
    #[getter]
    fn device_ns(&self) -> Option<u64> {
        self.0.device_ns.map(DeviceNs::get)
    }

    /// The channel, from 1.
    #[getter]
    fn channel(&self) -> u8 {
        self.0.channel
    }

    /// The kind of event: `frame`, `lost`, `bus-error`, `errors-suppressed`, `state`, `transmit-failed`,
    /// `disturbed`, `lin`.
    #[getter]
    fn event(&self) -> &'static str {
        match self.0.event {
            TraceEvent::Frame { .. } => "frame",
            TraceEvent::Lost { .. } => "lost",
            TraceEvent::BusError { .. } => "bus-error",
            TraceEvent::ErrorsSuppressed { .. } => "errors-suppressed",
            TraceEvent::State { .. } => "state",
            TraceEvent::TransmitFailed { .. } => "transmit-failed",
            TraceEvent::Disturbed { .. } => "disturbed",
            TraceEvent::Lin { .. } => "lin",
        }
    }

    /// Where frames were lost, which error, which state, why not sent, what was wrong with a LIN frame.
    #[getter]
    fn detail(&self) -> Option<&'static str> {
        match &self.0.event {
            TraceEvent::Lost { stage, .. } => stage.map(LossStage::name),
            TraceEvent::BusError { kind, .. } => kind.map(BusErrorKind::name),
            TraceEvent::State { state, .. } => Some(state.name()),
            TraceEvent::TransmitFailed { reason, .. } => Some(reason.name()),
            TraceEvent::Lin { frame, .. } => frame.fault.map(LinFault::name),
            TraceEvent::Frame { .. } | TraceEvent::ErrorsSuppressed { .. } | TraceEvent::Disturbed { .. } => {
                None
            }
        }
    }

    /// Frames lost, errors suppressed, periods that passed; of a disturbance the nanoseconds, 0 if it came to nothing; of a LIN frame its
    /// checksum.
    #[getter]
    fn count(&self) -> Option<u32> {
        match self.0.event {
            TraceEvent::Lost { count, .. }
            | TraceEvent::ErrorsSuppressed { count }
            | TraceEvent::Disturbed { length_ns: count } => Some(count),
            TraceEvent::TransmitFailed { reason: TransmitFailure::Overtaken { periods }, .. } => {
                Some(periods)
            }
            TraceEvent::Lin { frame, .. } => frame.checksum.map(u32::from),
            _ => None,
        }
    }

    /// Whether more may have been lost.
    #[getter]
    fn at_least(&self) -> bool {
        matches!(self.0.event, TraceEvent::Lost { at_least: true, .. })
    }

    /// The frame's identifier, of a LIN frame too.
    #[getter]
    fn id(&self) -> Option<u32> {
        self.frame().map(|frame| frame.id().raw()).or_else(|| self.0.lin().map(|frame| frame.id().into()))
    }

    /// Whether it has 29 bits.
    #[getter]
    fn extended(&self) -> bool {
        self.frame().is_some_and(|frame| frame.id().is_extended())
    }

    /// Whether the frame asks for data and has none.
    #[getter]
    fn remote(&self) -> bool {
        self.frame().is_some_and(TraceFrame::is_remote)
    }

    /// Whether it is a CAN FD frame.
    #[getter]
    fn fd(&self) -> bool {
        self.frame().is_some_and(TraceFrame::is_fd)
    }

    /// Whether its data had a bit rate of their own.
    #[getter]
    fn brs(&self) -> bool {
        self.frame().and_then(TraceFrame::fd).is_some_and(FdFrame::brs)
    }

    /// Whether it says that its sender is error passive.
    #[getter]
    fn esi(&self) -> bool {
        self.frame().and_then(TraceFrame::fd).is_some_and(FdFrame::esi)
    }

    /// The frame's length code, as on the bus.
    #[getter]
    fn dlc(&self) -> Option<u8> {
        self.frame().map(TraceFrame::dlc)
    }

    /// The frame's data bytes, of a LIN frame too.
    #[getter]
    fn data<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyBytes>> {
        let data = self.frame().map(TraceFrame::data).or_else(|| self.0.lin().map(LinFrame::data));
        data.map(|data| PyBytes::new(py, data))
    }

    /// `rx` or `tx`, for a frame.
    #[getter]
    fn direction(&self) -> Option<&'static str> {
        match self.0.event {
            TraceEvent::Frame { direction, .. } | TraceEvent::Lin { direction, .. } => {
                Some(if direction == Direction::Tx { "tx" } else { "rx" })
            }
            _ => None,
        }
    }

    /// Whether the time is only an upper bound: the frame ended then or earlier.
    #[getter]
    fn late(&self) -> bool {
        matches!(self.0.event, TraceEvent::Frame { late: true, .. })
    }

    /// Through a table of one row, which has all of it.
    fn __reduce__(&self, py: Python<'_>) -> PyResult<(Py<PyAny>, (Table,))> {
        let mut columns = FrameColumns::default();
        columns.push(&self.0);
        let make = py.get_type::<Self>().getattr("_of_table")?.unbind();
        Ok((make, (Table::of_batch(columns.take()),)))
    }

    #[staticmethod]
    fn _of_table(table: &Table) -> PyResult<Self> {
        let found = cantap_columns::records(&table.one_batch()?).map_err(Error::from)?;
        let first = found.first().ok_or_else(|| PyValueError::new_err("the table has no record"))?;
        Ok(Self(*first))
    }

    fn __repr__(&self) -> String {
        let TraceRecord { time_ns, channel, .. } = self.0;
        let seconds = format!("{}.{:06}", time_ns / 1_000_000_000, time_ns / 1000 % 1_000_000);
        if let Some(frame) = self.frame() {
            return format!("<cantap.Record {seconds} channel {channel} {frame}>");
        }
        let detail = self.detail().map_or_else(String::new, |detail| format!(" {detail}"));
        let count = self.count().map_or_else(String::new, |count| format!(" {count}"));
        format!("<cantap.Record {seconds} channel {channel} {}{detail}{count}>", self.event())
    }
}
