//! What a user knows of a bus, as the options by which its protocols are read.

use std::path::PathBuf;

use cantap_protocols::Options;
use cantap_protocols::calibration::{Known, MasterSlave};
use cantap_protocols::dsdl::SubjectType;
use cantap_protocols::iso_tp::KnownPairs;

use crate::eds::SheetPath;
use crate::odx::OdxPath;
use crate::report::Reporter;
use crate::{a2l, dsdl, odx};

/// Files that describe what is on a bus, and who talks to whom there. All of it may be empty.
#[derive(Clone, Copy, Debug, Default)]
pub struct BusDescription<'a> {
    /// Pairs of identifiers that talk to each other by ISO 15765-2, in addition to those of the standards and of `odx`.
    pub pairs: &'a [KnownPairs],
    /// Sheets of CANopen nodes.
    pub sheets: &'a [SheetPath],
    /// Descriptions of ECUs.
    pub odx: &'a [OdxPath],
    /// What is in the memories of ECUs.
    pub a2l: &'a [PathBuf],
    /// Connections of XCP from before the first record.
    pub xcp: &'a [MasterSlave],
    /// The same of CCP.
    pub ccp: &'a [MasterSlave],
    /// Folders with data types of DroneCAN and Cyphal.
    pub dsdl: &'a [PathBuf],
    /// The data types of Cyphal's subjects.
    pub subjects: &'a [SubjectType],
}

impl BusDescription<'_> {
    /// Reads the files. What is not understood in them is reported.
    ///
    /// # Errors
    ///
    /// A file cannot be read, is not what it should be, or does not say which ECU is meant.
    pub fn options(&self, reporter: &Reporter) -> anyhow::Result<Options> {
        let sheets =
            self.sheets.iter().map(|path| path.load(reporter)).collect::<anyhow::Result<Vec<_>>>()?;
        let descriptions = odx::load(self.odx, reporter)?;
        let mut pairs = self.pairs.to_vec();
        pairs.extend(descriptions.iter().flat_map(|descriptions| descriptions.pairs()).map(KnownPairs::from));
        let calibration = Known {
            xcp: self.xcp.to_vec(),
            ccp: self.ccp.to_vec(),
            descriptions: a2l::load(self.a2l, reporter)?,
        };
        let types = dsdl::load(self.dsdl, self.subjects, reporter)?;
        Ok(Options { pairs, sheets, descriptions, calibration, types, ..Options::default() })
    }
}
