//! What the frames mean, for every command that needs it: the options, and reading records by the bus's
//! protocols.

mod known;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use cantap_protocols::Options;
use cantap_protocols::calibration::MasterSlave;
use cantap_protocols::dsdl::{DsdlSource, SubjectType};
use cantap_protocols::iso_tp::{KnownPairs, Maker};
use cantap_signals::Decoder;
use cantap_signals::condition::{Condition, ConditionError};
use cantap_work::bus_description::BusDescription;
use cantap_work::dsdl;
use cantap_work::eds::SheetPath;
use cantap_work::odx::OdxPath;
use cantap_work::reading::Reading;
use cantap_work::report::Reporter;
use clap::Arg;
use serde_json::{Value, json};

pub use self::known::{Known, named};

use crate::page::{self, Carried, Described};
use crate::stderr;
use crate::usage_error::usage;

/// What helps to understand a bus; commands flatten this into their arguments.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct ProtocolArgs {
    #[arg(long = "pair", value_name = "ID:ID|MAKER", help = pair_help())]
    pairs: Vec<KnownPairs>,
    #[command(flatten)]
    described: DescriptionArgs,
    /// The identifiers of an XCP master and its slave, as 7F0:7F1, if they were connected before the trace begins. Can be repeated.
    #[arg(long = "xcp", value_name = "MASTER:SLAVE")]
    xcp: Vec<MasterSlave>,
    /// The same for CCP.
    #[arg(long = "ccp", value_name = "MASTER:SLAVE")]
    ccp: Vec<MasterSlave>,
    /// The data type of a subject of Cyphal, as 1620=uavcan.si.sample.voltage.Scalar.1.0. Can be repeated. Others are those that nodes name in their
    /// registers, or bytes.
    #[arg(long = "subject", value_name = "NUMBER=TYPE")]
    subjects: Vec<SubjectType>,
}

/// Files that describe what is on a bus.
#[derive(Clone, Debug, Default, clap::Args)]
struct DescriptionArgs {
    /// The sheet (EDS, DCF, XDD or XDC) of CANopen nodes; with a node's number before it (5:drive.eds), only for that node. Can be
    /// repeated.
    #[arg(long = "eds", value_name = "[NODE:]FILE")]
    sheets: Vec<SheetPath>,
    /// The description (PDX, ODX or CDD) of ECUs: names and values of what they are asked and answer. An ECU is known by its identifiers in the file;
    /// with a layer behind it (car.pdx:Engine_V2), that variant of it. Can be repeated.
    #[arg(long = "odx", value_name = "FILE[:LAYER]")]
    odx: Vec<OdxPath>,
    /// The description (A2L) of an ECU: names and values of what is measured and calibrated by XCP and CCP. Can be repeated.
    #[arg(long = "a2l", value_name = "FILE")]
    a2l: Vec<PathBuf>,
    /// A folder with data types of DroneCAN or Cyphal (DSDL), in addition to the public ones: the one in which the outermost namespaces are. Can be
    /// repeated.
    #[arg(long = "dsdl", value_name = "FOLDER")]
    dsdl: Vec<PathBuf>,
}

impl DescriptionArgs {
    /// The files, to be put into a page.
    fn carried(&self) -> anyhow::Result<Vec<Carried>> {
        let bytes =
            |path: &Path| std::fs::read(path).with_context(|| format!("cannot read {}", path.display()));
        let mut carried = Vec::new();
        for sheet in &self.sheets {
            carried.push(Carried::new(&sheet.name(), &bytes(sheet.path())?)?);
        }
        for odx in &self.odx {
            if odx.layer().is_some() {
                return Err(usage("a page takes whole files; leave out the layer of --odx"));
            }
        }
        for path in self.odx.iter().map(OdxPath::path).chain(self.a2l.iter().map(PathBuf::as_path)) {
            carried.push(Carried::new(&page::file_name(path).unwrap_or_default(), &bytes(path)?)?);
        }
        for folder in &self.dsdl {
            for DsdlSource { path, text } in dsdl::read_folder(folder)? {
                carried.push(Carried::new(&path, text.as_bytes())?);
            }
        }
        Ok(carried.into_iter().map(|file| file.with("channel", Value::Null)).collect())
    }
}

