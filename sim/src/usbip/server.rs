//! The sockets, and the loop that lets time pass between what arrives through them.

use std::io::{self, BufRead, BufReader, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use super::board::Board;
use super::error::Error;
use super::exported::{BUS_ID, Exported};
use super::protocol::{self, Message, Opening};
use super::redir::{Action, Packet, Redir};
use super::script::{self, ServerAction};
use super::urb::Urb;
use super::urbs::Urbs;
use cantap_emu::Setup;
use cantap_emu::elf::Image;

/// How long the machine runs between two checks of the sockets.
const SLICE: Duration = Duration::from_micros(100);
/// How long to wait before checking a kernel that owes reads again.
const STARVED_WAIT: Duration = Duration::from_millis(20);
/// If emulated time is ahead of the wall clock by less, a wait is not worth it.
const LEAST_WAIT: Duration = Duration::from_millis(1);
/// How far the emulation may lag behind the wall clock before it drops the difference.
const MOST_BEHIND: Duration = Duration::from_millis(100);
/// Linux's ECONNRESET: a transfer was withdrawn.
const ECONNRESET: i32 = -104;

enum Event {
    Import(TcpStream, u64),
    Submit(u64, Urb),
    Unlink {
        connection: u64,
        seq: u32,
        victim: u32,
    },
    /// QEMU waits for a device.
    Waits(TcpStream, u64),
    Redir(u64, Packet),
    Gone(u64),
    Line(String, TcpStream),
}

/// Who has the device.
struct Kernel {
    connection: u64,
    stream: TcpStream,
    /// The usbredir state for QEMU; without it, this is USB/IP.
    redir: Option<Redir>,
}

/// Serves the board to kernels on this computer, one at a time, until a line says `quit`. The ports are written to
/// `folder/ports`, as variables of a shell: USBIP for `usbip attach`, REDIR for QEMU's `usb-redir`, CONTROL for lines.
pub fn serve(image: Image, setup: Setup, folder: &Path) -> Result<(), Error> {
    let mut board = Board::new(image, setup);
    let exported = Arc::new(board.look()?);
    let usbip = TcpListener::bind("127.0.0.1:0")?;
    let (redir, control) = (TcpListener::bind("127.0.0.1:0")?, TcpListener::bind("127.0.0.1:0")?);
    let port = |listener: &TcpListener| listener.local_addr().map(|address| address.port());
    let ports = format!("USBIP={}\nREDIR={}\nCONTROL={}\n", port(&usbip)?, port(&redir)?, port(&control)?);
    let (to, events) = channel();
    listen_to_kernels(usbip, Arc::clone(&exported), to.clone());
    listen_to_qemu(redir, to.clone());
    listen_to_lines(control, to);
    std::fs::write(folder.join("ports"), ports)?;
    let folder = folder.to_owned();
    Server {
        board,
        exported,
        folder,
        kernel: None,
        last: 0,
        taken_back: Vec::new(),
        waits: None,
        client_pace: true,
        quit: false,
    }
    .run(&events)
}

fn listen_to_kernels(listener: TcpListener, exported: Arc<Exported>, to: Sender<Event>) {
    thread::spawn(move || {
        for (stream, n) in listener.incoming().flatten().zip(1..) {
            let (to, exported, connection) = (to.clone(), Arc::clone(&exported), 2 * n);
            thread::spawn(move || {
                // A broken connection means that the kernel is gone.
                let _ = follow_kernel(stream, connection, &exported, &to);
                let _ = to.send(Event::Gone(connection));
            });
        }
    });
}

/// One connection of a kernel or its tools: a list, or an import and then transfers.
fn follow_kernel(
    mut stream: TcpStream,
    connection: u64,
    exported: &Exported,
    to: &Sender<Event>,
) -> io::Result<()> {
    stream.set_nodelay(true)?;
    match protocol::read_opening(&mut stream)? {
        Opening::List => return stream.write_all(&protocol::list(exported)),
        Opening::Import(name) if name == BUS_ID => {
            let _ = to.send(Event::Import(stream.try_clone()?, connection));
        }
        Opening::Import(_) => return stream.write_all(&protocol::imported(None)),
    }
    loop {
        // The loop below only ends before this when the whole program ends.
        let _ = to.send(match protocol::read_message(&mut stream)? {
            Message::Submit(urb) => Event::Submit(connection, urb),
            Message::Unlink { seq, victim } => Event::Unlink { connection, seq, victim },
        });
    }
}

/// Connections of QEMU have odd numbers, those of kernels even ones.
fn listen_to_qemu(listener: TcpListener, to: Sender<Event>) {
    thread::spawn(move || {
        for (stream, n) in listener.incoming().flatten().zip(0..) {
            let (to, connection) = (to.clone(), 2 * n + 1);
            thread::spawn(move || {
                // A broken connection means that QEMU is gone.
                let _ = follow_qemu(stream, connection, &to);
                let _ = to.send(Event::Gone(connection));
            });
        }
    });
}

fn follow_qemu(mut stream: TcpStream, connection: u64, to: &Sender<Event>) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let _ = to.send(Event::Waits(stream.try_clone()?, connection));
    loop {
        let _ = to.send(Event::Redir(connection, Packet::read(&mut stream)?));
    }
}

