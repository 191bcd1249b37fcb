//! Descriptions of ECUs (ODX), as users name them.

use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use anyhow::Context as _;
use cantap_protocols::odx::{Descriptions, Odx, Source, is_document};
use cantap_trace::counted;

use crate::report::Reporter;

/// The largest file that is looked at, packed or not.
const MOST_BYTES: u64 = 512 << 20;

/// A file, and the layer that is meant in it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OdxPath {
    path: PathBuf,
    layer: Option<String>,
}

impl OdxPath {
    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The layer that was chosen in it.
    pub fn layer(&self) -> Option<&str> {
        self.layer.as_deref()
    }
}

impl FromStr for OdxPath {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        // Only behind the name of such a file: a path may have a colon itself.
        let named = text.rsplit_once(':').filter(|(path, layer)| is_odx(path) && !layer.is_empty());
        match named {
            Some((path, layer)) => Ok(Self { path: path.into(), layer: Some(layer.to_owned()) }),
            None if text.is_empty() => Err("write it as FILE, or FILE:LAYER".to_owned()),
            None => Ok(Self { path: text.into(), layer: None }),
        }
    }
}

/// Whether a path is that of a package or document of ODX by its name.
pub fn is_odx(path: &str) -> bool {
    is_document(path)
        || path.rsplit_once('.').is_some_and(|(_, extension)| extension.eq_ignore_ascii_case("pdx"))
}

/// Reads a file.
///
/// # Errors
///
/// It cannot be read, is damaged, or is larger than 512 MiB.
pub fn read(path: &Path) -> anyhow::Result<Odx> {
    let name = path.display();
    let file = std::fs::File::open(path).with_context(|| format!("cannot read {name}"))?;
    let mut bytes = Vec::new();
    file.take(MOST_BYTES + 1).read_to_end(&mut bytes).with_context(|| format!("cannot read {name}"))?;
    anyhow::ensure!(
        bytes.len() as u64 <= MOST_BYTES,
        "{name} is larger than 512 MiB; take the ECU's documents out of it"
    );
    let short = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    Odx::read(&short, &bytes).with_context(|| name.to_string())
}

/// Reads all files; `None` if there is none. How much of them is not evaluated is reported.
///
/// # Errors
///
/// A file cannot be read, is damaged or too large, or does not say which ECU is meant.
pub fn load(paths: &[OdxPath], reporter: &Reporter) -> anyhow::Result<Option<Arc<Descriptions>>> {
    if paths.is_empty() {
        return Ok(None);
    }
    let mut files: Vec<(&Path, Odx)> = Vec::new();
    for OdxPath { path, .. } in paths {
        if files.iter().any(|(known, _)| known == path) {
            continue;
        }
        let odx = read(path)?;
        let issues = odx.issues.len() + odx.issues_left_out;
        if issues > 0 {
            let name = path.display();
            reporter.note(format!(
                "{name}: {} not evaluated; `cantap db {name} --warnings` lists them",
                counted(issues, "thing")
            ));
        }
        files.push((path, odx));
    }
    let sources = paths.iter().filter_map(|OdxPath { path, layer }| {
        let (_, odx) = files.iter().find(|(known, _)| known == path)?;
        Some(Source { odx, layer: layer.as_deref() })
    });
    let names: Vec<_> = files.iter().map(|(path, _)| path.display().to_string()).collect();
    let descriptions = Descriptions::new(sources).with_context(|| names.join(", "))?;
    Ok(Some(Arc::new(descriptions)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_layer_stands_behind_the_file() {
        for (text, path, layer) in [
            ("car.pdx", "car.pdx", None),
            ("car.pdx:Engine", "car.pdx", Some("Engine")),
            ("C:\\car.ODX-D:Engine", "C:\\car.ODX-D", Some("Engine")),
            ("C:\\car.pdx", "C:\\car.pdx", None),
            ("car.xml", "car.xml", None),
        ] {
            let expected = OdxPath { path: path.into(), layer: layer.map(str::to_owned) };
            assert_eq!(text.parse(), Ok(expected), "{text}");
        }
        assert!("".parse::<OdxPath>().is_err());
    }
}