fn pair_help() -> String {
    format!(
        "Two identifiers that talk to each other by ISO 15765-2, as 7E0:7E8; with an address in the first data byte as 6F1/12:612/F1; or \
         all of a maker: {}. Can be repeated. Others are found by their behaviour",
        Maker::names()
    )
}

impl ProtocolArgs {
    /// The first of the options that was given.
    pub fn given(&self) -> Option<&'static str> {
        let DescriptionArgs { sheets, odx, a2l, dsdl } = &self.described;
        let given = [
            (!self.pairs.is_empty(), "--pair"),
            (!self.xcp.is_empty(), "--xcp"),
            (!self.ccp.is_empty(), "--ccp"),
            (!self.subjects.is_empty(), "--subject"),
            (!sheets.is_empty(), "--eds"),
            (!odx.is_empty(), "--odx"),
            (!a2l.is_empty(), "--a2l"),
            (!dsdl.is_empty(), "--dsdl"),
        ];
        given.into_iter().find_map(|(is_given, option)| is_given.then_some(option))
    }

    /// All of it, to be put into a page: files, and who talks to whom. What is not understood in them is reported on standard error, unless `quiet`.
    pub fn carried(&self, quiet: bool) -> anyhow::Result<Described> {
        // A page is shown to others: faults belong here.
        self.options(quiet)?;
        let connections = json!({
            "pairs": texts(&self.pairs), "xcp": texts(&self.xcp), "ccp": texts(&self.ccp), "subjects": texts(&self.subjects),
        });
        Ok(Described { files: self.described.carried()?, connections })
    }

    /// A reader that collects a trace's nodes and services.
    pub fn known(&self, quiet: bool) -> anyhow::Result<Known> {
        Ok(Known::new(reading(self.options(quiet)?, None, quiet)))
    }

    /// The library's options; what is not understood in a sheet or description is reported on standard error, unless
    /// `quiet`.
    pub fn options(&self, quiet: bool) -> anyhow::Result<Options> {
        let DescriptionArgs { sheets, odx, a2l, dsdl } = &self.described;
        let Self { pairs, xcp, ccp, subjects, .. } = self;
        BusDescription { pairs, sheets, odx, a2l, xcp, ccp, dsdl, subjects }.options(&reporter(quiet))
    }
}

fn texts<T: ToString>(all: &[T]) -> Vec<String> {
    all.iter().map(ToString::to_string).collect()
}

/// What the libraries report goes to standard error, unless `quiet`.
fn reporter(quiet: bool) -> Reporter {
    if quiet { Reporter::silent() } else { stderr::reporter() }
}

/// [`ProtocolArgs`] mean something with `--protocols` only. For `Command::mut_args` of a command that has it.
pub fn needs_protocols(arg: Arg) -> Arg {
    match arg.get_id().as_str() {
        "pairs" | "sheets" | "odx" | "a2l" | "xcp" | "ccp" | "dsdl" | "subjects" => arg.requires("protocols"),
        _ => arg,
    }
}

/// A reader of records that reports on standard error which protocols it found, unless `quiet`.
pub fn reading(options: Options, decoder: Option<Arc<Decoder>>, quiet: bool) -> Reading {
    Reading::new(options, decoder, (!quiet).then(stderr::reporter))
}

/// A condition on signals, frames, and what frames say together.
pub fn condition(text: &str, decoder: &Decoder) -> Result<Condition, ConditionError> {
    cantap_protocols::condition(text, decoder, &Options::default())
}

/// Reports which of a condition's names never occurred: a misspelt name finds nothing, as if there were nothing.
pub fn report_unmatched(condition: &Condition) {
    let names: Vec<_> = condition.names_without_events().collect();
    if !names.is_empty() {
        eprintln!(
            "cantap: nothing had {}; `cantap conversations` shows what there is, with its names",
            names.join(", ")
        );
    }
}