fn listen_to_lines(listener: TcpListener, to: Sender<Event>) {
    thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let to = to.clone();
            thread::spawn(move || {
                let Ok(reader) = stream.try_clone() else { return };
                for line in BufReader::new(reader).lines().map_while(Result::ok) {
                    let Ok(stream) = stream.try_clone() else { return };
                    let _ = to.send(Event::Line(line, stream));
                }
            });
        }
    });
}

struct Server {
    board: Board,
    exported: Arc<Exported>,
    folder: PathBuf,
    kernel: Option<Kernel>,
    /// The last transfer that arrived.
    last: u32,
    /// Transfers that were withdrawn before they arrived: Linux's `vhci_hcd` sends withdrawals and submissions from two lists, and may
    /// look at the first while the second is being filled.
    taken_back: Vec<u32>,
    /// The QEMU that waits for a device.
    waits: Option<(TcpStream, u64)>,
    client_pace: bool,
    quit: bool,
}

impl Server {
    fn run(mut self, events: &Receiver<Event>) -> Result<(), Error> {
        let mut due = Instant::now();
        while !self.quit {
            while let Ok(event) = events.try_recv() {
                self.handle(event)?;
            }
            if self.stands_still() {
                let from = Instant::now();
                if !self.wait(events, STARVED_WAIT)? {
                    return Ok(());
                }
                self.board.starved(from.elapsed());
                due = Instant::now();
                continue;
            }
            self.board.run(self.board.clock().us(SLICE.as_micros() as u64))?;
            self.deliver();
            if self.kernel.is_some() && !self.board.with_urbs(|urbs| urbs.is_present()) {
                // The device removed its pull-up: a reset, or the bootloader.
                self.cut();
            }
            due += SLICE;
            let now = Instant::now();
            match due.checked_duration_since(now) {
                Some(ahead) if ahead > LEAST_WAIT && !self.wait(events, ahead)? => return Ok(()),
                None if now - due > MOST_BEHIND => due = now,
                _ => {}
            }
        }
        Ok(())
    }

    /// Handles what arrives within a time; false if nothing more can arrive.
    fn wait(&mut self, events: &Receiver<Event>, time: Duration) -> Result<bool, Error> {
        match events.recv_timeout(time) {
            Ok(event) => self.handle(event).map(|()| true),
            Err(RecvTimeoutError::Timeout) => Ok(true),
            Err(RecvTimeoutError::Disconnected) => Ok(false),
        }
    }

    /// Whether time stands still: the kernel sets the pace, owes reads, and waits for nothing that takes time.
    fn stands_still(&self) -> bool {
        self.kernel.is_some()
            && self.client_pace
            && self.board.with_urbs(|urbs| urbs.is_starved() && !urbs.waits_for_time())
    }

    fn handle(&mut self, event: Event) -> Result<(), Error> {
        let is_kernel =
            |connection: u64| self.kernel.as_ref().is_some_and(|kernel| kernel.connection == connection);
        match event {
            Event::Import(stream, connection) => self.import(stream, connection)?,
            Event::Submit(connection, urb) if is_kernel(connection) => {
                self.last = urb.seq;
                if !self.taken_back.contains(&urb.seq) {
                    self.submit(urb);
                }
            }
            Event::Unlink { connection, seq, victim } if is_kernel(connection) => {
                self.deliver();
                let early = victim > self.last;
                if early {
                    self.taken_back.push(victim);
                }
                let status = if self.unlink(victim) || early { ECONNRESET } else { 0 };
                self.tell(&protocol::unlinked(seq, status));
            }
            Event::Redir(connection, packet) if is_kernel(connection) => self.follow(packet),
            Event::Waits(stream, connection) => self.waits = Some((stream, connection)),
            Event::Gone(connection) if is_kernel(connection) => self.cut(),
            Event::Gone(connection) => drop(self.waits.take_if(|waits| waits.1 == connection)),
            Event::Submit(..) | Event::Unlink { .. } | Event::Redir(..) => {}
            Event::Line(line, mut stream) => {
                let answer = match script::obey(&line, &mut self.board, &self.folder) {
                    Ok(action) => {
                        self.perform(action)?;
                        script::figures(&self.board)
                    }
                    Err(error) => format!("error: {error}"),
                };
                // A client that does not wait for the answer does not want it.
                let _ = writeln!(stream, "{answer}");
            }
        }
        Ok(())
    }

