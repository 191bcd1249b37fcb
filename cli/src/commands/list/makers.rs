//! The channels of makers' libraries. A library may hang, die or write whatever it likes, so each is asked in a process of its own, which ends with it.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use cantap_adapters::{Maker, MakerChannel};
use serde_json::{Value, json};

/// How long a library may take.
const ANSWERS_IN: Duration = Duration::from_secs(4);
/// More than any answer has.
const MOST_BYTES: u64 = 1 << 20;
/// What the line with the answer has; a library may print others.
const ANSWER: &str = "cantap_maker_channels";

/// What the libraries have told.
#[derive(Default)]
pub struct Found {
    /// The channels.
    pub channels: Vec<MakerChannel>,
    /// Channels that have no address here.
    pub without_address: u64,
    /// Libraries that are installed and have not answered: the name, and why.
    pub unusable: Vec<(&'static str, String)>,
}

/// In the process that is started for it: asks one library.
pub fn answer(scheme: &str) -> anyhow::Result<()> {
    let maker = Maker::ALL.into_iter().find(|maker| maker.scheme() == scheme);
    let maker = maker.ok_or_else(|| anyhow::anyhow!("'{scheme}' is no maker's library"))?;
    let answer = match cantap_adapters::maker_channels(maker, None) {
        Ok(found) => {
            let channels: Vec<Value> = found.channels.iter().map(json_of).collect();
            json!({ ANSWER: channels, "without_address": found.without_address })
        }
        Err(error) if error.is_absent() => json!({ ANSWER: [] }),
        Err(error) => json!({ ANSWER: null, "reason": error.to_string() }),
    };
    let mut out = std::io::stdout().lock();
    // On a line of its own, whatever the library has printed.
    writeln!(out, "\n{answer}")?;
    Ok(out.flush()?)
}

/// A channel as scripts get it.
pub fn json_of(channel: &MakerChannel) -> Value {
    json!({
        "device": channel.device,
        "product": channel.product,
        "serial_number": channel.serial_number,
        "can_fd": channel.can_fd,
        "in_use": channel.in_use,
        "is_virtual": channel.is_virtual,
    })
}

/// Asks all libraries that are installed, at the same time.
pub fn find() -> Found {
    let deadline = Instant::now() + ANSWERS_IN;
    let asked: Vec<_> = Maker::ALL.into_iter().map(|maker| (maker, Asked::start(maker))).collect();
    let mut found = Found::default();
    for (maker, asked) in asked {
        let answer = asked.map_err(|error| error.to_string()).and_then(|asked| asked.answer(deadline));
        match answer.and_then(|answer| read(&answer)) {
            Ok((channels, without_address)) => {
                found.channels.extend(channels);
                found.without_address += without_address;
            }
            Err(reason) => found.unusable.push((maker.library(), reason)),
        }
    }
    found
}

/// A process that asks a library.
struct Asked {
    child: Child,
    answer: mpsc::Receiver<Option<Value>>,
}

impl Asked {
    fn start(maker: Maker) -> std::io::Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["list", "--ask-library", maker.scheme()]);
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
        let (done, answer) = mpsc::channel();
        let stdout = child.stdout.take();
        std::thread::spawn(move || {
            let _ = done.send(stdout.and_then(find_answer));
        });
        Ok(Self { child, answer })
    }

    /// The line with the answer, or why there is none.
    fn answer(mut self, deadline: Instant) -> Result<Value, String> {
        let left = deadline.saturating_duration_since(Instant::now());
        let Ok(answer) = self.answer.recv_timeout(left) else {
            // One that hangs in its driver may outlive even this: it is not waited for.
            let _ = self.child.kill();
            return Err(format!("it did not answer within {} s", ANSWERS_IN.as_secs()));
        };
        // What it does at its end is of no interest once it has answered.
        let _ = self.child.kill();
        answer.ok_or_else(|| {
            let ended = self.child.wait().map_or_else(|error| error.to_string(), |status| status.to_string());
            format!("it ended the program that asked it ({ended})")
        })
    }
}

/// The line with the answer. What comes behind it is not waited for.
fn find_answer(stdout: ChildStdout) -> Option<Value> {
    let lines = BufReader::new(stdout.take(MOST_BYTES)).split(b'\n');
    lines.map_while(Result::ok).find_map(|line| {
        serde_json::from_slice::<Value>(&line).ok().filter(|answer| answer.get(ANSWER).is_some())
    })
}

/// Reads an answer.
fn read(answer: &Value) -> Result<(Vec<MakerChannel>, u64), String> {
    let Some(channels) = answer[ANSWER].as_array() else {
        return Err(answer["reason"].as_str().unwrap_or("it gave no reason").to_owned());
    };
    let channel = |value: &Value| {
        let text = |key: &str| value[key].as_str().map(str::to_owned);
        Some(MakerChannel {
            device: text("device")?,
            product: text("product")?,
            serial_number: text("serial_number"),
            can_fd: value["can_fd"].as_bool(),
            in_use: value["in_use"].as_bool(),
            is_virtual: value["is_virtual"].as_bool()?,
        })
    };
    Ok((channels.iter().filter_map(channel).collect(), answer["without_address"].as_u64().unwrap_or(0)))
}
