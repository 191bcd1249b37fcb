//! A profile: everything about a bus in one file, for `cantap monitor -p car.toml`.

use std::path::{Path, PathBuf};

use super::app::{Column, View};

/// A profile as written. Every key is optional; the command line takes precedence over the profile.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Profile {
    /// The device's address, as after `-d`.
    pub device: Option<String>,
    /// Several devices' addresses: their channels are numbered consecutively.
    pub devices: Vec<String>,
    /// Bit rates, as after `-b`: `["500k", "2:250k"]`.
    pub bitrates: Vec<String>,
    /// Take part in the bus instead of listening only.
    pub normal: bool,
    /// Signal databases, as after `--db`; paths are relative to the profile.
    pub databases: Vec<String>,
    /// Filters in candump's syntax.
    pub filters: Vec<String>,
    /// The page to begin with.
    pub view: Option<View>,
    /// The column by which the fixed view is sorted.
    pub sort: Option<Column>,
    /// Signals in the graph: `Speed`, `Engine.Speed`, patterns such as `Wheel*`.
    pub graph: Vec<String>,
    /// Frames to send, as typed on the page Send: `["123#11 100ms"]`.
    pub send: Vec<String>,
    /// Scripts for the list, files or ready nodes; paths are relative to the profile.
    pub scripts: Vec<String>,
    /// A file to record to from the start; its path is relative to the profile.
    pub record: Option<String>,
    /// For light backgrounds.
    pub light: bool,
    /// The folder from which it was read: relative paths in it start there.
    #[serde(skip)]
    pub folder: PathBuf,
}

impl Profile {
    /// Reads a profile. An error names the file, the line and what is wrong.
    pub fn load(path: &Path) -> Result<Self, String> {
        let text =
            std::fs::read_to_string(path).map_err(|error| format!("profile {}: {error}", path.display()))?;
        let profile = Self::parse(&text).map_err(|reason| format!("profile {}, {reason}", path.display()))?;
        Ok(Self { folder: path.parent().unwrap_or(Path::new("")).to_owned(), ..profile })
    }

    fn parse(text: &str) -> Result<Self, String> {
        toml::from_str(text).map_err(|error| {
            let line =
                error.span().map_or(0, |span| 1 + text[..span.start.min(text.len())].matches('\n').count());
            format!("line {line}: {}", error.message().replace('\n', " "))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_profile_says_everything_about_a_bus() {
        let text = r#"
            device = "virtual:load=20"
            bitrates = ["500k", "2:250k"]
            databases = ["car.dbc"]
            filters = ["can0,123:7FF"]
            view = "signals"
            sort = "count"
            graph = ["Speed"]
            send = ["123#11 100ms"]
        "#;
        let profile = Profile::parse(text).unwrap();
        assert_eq!((profile.view, profile.sort), (Some(View::Signals), Some(Column::Count)));
        assert_eq!(profile.bitrates, ["500k", "2:250k"]);
        assert!(!profile.normal);
    }

    #[test]
    fn a_broken_profile_names_the_line_and_the_reason() {
        let reason = Profile::parse("device = \"virtual\"\nspeed = 5\n").unwrap_err();
        assert!(reason.starts_with("line 2: unknown field `speed`"), "{reason}");
        let reason = Profile::parse("device = \"virtual\"\n\nview = \"colourful\"\n").unwrap_err();
        assert!(reason.starts_with("line 3: unknown variant"), "{reason}");
        assert!(Profile::parse("device = [").unwrap_err().starts_with("line 1"));
    }
}
