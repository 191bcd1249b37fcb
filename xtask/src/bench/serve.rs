//! One board and eight clients on two saturated channels, and beside them a program that speaks socketcand: what the server consumes, how much
//! delay it adds, and whether each client gets everything or has its losses counted.

mod socketcand;

#[path = "../../../host/serve/tests/it/line/mod.rs"]
mod line;

use std::io::{BufRead, BufReader};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};
use cantap::device::{ChannelCounters, Device, Link};
use cantap_wire::Channel;
use line::SlowLine;
use xshell::cmd;

use crate::workspace;

const BITRATE_BPS: u32 = 1_000_000;
/// Clients that read as fast as they can.
const QUICK: usize = 6;
/// Clients on a slow line, which carries half of what two such channels need.
const SLOW: usize = 2;
const SLOW_BYTES_PER_S: usize = 100_000;
/// A read or write of a socket returns after this time at the latest.
const SOCKET_TIMEOUT: Duration = Duration::from_millis(50);
/// Most ages of records that are kept for the table.
const MOST_AGES: usize = 1 << 20;

/// A running program, which is ended when this is dropped.
struct Running {
    child: Child,
    /// The first lines that it wrote.
    lines: Vec<String>,
}

impl Running {
    fn start(binary: &Path, arguments: &[&str], lines: usize) -> Result<Self> {
        let mut child =
            Command::new(binary).args(arguments).stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
        let output = BufReader::new(child.stdout.take().context("no output")?).lines();
        let written: Vec<String> = output.take(lines).collect::<Result<_, _>>()?;
        ensure!(written.len() == lines, "`cantap {}` ended", arguments.join(" "));
        Ok(Self { child, lines: written })
    }

    /// Seconds of processor time so far.
    fn processor_s(&self) -> Result<f64> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id()))?;
        let (_, fields) = stat.rsplit_once(')').context("/proc/PID/stat")?;
        let ticks: Vec<f64> =
            fields.split_whitespace().skip(11).take(2).map(str::parse).collect::<Result<_, _>>()?;
        // USER_HZ is always 100 on Linux.
        Ok(ticks.iter().sum::<f64>() / 100.0)
    }

    /// A line of `/proc/PID/status`, in MB.
    fn memory_mb(&self, name: &str) -> Result<f64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line = status.lines().find(|line| line.starts_with(name)).context("/proc/PID/status")?;
        let kib: f64 = line.split_whitespace().nth(1).context("/proc/PID/status")?.parse()?;
        Ok(kib * 1024.0 / 1e6)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What one client received.
struct Outcome {
    channels: [ChannelCounters; 2],
    /// How old records were on arrival, in seconds: the current time minus theirs.
    ages: Vec<f64>,
}

/// Listens on both channels until `is_over`.
fn listen(device: &Device, is_over: &AtomicBool) -> Result<Outcome> {
    for channel in Channel::ALL {
        device.listen(channel, BITRATE_BPS)?;
    }
    let mut records = device.records();
    let mut ages = Vec::new();
    let began = Instant::now();
    while !is_over.load(Ordering::Relaxed) {
        let Some(batch) = records.next_batch(SOCKET_TIMEOUT)? else { break };
        let now_ns = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as i64;
        // The clock is not determined until after the first seconds.
        if let Some(last) =
            batch.last().filter(|_| began.elapsed() > Duration::from_secs(3) && ages.len() < MOST_AGES)
        {
            ages.push((now_ns - last.time_ns) as f64 / 1e9);
        }
        records.recycle(batch);
    }
    device.stop()?;
    while records.next_batch(SOCKET_TIMEOUT)?.is_some() {}
    Ok(Outcome { channels: device.counters().channels, ages })
}

fn client(socket: &str, name: &str, is_slow: bool) -> Result<Device> {
    let stream = UnixStream::connect(socket)?;
    stream.set_read_timeout(Some(SOCKET_TIMEOUT))?;
    stream.set_write_timeout(Some(SOCKET_TIMEOUT))?;
    let writer = stream.try_clone()?;
    let link = if is_slow {
        Link::new(SlowLine::new(stream, SLOW_BYTES_PER_S), writer)
    } else {
        Link::new(stream, writer)
    };
    Ok(Device::over(link, name)?)
}

/// The median, the 99th percentile and the largest, in milliseconds.
fn quantiles(mut ages: Vec<f64>) -> [f64; 3] {
    ages.sort_by(f64::total_cmp);
    let at = |share: f64| ages.get((ages.len() as f64 * share) as usize).copied().unwrap_or(f64::NAN) * 1e3;
    [at(0.5), at(0.99), ages.last().copied().unwrap_or(f64::NAN) * 1e3]
}

