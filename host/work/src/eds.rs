//! The sheets of CANopen nodes (EDS, DCF, XDD, XDC), as users name them.

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use anyhow::Context;
use cantap_protocols::canopen::Sheet;
use cantap_protocols::canopen::eds::Eds;

use crate::report::Reporter;

/// A sheet's file and its node.
#[derive(Clone, Debug)]
pub struct SheetPath {
    node: Option<u8>,
    path: PathBuf,
}

impl FromStr for SheetPath {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        // A drive letter is not a number, so Windows paths are accepted.
        let numbered = text.split_once(':').filter(|(number, _)| number.parse::<u32>().is_ok());
        let Some((number, path)) = numbered else { return Ok(Self { node: None, path: text.into() }) };
        match number.parse() {
            Ok(node @ 1..=127) if !path.is_empty() => Ok(Self { node: Some(node), path: path.into() }),
            _ => Err("write it as FILE or NODE:FILE, with nodes from 1 to 127".to_owned()),
        }
    }
}

impl SheetPath {
    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The file's name without its folder, behind the node's number, if it was given.
    pub fn name(&self) -> String {
        let name = self.path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        self.node.map_or_else(|| name.clone(), |node| format!("{node}:{name}"))
    }

    /// Reads the file. What is not understood in it is reported.
    ///
    /// # Errors
    ///
    /// It cannot be read, or is no sheet.
    pub fn load(&self, reporter: &Reporter) -> anyhow::Result<Sheet> {
        let name = self.path.display();
        let bytes = std::fs::read(&self.path).with_context(|| format!("cannot read the sheet {name}"))?;
        let eds = Eds::parse(&bytes);
        anyhow::ensure!(
            !eds.objects.is_empty(),
            "{name} is not an EDS, DCF, XDD or XDC: there is no object in it; give the file that came with the device"
        );
        for issue in &eds.issues {
            reporter.note(format!("{name}: {issue}"));
        }
        Ok(Sheet { node: self.node.or(eds.node), eds: Arc::new(eds) })
    }
}
