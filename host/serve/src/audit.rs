//! A record of who did what with a shared board: one JSON object a line (docs/serve.md). A file that cannot be written to delays nobody: what
//! is missing in it is counted, and said in it as soon as it can be.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use cantap_trace::counted;
use serde_json::{Value, json};

use crate::lock::lock;
use crate::small_file;

/// Lines that wait for the disk.
const MOST_WAITING: usize = 4096;
/// How often a failing file is tried again while nothing happens.
const RETRY_AFTER: Duration = Duration::from_secs(1);

/// By how much the time of day may run away from the time that has passed before it counts as set, and that as a share of the time.
const STEP: Duration = Duration::from_secs(2);
const DRIFT: f64 = 1e-3;

/// The time of day as it was last looked at: whoever sets the clock would change the order of what is recorded unseen.
struct Clock {
    at: Instant,
    utc: SystemTime,
}

impl Clock {
    /// Takes the present time, and returns by how many seconds the clock was set since the last one, if it was.
    fn set_by(&mut self, at: Instant, utc: SystemTime) -> Option<f64> {
        let passed = at.saturating_duration_since(self.at).as_secs_f64();
        let shown = match utc.duration_since(self.utc) {
            Ok(later) => later.as_secs_f64(),
            Err(earlier) => -earlier.duration().as_secs_f64(),
        };
        *self = Self { at, utc };
        let by = shown - passed;
        (by.abs() > STEP.as_secs_f64() + passed * DRIFT).then_some(by)
    }
}