/// Runs it for this long.
pub fn run(seconds: u32) -> Result<()> {
    let shell = workspace::shell()?;
    // Built as this program is: in release mode, unless somebody runs it otherwise.
    let (profile, folder) = if cfg!(debug_assertions) { ("dev", "debug") } else { ("release", "release") };
    if folder == "release" || !workspace::target().join("debug/cantap").exists() {
        cmd!(shell, "cargo build --profile {profile} --quiet -p cantap-cli").quiet().run()?;
    }
    let binary = workspace::target().join(folder).join("cantap");
    let scratch = tempfile::tempdir()?;
    let socket = scratch.path().join("cantap.sock").display().to_string();
    let board = Running::start(&binary, &["virtual", "load=100,frames=std0,bitrate=1M"], 1)?;
    let port = &board.lines[0];
    // One program at the port, without a server.
    let is_over = AtomicBool::new(false);
    let alone = std::thread::scope(|scope| {
        let listening = scope.spawn(|| listen(&Device::open(port)?, &is_over));
        std::thread::sleep(Duration::from_secs(u64::from(seconds / 10).clamp(8, 30)));
        is_over.store(true, Ordering::Relaxed);
        listening.join().map_err(|_| anyhow::anyhow!("the client panicked"))?
    })?;
    let arguments = ["serve", "-d", port, "-b", "1M", "--unix", &socket, "--socketcand", "127.0.0.1:0"];
    let server = Running::start(&binary, &arguments, 2)?;
    let place = server.lines[1].strip_prefix("can://").context("no address of socketcand")?;
    let is_over = AtomicBool::new(false);
    let (before, began) = (server.processor_s()?, Instant::now());
    let (outcomes, foreign, processor, measured_s) = std::thread::scope(|scope| {
        let foreign = scope.spawn(|| socketcand::read(place, &is_over));
        let clients: Vec<_> = (0..QUICK + SLOW)
            .map(|number| {
                let (socket, is_over) = (&socket, &is_over);
                scope.spawn(move || {
                    let name = format!("client {}", number + 1);
                    listen(&client(socket, &name, number >= QUICK)?, is_over)
                })
            })
            .collect();
        std::thread::sleep(Duration::from_secs(seconds.into()));
        let measured_s = began.elapsed().as_secs_f64();
        let processor = server.processor_s();
        is_over.store(true, Ordering::Relaxed);
        let outcomes: Vec<_> = clients.into_iter().map(std::thread::ScopedJoinHandle::join).collect();
        let foreign = foreign.join().map_err(|_| anyhow::anyhow!("the reader of socketcand panicked"));
        (outcomes, foreign, processor, measured_s)
    });
    let share = (processor? - before) / measured_s * 100.0;
    println!(
        "serve: {} clients, {SLOW} of them behind a line of {SLOW_BYTES_PER_S} B/s, two channels at 100 % of standard frames without \
         data, {measured_s:.0} s, a {profile} build",
        QUICK + SLOW
    );
    println!(
        "{:<10} {:>12} {:>12} {:>12} {:>12} {:>12} {:>12}",
        "client", "arrived", "delivered", "lost, host", "age, ms", "99 %", "most"
    );
    let row = |name: &str, Outcome { channels, ages }: Outcome| {
        let sum = |of: fn(&ChannelCounters) -> u64| channels.iter().map(of).sum::<u64>();
        let [median, p99, most] = quantiles(ages);
        println!(
            "{name:<10} {:>12} {:>12} {:>12} {median:>12.2} {p99:>12.2} {most:>12.2}",
            sum(|of| of.received),
            sum(ChannelCounters::delivered),
            sum(|of| of.lost_host),
        );
        let elsewhere = sum(ChannelCounters::lost) - sum(|of| of.lost_host);
        (sum(|of| of.received), sum(|of| of.lost_host), elsewhere)
    };
    row("alone", alone);
    let mut faults = Vec::new();
    for (number, outcome) in (1..).zip(outcomes) {
        let outcome = outcome.map_err(|_| anyhow::anyhow!("a client panicked"))??;
        let is_slow = number > QUICK;
        let name = if is_slow { format!("{number}, slow") } else { number.to_string() };
        let (received, lost, elsewhere) = row(&name, outcome);
        if elsewhere > 0 || (lost > 0) != is_slow {
            faults.push(format!(
                "client {number} of {received}: {lost} lost at the host, {elsewhere} elsewhere"
            ));
        }
    }
    let socketcand::Outcome { frames, ages } = foreign??;
    let [median, p99, most] = quantiles(ages);
    println!(
        "{:<10} {frames:>12} {:>12} {:>12} {median:>12.2} {p99:>12.2} {most:>12.2}",
        "socketcand", "", ""
    );
    println!(
        "the server: {share:.1} % of a core, {:.1} MB at most, {:.1} MB at the end",
        server.memory_mb("VmHWM")?,
        server.memory_mb("VmRSS")?
    );
    ensure!(faults.is_empty(), "{}", faults.join("\n"));
    Ok(())
}