    fn submit(&mut self, urb: Urb) {
        self.board.with_host(|host, otg| {
            // The kernel resumes a port without announcing it; the first thing it sends then is a request.
            if urb.is_control() {
                host.resume(otg);
            }
            host.driver().submit(urb);
        });
    }

    /// Withdraws a transfer; returns whether it was still pending.
    fn unlink(&mut self, victim: u32) -> bool {
        self.board.with_host(|host, _| {
            let pending = host.driver().unlink(victim);
            if pending {
                host.abandon_transaction();
            }
            pending
        })
    }

    /// Does what QEMU asks for.
    fn follow(&mut self, packet: Packet) {
        self.deliver();
        if let Some(answer) = Redir::acknowledge(&packet) {
            self.tell(&answer);
        }
        let Some(redir) = self.kernel.as_mut().and_then(|kernel| kernel.redir.as_mut()) else { return };
        match redir.take(packet) {
            Some(Action::Submit(urb)) => self.submit(urb),
            Some(Action::Unlink(seq)) => {
                if self.unlink(seq)
                    && let Some(redir) = self.kernel.as_mut().and_then(|kernel| kernel.redir.as_mut())
                {
                    let answer = redir.cancelled(seq);
                    self.tell(&answer);
                }
            }
            Some(Action::Reset) => self.board.with_urbs(Urbs::reset),
            None => {}
        }
    }

    fn redirect(&mut self) -> Result<(), Error> {
        let Some((stream, connection)) = self.waits.take_if(|_| self.kernel.is_none()) else { return Ok(()) };
        if self.board.plug_in()? {
            let redir = Redir::new((*self.exported).clone());
            let greeting = redir.greeting();
            self.kernel = Some(Kernel { connection, stream, redir: Some(redir) });
            self.tell(&greeting);
        }
        Ok(())
    }

    fn perform(&mut self, action: ServerAction) -> Result<(), Error> {
        match action {
            ServerAction::None => {}
            ServerAction::Redirect => self.redirect()?,
            ServerAction::ClientPace(client_pace) => self.client_pace = client_pace,
            ServerAction::Unplug => self.cut(),
            ServerAction::Quit => self.quit = true,
        }
        Ok(())
    }

    fn import(&mut self, mut stream: TcpStream, connection: u64) -> Result<(), Error> {
        let up = self.kernel.is_none() && self.board.plug_in()?;
        let reply = protocol::imported(up.then_some(&*self.exported));
        if stream.write_all(&reply).is_ok() && up {
            (self.last, self.taken_back) = (0, Vec::new());
            self.kernel = Some(Kernel { connection, stream, redir: None });
        } else {
            let _ = stream.shutdown(Shutdown::Both);
        }
        Ok(())
    }

    /// Sends the kernel the transfers that have ended.
    fn deliver(&mut self) {
        let completed = self.board.with_urbs(Urbs::take_completed);
        let Some(kernel) = &mut self.kernel else { return };
        let (mut bytes, mut again) = (Vec::new(), Vec::new());
        for completion in &completed {
            match &mut kernel.redir {
                None => bytes.extend(protocol::submitted(completion)),
                Some(redir) => {
                    let (answer, next) = redir.ended(completion);
                    bytes.extend(answer);
                    again.extend(next);
                }
            }
        }
        if !bytes.is_empty() {
            self.tell(&bytes);
        }
        for urb in again {
            self.submit(urb);
        }
    }

    fn tell(&mut self, bytes: &[u8]) {
        if self.kernel.as_mut().is_some_and(|kernel| kernel.stream.write_all(bytes).is_err()) {
            self.cut();
        }
    }

    /// The cable is out, and the connection ends. Pending transfers are not answered: see `Urbs::submit`.
    fn cut(&mut self) {
        if let Some(Kernel { stream, .. }) = self.kernel.take() {
            let _ = stream.shutdown(Shutdown::Both);
        }
        self.board.unplug();
    }
}