/// Writes to a file until it is dropped.
pub struct Audit {
    clock: Mutex<Clock>,
    lines: Mutex<Option<SyncSender<String>>>,
    /// Lines for which there was no room.
    missing: Arc<AtomicU64>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Audit {
    /// Appends to a file, which only this user can read if it is made here. `trouble` is called with what goes wrong later, once for each
    /// change.
    pub fn open(path: &Path, trouble: impl Fn(String) + Send + 'static) -> io::Result<Self> {
        // A link that is there now is the one that was meant. One that takes the file's place later is not followed.
        let path = if path.is_symlink() { &path.canonicalize()? } else { path };
        let log =
            Log { file: Some(open(path)?), path: path.to_owned(), missing: 0, trouble: Box::new(trouble) };
        let (lines, waiting) = sync_channel(MOST_WAITING);
        let missing = Arc::new(AtomicU64::new(0));
        let counted = Arc::clone(&missing);
        let body = move || log.run(&waiting, &counted);
        let thread = std::thread::Builder::new().name("cantap-audit".to_owned()).spawn(body)?;
        let clock = Mutex::new(Clock { at: Instant::now(), utc: SystemTime::now() });
        Ok(Self { clock, lines: Mutex::new(Some(lines)), missing, thread: Mutex::new(Some(thread)) })
    }

    /// Adds what has happened: an object's members, to which the time is added, and before it that the clock was set. Never waits.
    pub fn note(&self, event: Value) {
        if let Some(by_s) = lock(&self.clock).set_by(Instant::now(), SystemTime::now()) {
            self.add(json!({ "event": "clock_set", "by_s": (by_s * 1e3).round() / 1e3 }));
        }
        self.add(event);
    }

    fn add(&self, mut event: Value) {
        event["time"] = json!(now());
        let taken =
            lock(&self.lines).as_ref().is_some_and(|lines| lines.try_send(format!("{event}\n")).is_ok());
        if !taken {
            self.missing.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Audit {
    /// Waits until everything so far is written. Nothing is added after that.
    pub fn finish(&self) {
        *lock(&self.lines) = None;
        if let Some(thread) = lock(&self.thread).take() {
            let _ = thread.join();
        }
    }
}

impl Drop for Audit {
    fn drop(&mut self) {
        self.finish();
    }
}

/// The thread's side.
struct Log {
    path: PathBuf,
    /// `None` after a failure.
    file: Option<File>,
    /// Lines that could not be written.
    missing: u64,
    trouble: Box<dyn Fn(String) + Send>,
}

impl Log {
    fn run(mut self, waiting: &Receiver<String>, without_room: &AtomicU64) {
        loop {
            let line = match waiting.recv_timeout(RETRY_AFTER) {
                Ok(line) => Some(line),
                Err(RecvTimeoutError::Timeout) => None,
                Err(RecvTimeoutError::Disconnected) => return,
            };
            self.missing += without_room.swap(0, Ordering::Relaxed);
            self.take(line.as_deref());
        }
    }

    /// Writes a line, and before it how many are missing.
    fn take(&mut self, line: Option<&str>) {
        if line.is_none() && self.missing == 0 {
            return;
        }
        let mut text = String::new();
        if self.missing > 0 {
            text = format!("{}\n", json!({ "time": now(), "event": "missing", "lines": self.missing }));
        }
        text.push_str(line.unwrap_or_default());
        match self.write(&text) {
            Ok(()) if self.missing > 0 => {
                let (path, missing) = (self.path.display(), self.missing);
                let lines = counted(missing, "line");
                (self.trouble)(format!("'{path}' is written to again, without {lines}"));
                self.missing = 0;
            }
            Ok(()) => {}
            Err(error) => {
                if self.missing == 0 {
                    let path = self.path.display();
                    (self.trouble)(format!(
                        "'{path}' cannot be written to: {error}; what happens is not recorded until it can"
                    ));
                }
                self.missing += u64::from(line.is_some());
                self.file = None;
            }
        }
    }

    fn write(&mut self, text: &str) -> io::Result<()> {
        // A file that was renamed is left to whoever renamed it.
        let file = match self.file.take().filter(|file| is_at(file, &self.path)) {
            Some(file) => file,
            None => open(&self.path)?,
        };
        let before = file.metadata()?.len();
        if let Err(error) = (&file).write_all(text.as_bytes()) {
            // No half a line: whoever reads it takes each line for an object.
            let _ = file.set_len(before);
            return Err(error);
        }
        self.file = Some(file);
        Ok(())
    }
}

/// A client's name, and what it consists of: the name in its certificate, and its address.
pub(crate) fn who(client: &str) -> Value {
    let parts = client.rsplit_once(' ').filter(|(_, address)| address.parse::<SocketAddr>().is_ok());
    let certificate = match parts {
        Some((name, _)) => name.strip_suffix(AT).map(|name| name.strip_prefix(PAGE_OF).unwrap_or(name)),
        None => client.strip_prefix(PAGE_OF),
    };
    json!({ "client": client, "certificate": certificate, "address": parts.map(|(_, address)| address) })
}

/// Between the name of a client's certificate and its address.
pub(crate) const AT: &str = " at";
/// Before the name of a certificate that is shown by a browser; certificates' names have no blanks.
pub(crate) const PAGE_OF: &str = "page of ";

/// The time as RFC 3339 has it, in UTC.
fn now() -> String {
    format!("{:.3}", jiff::Timestamp::now())
}

fn open(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.create(true).append(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    // Whoever may write in the folder must not have lines appended to another file of this user's.
    small_file::open_itself(path, &mut options)
}

/// Whether a file is still the one at its path.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let (Ok(own), Ok(there)) = (file.metadata(), path.symlink_metadata()) else { return false };
    (own.dev(), own.ino()) == (there.dev(), there.ino())
}

#[cfg(not(unix))]
fn is_at(_: &File, path: &Path) -> bool {
    path.exists()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::channel;

    fn events(path: &Path) -> Vec<String> {
        let text = std::fs::read_to_string(path).unwrap();
        text.lines()
            .map(|line| {
                let object: Value = serde_json::from_str(line).unwrap();
                assert!(object["time"].as_str().is_some_and(|time| time.ends_with('Z')), "{line}");
                object["event"].as_str().unwrap().to_owned()
            })
            .collect()
    }

    #[test]
    fn a_certificates_name_is_found_in_a_clients() {
        for (client, certificate, address) in [
            ("alice at 192.0.2.7:4000", json!("alice"), json!("192.0.2.7:4000")),
            ("page of alice at 192.0.2.7:4000", json!("alice"), json!("192.0.2.7:4000")),
            ("page of alice", json!("alice"), Value::Null),
            ("page 192.0.2.7:4000", Value::Null, json!("192.0.2.7:4000")),
            ("the page", Value::Null, Value::Null),
        ] {
            let expected = json!({ "client": client, "certificate": certificate, "address": address });
            assert_eq!(who(client), expected);
        }
    }

    #[test]
    fn a_file_that_is_renamed_is_followed_by_a_new_one() {
        let folder = tempfile::tempdir().unwrap();
        let (path, old) = (folder.path().join("audit"), folder.path().join("audit.1"));
        let (trouble, _told) = channel();
        let mut log = Log {
            file: None,
            path: path.clone(),
            missing: 0,
            trouble: Box::new(move |text| drop(trouble.send(text))),
        };
        let line = |event: &str| format!("{}\n", json!({ "time": "Z", "event": event }));
        log.take(Some(&line("a")));
        std::fs::rename(&path, &old).unwrap();
        log.take(Some(&line("b")));
        assert_eq!((events(&old), events(&path)), (vec!["a".to_owned()], vec!["b".to_owned()]));
    }

    /// Another user who may write in the folder puts a link there, to a file of this user's.
    #[cfg(unix)]
    #[test]
    fn a_link_that_takes_the_file_s_place_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let [path, old, other] = ["audit", "audit.1", "other"].map(|name| folder.path().join(name));
        let (trouble, told) = channel();
        let audit = Audit::open(&path, move |text| drop(trouble.send(text))).unwrap();
        std::fs::write(&other, "").unwrap();
        std::fs::rename(&path, &old).unwrap();
        std::os::unix::fs::symlink(&other, &path).unwrap();
        audit.note(json!({ "event": "a" }));
        assert!(told.recv().unwrap().contains("a link has taken its place"));
        std::fs::remove_file(&path).unwrap();
        audit.note(json!({ "event": "b" }));
        drop(audit);
        assert_eq!((events(&path), events(&other).len()), (vec!["missing".to_owned(), "b".to_owned()], 0));
        // One that was there at the start is the one that was meant.
        std::fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink(&other, &path).unwrap();
        let audit = Audit::open(&path, |text| panic!("{text}")).unwrap();
        audit.note(json!({ "event": "c" }));
        drop(audit);
        assert_eq!(events(&other), ["c"]);
    }

    /// No disk is full on request, but a folder that is missing has no room either.
    #[test]
    fn what_cannot_be_written_is_counted_and_said_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mounted").join("audit");
        let (trouble, told) = channel();
        let mut log = Log {
            file: None,
            path: path.clone(),
            missing: 0,
            trouble: Box::new(move |text| drop(trouble.send(text))),
        };
        let line = format!("{}\n", json!({ "time": "Z", "event": "opened" }));
        for _ in 0..3 {
            log.take(Some(&line));
        }
        std::fs::create_dir(path.parent().unwrap()).unwrap();
        log.take(Some(&line));
        assert_eq!(events(&path), ["missing", "opened"]);
        assert!(std::fs::read_to_string(&path).unwrap().contains("\"lines\":3"));
        let told: Vec<String> = told.try_iter().collect();
        assert!(told.len() == 2 && told[0].contains("cannot be written to"), "{told:?}");
        assert!(told[1].contains("without 3 lines"), "{told:?}");
    }

    #[test]
    fn a_clock_that_is_set_is_noticed_and_one_that_drifts_is_not() {
        let (at, utc) = (Instant::now(), SystemTime::now());
        let mut clock = Clock { at, utc };
        let later = |s: u64| at + Duration::from_secs(s);
        let day = Duration::from_hours(24);
        assert_eq!(clock.set_by(later(1), utc + Duration::from_secs(2)), None);
        assert_eq!(clock.set_by(later(2), utc - Duration::from_secs(3597)), Some(-3600.0));
        assert_eq!(clock.set_by(later(3), utc - Duration::from_secs(3596)), None);
        assert_eq!(clock.set_by(later(4), utc + Duration::from_secs(5)), Some(3600.0));
        let drifted = utc + Duration::from_secs(5) + day + Duration::from_secs(43);
        assert_eq!(clock.set_by(later(4) + day, drifted), None, "500 ppm");
    }

    /// A name with a line end in it stays within its line.
    #[test]
    fn names_cannot_forge_lines() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let audit = Audit::open(&path, |text| panic!("{text}")).unwrap();
        audit.note(json!({ "event": "came", "client": "x\"}\n{\"event\":\"forged\"" }));
        drop(audit);
        assert_eq!(events(&path), ["came"]);
    }
}
