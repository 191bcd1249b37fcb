//! A session with a device, whoever has it: a program through [`Device`](crate::Device), or the server of a shared board.
//!
//! [`Session::begin`] greets the device. [`Requests`] numbers requests and matches answers to them. A thread reads the stream, notices that the
//! session is over or that nothing is answered any more, and passes everything else to a [`Sink`].

mod clean;
mod error;
mod link;
mod plausible;
mod reading;
mod requests;
mod watch;

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use cantap_wire::{Channel, Command, Hello, PROTOCOL_VERSION, Reply};

pub use clean::{clean, printable};
pub(crate) use error::no_timing;
pub use error::{DeviceError, SessionOver};
pub use link::{Link, is_idle};
pub(crate) use plausible::believe;
pub(crate) use reading::over_by;
pub use reading::{Pass, Sink};
pub use requests::{InFlight, Requests, Waiting, encode, write_patiently};
pub(crate) use watch::{LONGEST_PASS, Next, SilenceWatch};

/// How often `Hello` is tried: a device may have half a line from another program in its input.
pub(crate) const HELLO_TRIES: u32 = 3;
/// Time limit for each try.
pub(crate) const HELLO_TIMEOUT: Duration = Duration::from_millis(700);

/// A session. Dropping it ends the connection.
pub struct Session<N> {
    requests: Arc<Requests<N>>,
    hello: Hello,
    _thread: Reading<N>,
}

/// The thread that reads, which ends when this is dropped.
struct Reading<N> {
    requests: Arc<Requests<N>>,
    thread: Option<JoinHandle<()>>,
}

impl<N: Default + Send + 'static> Session<N> {
    /// Greets the device at the other end of a byte stream; messages call it `name`. Its stream goes to `sink`, also what comes before the
    /// greeting is answered.
    pub fn begin(link: Link, name: &str, mut sink: impl Sink<Note = N>) -> Result<Self, DeviceError> {
        let Link { reader, writer, keep_alive } = link;
        let requests = Arc::new(Requests::new(name, writer));
        let for_thread = Arc::clone(&requests);
        let thread = std::thread::Builder::new()
            .name("cantap-reader".to_owned())
            .spawn(move || {
                reading::run(reader, &for_thread, &mut sink);
                for_thread.close();
                drop(keep_alive);
            })
            .map_err(DeviceError::Thread)?;
        let reading = Reading { requests: Arc::clone(&requests), thread: Some(thread) };
        let hello = greet(&requests)?;
        Ok(Self { requests, hello, _thread: reading })
    }
}

impl<N> Session<N> {
    /// The device's description of itself.
    pub const fn hello(&self) -> &Hello {
        &self.hello
    }

    /// Requests to the device.
    pub const fn requests(&self) -> &Arc<Requests<N>> {
        &self.requests
    }
}

impl<N: Default> Session<N> {
    /// Has the device leave its buses. It does that by itself when the port closes, but a request is quicker.
    pub fn leave_buses(&self) {
        for channel in Channel::ALL {
            // If it fails, the device is gone, or the port will close.
            let _ = self.requests.send_unattended(Command::Close { channel }, N::default());
        }
    }
}

impl<N> Drop for Reading<N> {
    fn drop(&mut self) {
        self.requests.quit();
        if let Some(thread) = self.thread.take() {
            // Joined so that the port is closed before anyone opens it again.
            let _ = thread.join();
        }
    }
}

fn greet<N: Default>(requests: &Requests<N>) -> Result<Hello, DeviceError> {
    for _ in 0..HELLO_TRIES {
        // The zero byte ends anything left in the device's input and selects our protocol over slcan.
        requests.write(&[0])?;
        let hello = requests.send(Command::Hello { protocol: PROTOCOL_VERSION }, N::default())?;
        match hello.reply_within(HELLO_TIMEOUT) {
            Ok(Reply::Hello(mut hello)) => {
                clean(&mut hello);
                return Ok(hello);
            }
            Ok(_) => return Err(DeviceError::WrongReply),
            Err(DeviceError::Timeout { .. }) => {}
            Err(error) => return Err(error),
        }
    }
    Err(DeviceError::NotCantap { address: requests.name().to_owned() })
}
