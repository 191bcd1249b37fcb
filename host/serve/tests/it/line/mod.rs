//! A UNIX socket read no faster than a slow line would carry it. `cargo xtask bench serve` uses it, too.

use std::io::Read;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

/// A line that carries `bytes_per_s`.
pub struct SlowLine {
    stream: UnixStream,
    bytes_per_s: usize,
    began: Instant,
    taken: usize,
}

impl SlowLine {
    pub fn new(stream: UnixStream, bytes_per_s: usize) -> Self {
        Self { stream, bytes_per_s, began: Instant::now(), taken: 0 }
    }
}

impl Read for SlowLine {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        let due = self.began + Duration::from_secs_f64(self.taken as f64 / self.bytes_per_s as f64);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let most = out.len().min(self.bytes_per_s / 50);
        let len = self.stream.read(&mut out[..most])?;
        self.taken += len;
        Ok(len)
    }
}
