//! Reading and writing objects.

use std::io::Write as _;

use anyhow::{Context, anyhow, ensure};
use cantap::{TraceEvent, TraceRecord};
use cantap_protocols::active::sdo::{SdoClient, SdoError, SdoIds, SdoJob};
use cantap_protocols::canopen::{CanOpen, Sheet, encode, known_type, type_named};
use cantap_protocols::iso_tp::Pair;
use cantap_protocols::{Assembler, Event, EventKind};

use crate::speak_args::SpeakArgs;
use crate::usage_error::usage;
use cantap_work::speaking::Speaking;

/// How long to wait.
#[derive(Clone, Copy)]
pub(super) struct Times {
    /// For each answer.
    pub timeout_ns: u64,
    /// For all of it.
    pub patience_ns: u64,
}

/// Which object, and how.
#[derive(clap::Args)]
struct Place {
    /// The node, 1 to 127.
    #[arg(value_parser = super::node)]
    node: u8,
    /// The object's index in hexadecimal, as 1018.
    #[arg(value_parser = index)]
    index: u16,
    /// By block transfer: up to 127 frames for one answer. Not every node supports it.
    #[arg(long)]
    block: bool,
    /// The identifiers of the SDO channel, if not the node's usual ones: the request's and the answer's, as 605:585.
    #[arg(long, value_name = "ID:ID", value_parser = channel)]
    sdo: Option<Pair>,
}

/// The command line of reading.
#[derive(clap::Args)]
pub(super) struct ReadObject {
    #[command(flatten)]
    place: Place,
    /// Its sub-index in hexadecimal.
    #[arg(value_parser = sub, default_value = "0")]
    sub: u8,
    /// Write the object's bytes to this file.
    #[arg(short, long, value_name = "FILE")]
    output: Option<std::path::PathBuf>,
}

/// The command line of writing.
#[derive(clap::Args)]
pub(super) struct WriteObject {
    #[command(flatten)]
    place: Place,
    /// Its sub-index in hexadecimal.
    #[arg(value_parser = sub)]
    sub: u8,
    /// The value, as its type requires: 1500, 0x5DC, -3, 1.5, a text; @FILE for a file's bytes.
    #[arg(allow_hyphen_values = true)]
    value: String,
    /// Its type, if no sheet gives it: bool, u8 to u64, i8 to i64, f32, f64, text, utf16, hex.
    #[arg(long = "type", value_name = "TYPE")]
    data_type: Option<String>,
}

/// The identifiers of an SDO channel.
fn channel(text: &str) -> Result<Pair, String> {
    let pair: Option<Pair> = text.parse().ok();
    let is_plain = |pair: &Pair| pair.a.address.is_none() && pair.b.address.is_none();
    pair.filter(is_plain).ok_or_else(|| "write two different identifiers, as 605:585".to_owned())
}

fn index(text: &str) -> Result<u16, String> {
    u16::from_str_radix(text.trim_start_matches("0x"), 16)
        .map_err(|_| "write up to four hexadecimal digits, as 1018".to_owned())
}

fn sub(text: &str) -> Result<u8, String> {
    u8::from_str_radix(text.trim_start_matches("0x"), 16)
        .map_err(|_| "write up to two hexadecimal digits, as 4".to_owned())
}

impl Place {
    fn ids(&self) -> SdoIds {
        self.sdo
            .map_or_else(|| SdoIds::of(self.node), |pair| SdoIds { request: pair.a.id, response: pair.b.id })
    }

    /// Reads the conversation, whatever its identifiers.
    fn witness(&self, sheets: Vec<Sheet>) -> Box<dyn Assembler> {
        let witness = Box::new(CanOpen::new(sheets));
        match self.sdo {
            None => witness,
            Some(_) => Box::new(Renamed { inner: witness, from: self.ids(), to: SdoIds::of(self.node) }),
        }
    }

    fn is_ours(&self, event: &Event) -> bool {
        matches!(event.kind, EventKind::SdoRead | EventKind::SdoWrite)
            && event
                .field("index")
                .is_some_and(|index| index.value.as_number() == Some(f64::from(self.index)))
    }

