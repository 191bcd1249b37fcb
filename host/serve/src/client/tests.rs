use super::admission::Guest;
use super::*;
use crate::{Board, Settings};
use cantap_wire::message::Role;
use std::io::{self, Write};
use std::sync::mpsc::{Receiver, Sender, channel};

/// Says everything at once, and is there until the server lets it go.
struct AllAtOnce(Vec<u8>);

impl Read for AllAtOnce {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if self.0.is_empty() {
            std::thread::sleep(Duration::from_millis(50));
            return Err(io::ErrorKind::TimedOut.into());
        }
        let len = out.len().min(self.0.len());
        out[..len].copy_from_slice(&self.0[..len]);
        self.0.drain(..len);
        Ok(len)
    }
}

/// Takes a few bytes at a time, and counts the messages in them.
struct Slow {
    told: Sender<()>,
    /// The last byte so far: messages end with a zero, and some begin with one.
    last: u8,
}

impl Write for Slow {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        std::thread::sleep(Duration::from_millis(50));
        let bytes = &bytes[..bytes.len().min(16)];
        for byte in bytes {
            if *byte == 0 && self.last != 0 {
                let _ = self.told.send(());
            }
            self.last = *byte;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn count(messages: &Receiver<()>) -> usize {
    std::iter::from_fn(|| messages.recv().ok()).count()
}

/// Whoever is revoked must not go on for as long as requests wait that came before: a client that hardly reads its answers decides how long.
#[test]
fn requests_that_wait_are_not_carried_out_for_somebody_who_may_not_stay() {
    const REQUESTS: u16 = 250;
    let connect =
        Box::new(|_: Option<&str>| Ok(cantap_virtual::start("load=0".parse().unwrap())?.into_link()));
    let board = Board::start("board", connect, Settings::at(500_000), |_| ()).unwrap();
    let greeting = Command::Hello { protocol: PROTOCOL_VERSION };
    let all = std::iter::once(greeting).chain((0..REQUESTS).map(|_| Command::Time));
    let mut bytes = vec![0];
    for (id, command) in (1..).zip(all) {
        bytes.extend(cantap::device::encode(&Request { id, command }).unwrap());
    }
    assert!(bytes.len() < 4096, "{}: one read", bytes.len());
    let (told, messages) = channel();
    let check = Box::new(|| Err("it is revoked".to_owned()));
    let identity = Some(Identity { certificate: "eve".to_owned(), check });
    let guest = Guest { identity, ..Guest::of_board("eve", Role::Listen) };
    board.admit_guest(AllAtOnce(bytes), Slow { told, last: 0 }, guest).unwrap();
    let count = count(&messages);
    assert!(count > 10 && count < usize::from(REQUESTS), "{count} answers");
}
