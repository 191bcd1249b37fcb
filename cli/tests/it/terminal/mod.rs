//! The command in a terminal, as users have it: keys go in, a screen comes out.

use std::io::{Read, Write};
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use portable_pty::{Child, CommandBuilder, MasterPty, PtySize, native_pty_system};

/// Longer than anything awaited takes, however busy the machine.
const PATIENCE: Duration = Duration::from_mins(1);

/// A running `cantap` and its terminal.
pub struct Terminal {
    child: Box<dyn Child + Send + Sync>,
    /// Our end, and a way to type into it, until the window is closed.
    ours: Option<(Box<dyn MasterPty + Send>, Box<dyn Write + Send>)>,
    parser: Arc<Mutex<vt100::Parser>>,
    stalled: Arc<AtomicBool>,
    closed: Arc<AtomicBool>,
}

fn size((columns, rows): (u16, u16)) -> PtySize {
    PtySize { rows, cols: columns, pixel_width: 0, pixel_height: 0 }
}

impl Terminal {
    /// Starts `cantap ARGUMENTS` in a terminal of this many columns and rows.
    pub fn start(arguments: &str, columns_rows: (u16, u16)) -> Self {
        Self::start_with(arguments, columns_rows, &[])
    }

    /// With changes to the environment: a variable's value, or `None` to remove it.
    pub fn start_with(
        arguments: &str,
        columns_rows: (u16, u16),
        environment: &[(&str, Option<&str>)],
    ) -> Self {
        let mut command = CommandBuilder::new(env!("CARGO_BIN_EXE_cantap"));
        command.args(arguments.split_whitespace());
        Self::of(command, columns_rows, environment)
    }

    /// With what a line for the shell writes as its standard input.
    pub fn start_behind(line: &str, arguments: &str, columns_rows: (u16, u16)) -> Self {
        let mut command = CommandBuilder::new("sh");
        command.args(["-c", &format!("{{ {line}; }} | {} {arguments}", env!("CARGO_BIN_EXE_cantap"))]);
        Self::of(command, columns_rows, &[])
    }

    fn of(
        mut command: CommandBuilder,
        columns_rows: (u16, u16),
        environment: &[(&str, Option<&str>)],
    ) -> Self {
        let pair = native_pty_system().openpty(size(columns_rows)).unwrap();
        command.cwd(Path::new(env!("CARGO_MANIFEST_DIR")));
        command.env("TERM", "xterm-256color");
        command.env("LC_ALL", "C.UTF-8");
        command.env_remove("NO_COLOR");
        // No test depends on what another one found, and none writes into the user's folder.
        command.env("XDG_CACHE_HOME", "/dev/null");
        for (name, value) in environment {
            match value {
                Some(value) => command.env(name, value),
                None => command.env_remove(name),
            }
        }
        let child = pair.slave.spawn_command(command).unwrap();
        drop(pair.slave);
        let mut reader = pair.master.try_clone_reader().unwrap();
        let parser = Arc::new(Mutex::new(vt100::Parser::default()));
        parser
            .lock()
            .unwrap()
            .set_size(columns_rows.1.try_into().unwrap(), columns_rows.0.try_into().unwrap());
        let stalled = Arc::new(AtomicBool::new(false));
        let closed = Arc::new(AtomicBool::new(false));
        let (screen, waits, ends) = (Arc::clone(&parser), Arc::clone(&stalled), Arc::clone(&closed));
        std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            while !ends.load(Ordering::Relaxed) {
                while waits.load(Ordering::Relaxed) {
                    std::thread::sleep(Duration::from_millis(5));
                }
                match reader.read(&mut bytes) {
                    Ok(len) if len > 0 => screen.lock().unwrap().process(&bytes[..len]),
                    _ => return,
                }
            }
        });
        let writer = pair.master.take_writer().unwrap();
        Self { child, ours: Some((pair.master, writer)), parser, stalled, closed }
    }

    /// Closes the window: the program no longer has a terminal.
    pub fn close(&mut self) {
        // The reader ends after its next read, and with it the last of our ends.
        self.closed.store(true, Ordering::Relaxed);
        self.ours = None;
    }

    /// Types.
    pub fn keys(&mut self, keys: &str) {
        let (_, writer) = self.ours.as_mut().unwrap();
        writer.write_all(keys.as_bytes()).unwrap();
        writer.flush().unwrap();
    }

    /// The text on the screen.
    pub fn text(&self) -> String {
        self.parser.lock().unwrap().screen().contents()
    }

    /// Examines the screen as the terminal shows it.
    pub fn screen<T>(&self, look: impl Fn(&vt100::Screen) -> T) -> T {
        look(self.parser.lock().unwrap().screen())
    }

    /// Waits until the screen contains this text, and returns the whole screen.
    pub fn wait_for(&self, text: &str) -> String {
        self.wait_until(text, |screen| screen.contains(text))
    }

    /// Waits until the screen meets a condition.
    pub fn wait_until(&self, what: &str, is_so: impl Fn(&str) -> bool) -> String {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let text = self.text();
            if is_so(&text) {
                return text;
            }
            assert!(Instant::now() < deadline, "this never came: {what}; the screen:\n{text}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Changes the size.
    pub fn resize(&self, columns_rows: (u16, u16)) {
        let (columns, rows) = columns_rows;
        self.parser.lock().unwrap().set_size(rows.try_into().unwrap(), columns.try_into().unwrap());
        self.ours.as_ref().unwrap().0.resize(size(columns_rows)).unwrap();
    }

    /// Makes the terminal stop taking output, or resume.
    pub fn stall(&self, stalled: bool) {
        self.stalled.store(stalled, Ordering::Relaxed);
    }

    /// Sends a signal, by name.
    pub fn signal(&self, name: &str) {
        let process = self.child.process_id().unwrap().to_string();
        assert!(Command::new("kill").args(["-s", name, &process]).status().unwrap().success());
    }

    /// Whether the terminal waits for whole lines and echoes them, as for a shell.
    pub fn is_as_a_shell_wants_it(&self) -> bool {
        let local = format!("{:?}", self.ours.as_ref().unwrap().0.get_termios().unwrap().local_flags);
        local.contains("ICANON") && local.contains("ECHO")
    }

    /// Waits for the end; returns the exit code.
    pub fn end(&mut self) -> u32 {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                // Its last output is on its way.
                std::thread::sleep(Duration::from_millis(100));
                return status.exit_code();
            }
            assert!(Instant::now() < deadline, "it does not end; the screen:\n{}", self.text());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Checks that the previous screen is back: cursor shown, no mouse, lines and echo.
    pub fn check_given_back(&self) {
        self.screen(|screen| {
            assert!(!screen.alternate_screen() && !screen.hide_cursor(), "{}", screen.contents());
            assert_eq!(screen.mouse_protocol_mode(), vt100::MouseProtocolMode::None);
        });
        assert!(self.is_as_a_shell_wants_it());
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        // It may have ended long ago.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
