//! Received records, for Python.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cantap_columns::FrameColumns;
use cantap_trace::TraceRecord;
use cantap_trace::socketcan::ErrorFrame;
use cantap_trace::{Direction, TraceEvent};
use pyo3::prelude::*;
use pyo3::types::PyByteArray;

use super::fanout::Listener;
use super::lock::lock;
use crate::error::{DeviceError, Error};
use crate::frame::Record;
use crate::grammar::Seconds;
use crate::number::Whole;
use crate::table::Table;

/// The longest delay for Python's signals.
pub const SLICE: Duration = Duration::from_millis(50);

/// The records of a device from the time at which this was made. Several of these are independent of each
/// other.
#[pyclass(module = "cantap", frozen)]
pub struct Records {
    /// Kept so that a device that nobody closes stays open as long as somebody listens.
    _device: Py<PyAny>,
    /// The device's address, and the process in which it was opened.
    address: String,
    process: u32,
    listener: Arc<Listener>,
    waiting: Mutex<std::vec::IntoIter<TraceRecord>>,
    /// The plugin has messages that it has not delivered yet.
    is_handed_out: AtomicBool,
}

/// How many messages are passed to Python at a time: the call costs as much as a message.
const MOST_MESSAGES: usize = 64;

/// How long to wait for something.
#[derive(Clone, Copy)]
pub struct Until(Option<Instant>);

impl Until {
    /// From seconds; `None` for ever.
    pub fn of(timeout: Option<Seconds>) -> Result<Self, Error> {
        let Some(Seconds(seconds)) = timeout else { return Ok(Self(None)) };
        // `max` alone would make 0 of what is not a number.
        let time = Seconds(if seconds < 0.0 { 0.0 } else { seconds }).duration("time to wait")?;
        Ok(Self(Instant::now().checked_add(time)))
    }

    /// The rest, at most a slice; `None` when the time is over.
    fn slice(self) -> Option<Duration> {
        let Some(deadline) = self.0 else { return Some(SLICE) };
        let left = deadline.saturating_duration_since(Instant::now());
        (!left.is_zero()).then_some(left.min(SLICE))
    }
}

/// The result of waiting.
enum Next {
    One(TraceRecord),
    Nothing,
    End,
}

impl Records {
    pub fn new(device: Py<PyAny>, address: String, listener: Arc<Listener>) -> Self {
        Self {
            _device: device,
            address,
            process: std::process::id(),
            listener,
            waiting: Mutex::default(),
            is_handed_out: AtomicBool::new(false),
        }
    }

    /// A record that is already there.
    fn at_hand(&self) -> Option<TraceRecord> {
        let mut waiting = lock(&self.waiting);
        let next = waiting.next();
        if next.is_some() && waiting.as_slice().is_empty() {
            self.listener.used_up();
        }
        next
    }

    /// That this process may take records: after a fork, the thread that brings them is in the other one, which may have held any
    /// lock in that instant.
    fn check_process(&self) -> Result<(), Error> {
        if self.process == std::process::id() { Ok(()) } else { Err(Error::other_process(&self.address)) }
    }

    fn next(&self, py: Python<'_>, until: Until) -> PyResult<Next> {
        self.check_process()?;
        if let Some(record) = self.at_hand() {
            return Ok(Next::One(record));
        }
        let mut slice = Duration::ZERO;
        loop {
            match py.detach(|| self.listener.pop(slice)) {
                None => {
                    let failure = self.listener.failure();
                    return failure.map_or(Ok(Next::End), |failure| Err(DeviceError::new_err(failure)));
                }
                Some(batch) if batch.is_empty() => {}
                Some(batch) => {
                    *lock(&self.waiting) = batch.into_iter();
                    if let Some(record) = self.at_hand() {
                        return Ok(Next::One(record));
                    }
                }
            }
            py.check_signals()?;
            let Some(next) = until.slice() else {
                self.listener.used_up();
                return Ok(Next::Nothing);
            };
            slice = next;
        }
    }
}

/// A message as python-can's constructor takes it: time, identifier, whether it is extended, remote, an error; channel from 0, length
/// code (of CAN FD: the number of bytes), data, whether it is CAN FD, whether it was received, its bit rate is switched, its sender is passive.
type Message<'py> = (f64, u32, bool, bool, bool, u8, u8, Bound<'py, PyByteArray>, bool, bool, bool, bool);

fn message<'py>(py: Python<'py>, record: &TraceRecord) -> Message<'py> {
    let time_s = record.time_ns as f64 / 1e9;
    let channel = record.channel.wrapping_sub(1);
    if let TraceEvent::Frame { frame, direction, .. } = &record.event {
        let (id, is_rx) = (frame.id(), *direction == Direction::Rx);
        let data = PyByteArray::new(py, frame.data());
        let (is_extended, is_remote) = (id.is_extended(), frame.is_remote());
        let (dlc, brs, esi) = match frame.fd() {
            Some(fd) => (fd.data_len() as u8, fd.brs(), fd.esi()),
            None => (frame.dlc(), false, false),
        };
        let is_fd = frame.is_fd();
        return (time_s, id.raw(), is_extended, is_remote, false, channel, dlc, data, is_fd, is_rx, brs, esi);
    }
    let (classes, data) =
        ErrorFrame::of(&record.event).map_or((0, [0; 8]), |error| (error.classes, error.data));
    let data = PyByteArray::new(py, &data);
    (time_s, classes, true, false, true, channel, 8, data, false, true, false, false)
}

