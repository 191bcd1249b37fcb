//! A virtual device behind a pseudo-terminal, at the end of a link with a stable name.

use std::os::unix::fs::symlink;
use std::path::PathBuf;

use cantap_virtual::open_terminal;

/// A port that a device can be plugged into.
pub struct Port {
    _folder: tempfile::TempDir,
    name: PathBuf,
    device: Option<cantap_virtual::Terminal>,
}

impl Port {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let name = folder.path().join("ttyACM0");
        Self { _folder: folder, name, device: None }
    }

    pub fn name(&self) -> &str {
        self.name.to_str().unwrap()
    }

    /// Plugs a device in; its options are those of the virtual device.
    pub fn plug(&mut self, options: &str) {
        self.unplug();
        let device = open_terminal(options.parse().unwrap()).unwrap();
        symlink(device.path(), &self.name).unwrap();
        self.device = Some(device);
    }

    pub fn unplug(&mut self) {
        // It ends before its name disappears, as with a cable.
        self.device = None;
        let _ = std::fs::remove_file(&self.name);
    }
}
