//! A serial port with a stand-in at its other end.

use std::fs::File;
use std::io::{self, ErrorKind, Read};
use std::net::{SocketAddr, TcpListener};
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::fs::OFlags;
use rustix::termios::OptionalActions;
use rustix_openpty::{Pty, openpty};

pub struct Port {
    pub path: String,
    other_end: File,
    /// Keeps the port from looking closed before it is opened.
    user: OwnedFd,
    pulled: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

/// Writes all of it to a port that may have no room now.
fn write(mut port: &File, bytes: &[u8]) {
    cantap::device::write_patiently(&mut port, bytes, Duration::from_secs(10)).unwrap();
}

impl Port {
    /// A port whose other end answers each byte.
    pub fn start(mut answer: impl FnMut(u8) -> Vec<u8> + Send + 'static) -> Self {
        let Pty { controller, user } = openpty(None, None).unwrap();
        let mut modes = rustix::termios::tcgetattr(&user).unwrap();
        modes.make_raw();
        rustix::termios::tcsetattr(&user, OptionalActions::Now, &modes).unwrap();
        let path = rustix::termios::ttyname(&user, Vec::new()).unwrap().into_string().unwrap();
        let flags = rustix::fs::fcntl_getfl(&controller).unwrap();
        rustix::fs::fcntl_setfl(&controller, flags | OFlags::NONBLOCK).unwrap();
        let port = File::from(controller);
        let pulled = Arc::new(AtomicBool::new(false));
        let mut own = port.try_clone().unwrap();
        let quit = Arc::clone(&pulled);
        let thread = std::thread::spawn(move || {
            let mut byte = [0];
            while !quit.load(Ordering::Relaxed) {
                match own.read(&mut byte) {
                    Ok(0) => return,
                    Ok(_) => write(&own, &answer(byte[0])),
                    Err(error) if error.kind() == ErrorKind::WouldBlock => {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    Err(_) => return,
                }
            }
        });
        Self { path, other_end: port, user, pulled, thread }
    }

    /// Passes on what one client writes, and what the stand-in says.
    pub fn serve(&self) -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let port = File::options().read(true).write(true).open(&self.path).unwrap();
        std::thread::spawn(move || {
            let Ok((client, _)) = listener.accept() else { return };
            let (mut from_client, mut to_port) = (client.try_clone().unwrap(), port.try_clone().unwrap());
            std::thread::spawn(move || io::copy(&mut from_client, &mut to_port));
            let _ = io::copy(&mut &port, &mut &client);
        });
        address
    }

    /// It is gone, with its other end.
    pub fn pull(self) {
        self.pulled.store(true, Ordering::Relaxed);
        self.thread.join().unwrap();
        drop((self.other_end, self.user));
    }

    pub fn says(&self, bytes: impl AsRef<[u8]>) {
        write(&self.other_end, bytes.as_ref());
    }
}
