//! One encrypted stream for two threads: one reads and the other writes, and neither waits for the other's
//! socket.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use rustls::Connection;
use rustls::pki_types::CertificateDer;

/// Bytes encrypted at a time.
const PIECE: usize = 16 * 1024;
/// A flush that takes longer is left to the next write.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(2);

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every holder leaves the state consistent.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A stream after its handshake.
pub struct Secured(Arc<Shared>);

struct Shared {
    /// Held only while computing.
    connection: Mutex<Connection>,
    /// Held while writing to the socket.
    output: Mutex<Output>,
    stream: TcpStream,
}

/// Encrypted but not yet accepted by the socket.
#[derive(Default)]
struct Output {
    unsent: Vec<u8>,
}

/// Does the handshake on a socket that returns within a fraction of a second. No data of ours is sent before it is
/// complete.
pub fn shake_hands(stream: TcpStream, mut connection: Connection, deadline: Instant) -> io::Result<Secured> {
    let mut result = Ok(());
    while result.is_ok() && connection.is_handshaking() {
        result = step(&stream, &mut connection);
        if Instant::now() >= deadline && connection.is_handshaking() {
            return Err(io::Error::new(io::ErrorKind::TimedOut, "it did not say who it is in time"));
        }
    }
    // The end of the handshake, or why it failed.
    while connection.wants_write() && Instant::now() < deadline {
        match connection.write_tls(&mut &stream) {
            Err(error) if is_idle(&error) => {}
            Ok(_) => {}
            Err(_) => break,
        }
    }
    result?;
    Ok(Secured(Arc::new(Shared { connection: Mutex::new(connection), output: Mutex::default(), stream })))
}

fn step(mut stream: &TcpStream, connection: &mut Connection) -> io::Result<()> {
    let moved = if connection.wants_write() {
        connection.write_tls(&mut stream)
    } else {
        match connection.read_tls(&mut stream) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(len) => {
                connection.process_new_packets().map_err(io::Error::other)?;
                Ok(len)
            }
            Err(error) => Err(error),
        }
    };
    match moved {
        Err(error) if !is_idle(&error) => Err(error),
        _ => Ok(()),
    }
}

impl Secured {
    /// Waits for the first message from the other side after the handshake. In TLS 1.3, the handshake is over for a client before
    /// the server has checked its certificate: an error shows that the server rejected it. A server need not say
    /// anything.
    pub fn wait_for_verdict(&self, deadline: Instant) -> io::Result<()> {
        let mut raw = vec![0; PIECE];
        while Instant::now() < deadline {
            let len = match (&self.0.stream).read(&mut raw) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(len) => len,
                Err(error) if is_idle(&error) => continue,
                Err(error) => return Err(error),
            };
            let mut connection = lock(&self.0.connection);
            let mut raw = &raw[..len];
            while !raw.is_empty() {
                connection.read_tls(&mut raw)?;
                connection.process_new_packets().map_err(io::Error::other)?;
            }
            return Ok(());
        }
        Ok(())
    }

    /// The other side's own certificate.
    pub fn peer_certificate(&self) -> Option<CertificateDer<'static>> {
        let connection = lock(&self.0.connection);
        connection.peer_certificates().and_then(|chain| chain.first()).map(|first| first.clone().into_owned())
    }

    /// Its two directions.
    pub fn split(self) -> (Reader, Writer) {
        (Reader { shared: Arc::clone(&self.0), plain: VecDeque::new(), raw: vec![0; PIECE] }, Writer(self.0))
    }
}

/// The direction from the other side.
pub struct Reader {
    shared: Arc<Shared>,
    plain: VecDeque<u8>,
    raw: Vec<u8>,
}

/// The direction to the other side.
pub struct Writer(Arc<Shared>);

impl Read for Reader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        self.decrypt(&[])?;
        if self.plain.is_empty() {
            let len = (&self.shared.stream).read(&mut self.raw)?;
            if len == 0 {
                return Ok(0);
            }
            let raw = std::mem::take(&mut self.raw);
            let decrypted = self.decrypt(&raw[..len]);
            self.raw = raw;
            if decrypted? && self.plain.is_empty() {
                return Ok(0);
            }
            if self.plain.is_empty() {
                // A part of a message, or one of TLS's own.
                return Err(io::ErrorKind::WouldBlock.into());
            }
        }
        self.plain.read(out)
    }
}

impl Reader {
    /// Takes bytes from the socket. Returns whether the other side has said that nothing follows.
    fn decrypt(&mut self, mut raw: &[u8]) -> io::Result<bool> {
        let mut connection = lock(&self.shared.connection);
        loop {
            if !raw.is_empty() {
                connection.read_tls(&mut raw)?;
                connection.process_new_packets().map_err(io::Error::other)?;
            }
            let mut piece = [0; 4096];
            loop {
                match connection.reader().read(&mut piece) {
                    Ok(0) => return Ok(true),
                    Ok(len) => self.plain.extend(&piece[..len]),
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                    Err(error) => return Err(error),
                }
            }
            if raw.is_empty() {
                return Ok(false);
            }
        }
    }
}

impl Write for Writer {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Shared { connection, output, stream } = &*self.0;
        let mut output = lock(output);
        output.send(stream)?;
        let piece = &bytes[..bytes.len().min(PIECE)];
        let mut connection = lock(connection);
        connection.writer().write_all(piece)?;
        while connection.wants_write() {
            connection.write_tls(&mut output.unsent)?;
        }
        drop(connection);
        match output.send(stream) {
            // From here on, sending it is up to us.
            Err(error) if !is_idle(&error) => Err(error),
            _ => Ok(piece.len()),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        let deadline = Instant::now() + FLUSH_TIMEOUT;
        loop {
            match lock(&self.0.output).send(&self.0.stream) {
                Err(error) if is_idle(&error) && Instant::now() < deadline => {}
                sent => return sent,
            }
        }
    }
}

impl Output {
    fn send(&mut self, mut stream: &TcpStream) -> io::Result<()> {
        while !self.unsent.is_empty() {
            let len = stream.write(&self.unsent)?;
            if len == 0 {
                return Err(io::ErrorKind::WriteZero.into());
            }
            self.unsent.drain(..len);
        }
        Ok(())
    }
}

impl Drop for Writer {
    /// Says that nothing follows, which distinguishes a proper end from a cut.
    fn drop(&mut self) {
        let mut output = lock(&self.0.output);
        let mut connection = lock(&self.0.connection);
        connection.send_close_notify();
        while connection.wants_write() {
            if connection.write_tls(&mut output.unsent).is_err() {
                return;
            }
        }
        drop(connection);
        // A peer that does not read does not get it.
        let _ = output.send(&self.0.stream);
    }
}
