//! What explains conversations: descriptions of ECUs (A2L, ODX, CDD), sheets of CANopen nodes, data types of DroneCAN and Cyphal.

use std::fmt::Display;
use std::str::FromStr;
use std::sync::Arc;

use cantap_protocols::a2l::{A2lDescriptions, Description};
use cantap_protocols::calibration::MasterSlave;
use cantap_protocols::canopen::Sheet;
use cantap_protocols::canopen::eds::Eds;
use cantap_protocols::dsdl::{DataTypes, DsdlSource, SubjectType};
use cantap_protocols::iso_tp::KnownPairs;
use cantap_protocols::odx::{self, Odx};
use cantap_protocols::{Options, calibration};
use serde::Deserialize;

use crate::error::EngineError;

/// How many things that were left out are named.
const MOST_NAMED: usize = 20;

/// All of them. A file of the same name replaces the one before.
#[derive(Default)]
pub struct Descriptions {
    a2l: Vec<(String, Vec<Arc<Description>>)>,
    odx: Vec<(String, Odx)>,
    sheets: Vec<(String, Sheet)>,
    types: Vec<DsdlSource>,
    pairs: Vec<KnownPairs>,
    xcp: Vec<MasterSlave>,
    ccp: Vec<MasterSlave>,
    subjects: Vec<SubjectType>,
    options: Options,
}

/// Who talks to whom, and about what, where a trace does not show it: as the command's options are written.
#[derive(Deserialize)]
pub struct Connections {
    pairs: Vec<String>,
    xcp: Vec<String>,
    ccp: Vec<String>,
    subjects: Vec<String>,
}

/// What a file is, by its name.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    A2l,
    Odx,
    Sheet,
    Types,
}

impl Kind {
    fn of(name: &str) -> Option<Self> {
        let ending = name.rsplit_once('.')?.1.to_ascii_lowercase();
        match ending.as_str() {
            "a2l" => Some(Self::A2l),
            "eds" | "dcf" | "xdd" | "xdc" => Some(Self::Sheet),
            "pdx" | "cdd" => Some(Self::Odx),
            _ if ending.starts_with("odx") => Some(Self::Odx),
            _ if DsdlSource::has_name(name) => Some(Self::Types),
            _ => None,
        }
    }
}

impl Descriptions {
    /// Whether a file is one of these, by its name.
    pub fn are_in(name: &str) -> bool {
        Kind::of(name).is_some()
    }

    /// Adds a file; returns how many things it describes, and what of it is left out. The name of a definition of a data type is its path, from
    /// the outermost namespace on; that of a sheet may begin with a node's number and a colon.
    pub fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(usize, Vec<String>), EngineError> {
        let refused = |error: &dyn Display| EngineError::Description(format!("{name}: {error}"));
        let known = match Kind::of(name) {
            Some(Kind::A2l) => {
                // Files that it includes are not here.
                let read = Description::read(bytes, &mut |_| None).map_err(|error| refused(&error))?;
                let count = read.iter().map(|one| one.objects().len()).sum();
                let issues = read.iter().flat_map(|one| one.issues.iter().cloned()).collect();
                replace(&mut self.a2l, name, read.into_iter().map(Arc::new).collect());
                (count, issues)
            }
            Some(Kind::Odx) => {
                let read = Odx::read(name, bytes).map_err(|error| refused(&error))?;
                let known = (read.layers().len(), read.issues.iter().map(ToString::to_string).collect());
                let before = self.odx.clone();
                replace(&mut self.odx, name, read);
                if let Err(error) = self.described() {
                    self.odx = before;
                    return Err(refused(&error));
                }
                known
            }
            Some(Kind::Sheet) => {
                let eds = Eds::parse(bytes);
                if eds.objects.is_empty() {
                    return Err(refused(
                        &"there is no object in it; give the file that came with the device",
                    ));
                }
                let known = (eds.objects.len(), eds.issues.iter().map(ToString::to_string).collect());
                let node = name.split_once(':').and_then(|(node, _)| node.parse().ok()).or(eds.node);
                replace(&mut self.sheets, name, Sheet { node, eds: Arc::new(eds) });
                known
            }
            Some(Kind::Types) => {
                let text = String::from_utf8_lossy(bytes).into_owned();
                self.types.retain(|known| known.path != name);
                self.types.push(DsdlSource { path: name.to_owned(), text });
                (1, DataTypes::with(&self.types).1)
            }
            None => return Err(refused(&"it is no description")),
        };
        self.rebuild()?;
        let (count, mut issues) = known;
        issues.truncate(MOST_NAMED);
        Ok((count, issues))
    }

    /// Replaces what is known of who talks to whom. A subject's data type must be known by then.
    pub fn connect(&mut self, connections: &Connections) -> Result<(), EngineError> {
        let Connections { pairs, xcp, ccp, subjects } = connections;
        (self.pairs, self.xcp, self.ccp, self.subjects) =
            (read(pairs)?, read(xcp)?, read(ccp)?, read(subjects)?);
        if let Err(error) = self.rebuild() {
            self.subjects.clear();
            self.rebuild()?;
            return Err(error);
        }
        Ok(())
    }

    /// Data types, if there are any of one's own.
    fn data_types(&self) -> Result<Option<Arc<DataTypes>>, EngineError> {
        if self.types.is_empty() && self.subjects.is_empty() {
            return Ok(None);
        }
        let mut types = DataTypes::with(&self.types).0;
        for SubjectType { subject, name } in &self.subjects {
            let named = types.name_subject(*subject, name);
            named.map_err(|error| EngineError::Description(error.to_string()))?;
        }
        Ok(Some(Arc::new(types)))
    }

    fn described(&self) -> Result<odx::Descriptions, odx::OdxError> {
        odx::Descriptions::new(self.odx.iter().map(|(_, odx)| odx::Source { odx, layer: None }))
    }

    fn rebuild(&mut self) -> Result<(), EngineError> {
        let descriptions = if self.odx.is_empty() {
            None
        } else {
            let described = self.described().map_err(|error| EngineError::Description(error.to_string()))?;
            Some(Arc::new(described))
        };
        let all: Vec<_> = self.a2l.iter().flat_map(|(_, all)| all.iter().cloned()).collect();
        let a2l = (!all.is_empty()).then(|| Arc::new(A2lDescriptions::new(all)));
        let of_ecus = descriptions.iter().flat_map(|known| known.pairs()).map(Into::into);
        self.options = Options {
            pairs: self.pairs.iter().copied().chain(of_ecus).collect(),
            sheets: self.sheets.iter().map(|(_, sheet)| sheet.clone()).collect(),
            descriptions,
            calibration: calibration::Known {
                xcp: self.xcp.clone(),
                ccp: self.ccp.clone(),
                descriptions: a2l,
            },
            types: self.data_types()?,
            ..Options::default()
        };
        Ok(())
    }

    /// How to read by them.
    pub const fn options(&self) -> &Options {
        &self.options
    }
}

fn read<T: FromStr<Err: Display>>(texts: &[String]) -> Result<Vec<T>, EngineError> {
    let one =
        |text: &String| text.parse().map_err(|error| EngineError::Description(format!("{text}: {error}")));
    texts.iter().map(one).collect()
}

fn replace<T>(all: &mut Vec<(String, T)>, name: &str, new: T) {
    all.retain(|(known, _)| known != name);
    all.push((name.to_owned(), new));
}