    fn transfer(
        &self,
        speaking: &mut Speaking<'_>,
        sub: u8,
        job: SdoJob,
        times: Times,
    ) -> anyhow::Result<Vec<u8>> {
        let mut client = SdoClient::new(self.ids(), self.index, sub, job, self.block, times.timeout_ns);
        client.set_patience(times.patience_ns);
        speaking.run(&mut client)?;
        speaking.show(|event| self.is_ours(event))?;
        client.finish().map_err(|error| {
            let object = format!("node {}, object {:04X}:{:X}", self.node, self.index, sub);
            match error {
                SdoError::NoAnswer { done: 0, .. } => anyhow!(
                    "{object}: {error}; {}; check the node's number (`cantap canopen scan`) and that it is not stopped",
                    speaking.circumstances()
                ),
                SdoError::Aborted { code: 0x0504_0001 } if self.block => {
                    anyhow!("{object}: {error}; the node may not have block transfers: omit --block")
                }
                SdoError::NoAnswer { .. } => anyhow!("{object}: {error}; {}", speaking.circumstances()),
                SdoError::OtherClient { .. } => anyhow!("{object}: {error}; run this again while the other is silent"),
                SdoError::TooSlow { .. } => anyhow!("{object}: {error}; --patience gives it more time"),
                _ => anyhow!("{object}: {error}"),
            }
        })
    }
}

/// Shows an SDO channel's frames as those of the node's usual one.
struct Renamed {
    inner: Box<CanOpen>,
    from: SdoIds,
    to: SdoIds,
}

impl Assembler for Renamed {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        let TraceEvent::Frame { frame, direction, late } = record.event else {
            return self.inner.take(record, events);
        };
        let id = match frame.id() {
            id if id == self.from.request => self.to.request,
            id if id == self.from.response => self.to.response,
            _ => return self.inner.take(record, events),
        };
        if let Some(frame) = cantap::Frame::data_frame(id, frame.data()) {
            let event = TraceEvent::Frame { frame: frame.into(), direction, late };
            self.inner.take(&TraceRecord { event, ..*record }, events);
        }
    }

    fn finish(&mut self, events: &mut Vec<Event>) {
        self.inner.finish(events);
    }
}

/// Reads an object.
pub(super) fn read(
    speak: &SpeakArgs,
    args: &ReadObject,
    times: Times,
    sheets: Vec<Sheet>,
) -> anyhow::Result<()> {
    // Create this first: if the object cannot be stored, it need not be read.
    let output = args.output.as_ref().map(|path| {
        let file = std::fs::File::create_new(path);
        file.with_context(|| format!("cannot write {}; nothing there is overwritten", path.display()))
    });
    let output = output.transpose()?;
    let device = speak.open()?;
    let mut speaking = speak.speak(&device, args.place.witness(sheets));
    let read = args.place.transfer(&mut speaking, args.sub, SdoJob::Read, times);
    if let (Err(_), Some(path)) = (&read, &args.output) {
        // It is empty, and did not exist before.
        let _ = std::fs::remove_file(path);
    }
    let data = read?;
    drop(speaking);
    device.stop()?;
    if let Some(mut file) = output {
        file.write_all(&data).context("cannot write the object")?;
    }
    Ok(())
}

/// Writes an object.
pub(super) fn write(
    speak: &SpeakArgs,
    args: &WriteObject,
    times: Times,
    sheets: Vec<Sheet>,
) -> anyhow::Result<()> {
    // Everything is checked before anything is sent.
    let data = args.bytes(&sheets)?;
    let device = speak.open()?;
    let mut speaking = speak.speak(&device, args.place.witness(sheets));
    args.place.transfer(&mut speaking, args.sub, SdoJob::Write(data), times)?;
    drop(speaking);
    device.stop()?;
    Ok(())
}

impl WriteObject {
    fn bytes(&self, sheets: &[Sheet]) -> anyhow::Result<Vec<u8>> {
        if let Some(path) = self.value.strip_prefix('@') {
            let bytes = std::fs::read(path).with_context(|| format!("cannot read {path}"))?;
            // A transfer announces its length in 32 bits.
            ensure!(
                u32::try_from(bytes.len()).is_ok(),
                "{path} is too long for an object: it may have up to 4 GiB"
            );
            return Ok(bytes);
        }
        let (Place { node, index, .. }, sub) = (&self.place, self.sub);
        let (node, index) = (*node, *index);
        let entry = || {
            let sheet = sheets.iter().find(|sheet| sheet.node == Some(node));
            let sheet = sheet.or_else(|| sheets.iter().find(|sheet| sheet.node.is_none()))?;
            sheet.eds.entry_of(index, sub)?.data_type
        };
        let data_type = match &self.data_type {
            Some(name) => Some(type_named(name).ok_or_else(|| {
                usage(format!(
                    "there is no type '{name}'; there are bool, u8 to u64, i8 to i64, f32, f64, text, utf16, hex, domain"
                ))
            })?),
            None => entry().or_else(|| known_type(index, sub)),
        };
        let Some(data_type) = data_type else {
            return Err(usage(format!(
                "the type of {index:04X}:{sub:X} is not known; give it with --type, as --type u16, or the node's sheet with --eds"
            )));
        };
        encode(data_type, &self.value).map_err(|error| usage(error.to_string()))
    }
}
