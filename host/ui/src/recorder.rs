//! Recordings that pages begin: into new files of one folder, whatever the pages show.

use std::path::Path;

use anyhow::bail;
use cantap_signals::Decoder;
use cantap_signals::trigger::Window;
use cantap_work::recording::{Around, Older, Recording};

use crate::request::Only;

/// Longest name that a page may give, in bytes.
const MOST_NAME: usize = 120;
/// Longest time around an event, in seconds: a day.
const MOST_SECONDS: f64 = 86_400.0;

/// Creates a file by a name that a page gave. An existing one stays: then this is an error.
pub fn create(
    folder: &Path,
    name: &str,
    only: Option<&Only>,
    decoder: &Decoder,
) -> anyhow::Result<Recording> {
    let path = folder.join(checked(name)?);
    Recording::create(&path, only.map(|only| around(only, decoder)).transpose()?, Older::Refuse, Vec::new())
}

fn around(only: &Only, decoder: &Decoder) -> anyhow::Result<Around> {
    let Only { around, before_s, after_s } = only;
    let seconds = [*before_s, *after_s];
    if !seconds.iter().all(|seconds| (0.0..=MOST_SECONDS).contains(seconds)) {
        bail!("the time before and after an event is from 0 to {MOST_SECONDS} seconds");
    }
    let [pre_ns, post_ns] = seconds.map(|seconds| (seconds * 1e9) as i64);
    Around::new(around, Window { pre_ns, post_ns, events: None }, decoder)
}

/// A file's name that stays in its folder, on every system.
fn checked(name: &str) -> anyhow::Result<&str> {
    const RESERVED: [&str; 6] = ["con", "prn", "aux", "nul", "com", "lpt"];
    let stem = name.split('.').next().unwrap_or_default().to_ascii_lowercase();
    let stem = stem.trim_end_matches(char::is_numeric);
    let is_plain = |letter: char| letter.is_alphanumeric() || " ._-+()".contains(letter);
    let is_good = !name.is_empty()
        && name.len() <= MOST_NAME
        && name.chars().all(is_plain)
        && !name.starts_with(['.', '-', ' '])
        && !name.ends_with(['.', ' '])
        && !RESERVED.contains(&stem.trim_end());
    if !is_good {
        bail!(
            "a recording's name has letters, digits, blanks and . _ - + ( ), and no folder, such as drive.blf"
        );
    }
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn begin(folder: &Path, name: &str) -> anyhow::Result<Recording> {
        create(folder, name, None, &Decoder::new(Vec::new()))
    }

    #[test]
    fn no_name_leads_out_of_the_folder_or_leaves_something_behind() {
        let folder = tempfile::tempdir().unwrap();
        let inner = folder.path().join("inner");
        std::fs::create_dir(&inner).unwrap();
        for name in [
            "",
            "../a.log",
            "/tmp/a.log",
            "a/b.log",
            r"..\a.log",
            "C:a.log",
            ".a.log",
            "-o.log",
            "a.log:stream",
            "con.log",
            "COM1.log",
            "com¹.log",
            "nul",
            "a\n.log",
            "a\0.log",
            "a\u{1b}[2J.log",
            "a.log ",
            "a.log.",
            "a.unknown",
            "a",
            "a.html",
            "*.log",
            "\u{202e}gol.a",
        ] {
            assert!(begin(&inner, name).is_err(), "{name:?}");
        }
        assert!(begin(&inner, &format!("{}.log", "a".repeat(300))).is_err());
        assert_eq!(std::fs::read_dir(&inner).unwrap().count(), 0);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn times_around_an_event_are_within_a_day() {
        let folder = tempfile::tempdir().unwrap();
        let decoder = Decoder::new(Vec::new());
        let begin = |before_s, after_s| {
            let only = Only { around: "error".to_owned(), before_s, after_s };
            create(folder.path(), "a.log", Some(&only), &decoder).map(|_| ())
        };
        begin(0.0, 86_400.0).unwrap();
        for (before_s, after_s) in [(-1.0, 1.0), (1.0, f64::NAN), (f64::INFINITY, 1.0), (1.0, 1e9)] {
            assert!(begin(before_s, after_s).is_err(), "{before_s} {after_s}");
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
