//! Bit rates found before, for each device's channels: where to look first. A file in the user's cache folder.
//!
//! What stands there is never used without being confirmed by frames, so nothing depends on the file: one that cannot be read or written only
//! makes the next search longer, and is no error.

use std::collections::BTreeMap;
use std::fs;
use std::io::Read;
use std::path::PathBuf;

use cantap::Channel;

use crate::{atomic_file, cache};

/// The file's name within the folder of cantap.
const NAME: &str = "bit-rates.json";
/// A larger file is not one of ours.
const MOST_BYTES: u64 = 1 << 20;
/// With more entries, it starts anew.
const MOST_ENTRIES: usize = 4_096;

/// The bit rates that were found on devices' channels.
pub struct RememberedRates {
    /// `None` if there is no cache folder.
    path: Option<PathBuf>,
}

impl RememberedRates {
    /// Those of this user.
    pub fn of_user() -> Self {
        Self { path: cache::folder().map(|folder| folder.join(NAME)) }
    }

    /// Those in this file.
    #[cfg(test)]
    pub(crate) const fn at(path: PathBuf) -> Self {
        Self { path: Some(path) }
    }

    /// None, now and later.
    pub const fn none() -> Self {
        Self { path: None }
    }

    /// The bit rate last found on a channel of the device with this serial number, in bit/s.
    pub fn get(&self, serial_number: &str, channel: Channel) -> Option<u32> {
        self.read().get(&key(serial_number, channel)?).copied()
    }

    /// Remembers the bit rate, in bit/s, that was found on a channel of the device with this serial number.
    pub fn set(&self, serial_number: &str, channel: Channel, bitrate_bps: u32) {
        let (Some(path), Some(key)) = (&self.path, key(serial_number, channel)) else { return };
        let mut rates = self.read();
        if rates.get(&key) == Some(&bitrate_bps) {
            return;
        }
        if rates.len() >= MOST_ENTRIES {
            rates.clear();
        }
        rates.insert(key, bitrate_bps);
        let Ok(text) = serde_json::to_vec_pretty(&rates) else { return };
        let folder = path.parent().map_or(Ok(()), fs::create_dir_all);
        // Without it, the next search is longer.
        let _ = folder.and_then(|()| atomic_file::write(path, &text));
    }

    fn read(&self) -> BTreeMap<String, u32> {
        let read = || {
            let mut text = Vec::new();
            fs::File::open(self.path.as_ref()?).ok()?.take(MOST_BYTES).read_to_end(&mut text).ok()?;
            serde_json::from_slice(&text).ok()
        };
        read().unwrap_or_default()
    }
}

/// Nothing is remembered of a device without a serial number: the next one may be another.
fn key(serial_number: &str, channel: Channel) -> Option<String> {
    (!serial_number.is_empty()).then(|| format!("{serial_number}/{}", channel.number()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_remembered_for_each_channel_of_each_device() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cantap").join(NAME);
        let rates = || RememberedRates::at(path.clone());
        assert_eq!(rates().get("A", Channel::Can1), None);
        rates().set("A", Channel::Can1, 500_000);
        rates().set("A", Channel::Can2, 250_000);
        rates().set("B", Channel::Can1, 1_000_000);
        rates().set("A", Channel::Can1, 125_000);
        rates().set("", Channel::Can1, 125_000);
        let get = |serial, channel| rates().get(serial, channel);
        assert_eq!(get("A", Channel::Can1), Some(125_000));
        assert_eq!(get("A", Channel::Can2), Some(250_000));
        assert_eq!(get("B", Channel::Can1), Some(1_000_000));
        assert_eq!((get("B", Channel::Can2), get("", Channel::Can1)), (None, None));
        // A broken file is as good as none, and is replaced.
        fs::write(&path, "{\"A/1\": \"fast\"").unwrap();
        assert_eq!(get("A", Channel::Can1), None);
        rates().set("A", Channel::Can1, 500_000);
        assert_eq!(get("A", Channel::Can1), Some(500_000));
    }

    #[test]
    fn without_a_folder_nothing_is_remembered_and_nothing_fails() {
        let nowhere = RememberedRates::none();
        nowhere.set("A", Channel::Can1, 500_000);
        assert_eq!(nowhere.get("A", Channel::Can1), None);
    }
}