#[pymethods]
impl Records {
    fn __iter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Record>> {
        match self.next(py, Until(None))? {
            Next::One(record) => Ok(Some(Record(record))),
            Next::Nothing | Next::End => Ok(None),
        }
    }

    /// The next record; `None` if there is none within `timeout` seconds, or after the last.
    #[pyo3(signature = (timeout=None))]
    fn read(&self, py: Python<'_>, timeout: Option<Seconds>) -> PyResult<Option<Record>> {
        match self.next(py, Until::of(timeout)?)? {
            Next::One(record) => Ok(Some(Record(record))),
            Next::Nothing | Next::End => Ok(None),
        }
    }

    /// Records of up to `seconds`, at most `rows`, as a table; fewer once the device has been closed.
    #[pyo3(signature = (seconds=None, rows=Whole(65_536)), text_signature = "($self, seconds=None, rows=65536)")]
    fn batch(&self, py: Python<'_>, seconds: Option<Seconds>, rows: Whole<usize>) -> PyResult<Table> {
        let rows = rows.0;
        if rows == 0 {
            return Err(Error::argument("a batch has at least one row").into());
        }
        let until = Until::of(seconds)?;
        let mut columns = FrameColumns::default();
        let mut left = rows;
        while left > 0 {
            match self.next(py, until)? {
                Next::One(record) => columns.push(&record),
                Next::Nothing | Next::End => break,
            }
            left -= 1;
            // The rest of what came with it, all together.
            let mut waiting = lock(&self.waiting);
            let at_hand = waiting.as_slice().len().min(left);
            waiting.by_ref().take(at_hand).for_each(|record| columns.push(&record));
            left -= at_hand;
            let is_used_up = waiting.as_slice().is_empty();
            drop(waiting);
            if is_used_up {
                self.listener.used_up();
            }
        }
        Ok(Table::of_batch(columns.take()))
    }

    /// For the plugin: the next records that are at hand, as python-can's messages; empty if there are none within the time.
    /// Until [`Self::_used_up`] they count as waiting.
    fn _messages<'py>(&self, py: Python<'py>, timeout: Option<Seconds>) -> PyResult<Vec<Message<'py>>> {
        let first = match self.next(py, Until::of(timeout)?)? {
            Next::One(record) => record,
            Next::Nothing => return Ok(Vec::new()),
            Next::End => return Err(DeviceError::new_err("the device is closed")),
        };
        self.is_handed_out.store(true, Ordering::Relaxed);
        // Nothing is locked while Python makes objects.
        let more: Vec<_> = lock(&self.waiting).by_ref().take(MOST_MESSAGES - 1).collect();
        Ok(std::iter::once(first).chain(more).map(|record| message(py, &record)).collect())
    }

    /// For the plugin: all messages that were returned are used up.
    fn _used_up(&self) {
        self.is_handed_out.store(false, Ordering::Relaxed);
        if lock(&self.waiting).as_slice().is_empty() {
            self.listener.used_up();
        }
    }

    /// For the plugin: sets which frames are received from now on; what is waiting must pass as well.
    fn _filter(&self, filters: Vec<String>) -> PyResult<()> {
        self.check_process()?;
        let filters = filters.iter().map(|text| text.parse()).collect::<Result<Vec<_>, _>>();
        let filters = filters.map_err(Error::argument)?;
        self.listener.set_filters(filters);
        let mut waiting = lock(&self.waiting);
        let mut rest: Vec<_> = std::mem::take(&mut *waiting).collect();
        self.listener.refilter(&mut rest);
        *waiting = rest.into_iter();
        Ok(())
    }

    /// Frames lost here because this program did not take them, on channels 1 and 2.
    #[getter]
    fn lost(&self) -> PyResult<(u64, u64)> {
        self.check_process()?;
        let [first, second] = self.listener.lost();
        Ok((first, second))
    }

    /// A file descriptor that is readable while a record is waiting.
    fn fileno(&self) -> PyResult<i32> {
        self.check_process()?;
        let is_waiting =
            self.is_handed_out.load(Ordering::Relaxed) || !lock(&self.waiting).as_slice().is_empty();
        self.listener.signal(is_waiting)?;
        #[cfg(unix)]
        if let Some(descriptor) = self.listener.descriptor() {
            return Ok(descriptor);
        }
        Err(pyo3::exceptions::PyNotImplementedError::new_err("this system waits for no file descriptors"))
    }

    /// Stops listening; waiting records can still be read.
    fn close(&self) {
        // In another process nobody listens any more.
        if self.check_process().is_ok() {
            self.listener.end(None);
        }
    }
}
