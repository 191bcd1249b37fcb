//! What the system knows about a serial port: whose it is, who has it open, and what else may take it. Only on Linux.

use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

/// The rules of `packaging/60-cantap.rules` that let whoever sits at the machine open a board's port, and keep ModemManager away from it.
pub const UDEV_RULES: &str = r#"SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", ATTR{idVendor}=="1209", ATTR{product}=="cantap*", ENV{ID_MM_DEVICE_IGNORE}="1", TAG+="uaccess"
SUBSYSTEM=="tty", SUBSYSTEMS=="usb", ATTRS{idVendor}=="1209", ATTRS{product}=="cantap*", ENV{ID_MM_DEVICE_IGNORE}="1", TAG+="uaccess"
"#;
/// Where they belong.
pub const UDEV_RULES_FILE: &str = "/etc/udev/rules.d/60-cantap.rules";
/// The USB IDs of the chip's bootloader.
const BOOTLOADER: (&str, &str) = ("0483", "df11");

/// A program that has a port open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Holder {
    /// Its process's number.
    pub pid: u32,
    /// Its name, of at most 15 bytes.
    pub name: String,
}

/// Who has a port open.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Holders {
    /// Those that could be seen.
    pub seen: Vec<Holder>,
    /// Processes of other users, into which only root may look.
    pub hidden: usize,
}

/// What the file system says of a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PortFile {
    /// Where it really is, after all links.
    pub path: PathBuf,
    /// Whether it is a device, as opposed to an ordinary file.
    pub is_device: bool,
    /// Access mode, the lowest nine bits.
    pub mode: u32,
    /// The name of its group, or its number.
    pub group: String,
    /// Whether this process belongs to that group.
    pub is_in_group: bool,
    /// Whether ModemManager leaves it alone, by a udev rule.
    pub is_ignored_by_modem_manager: bool,
}

/// The system that is asked: the running one, or a folder that looks like it.
#[derive(Clone, Debug)]
pub struct System {
    root: PathBuf,
}

impl Default for System {
    fn default() -> Self {
        Self { root: "/".into() }
    }
}

impl System {
    /// One whose `proc`, `sys`, `etc` and `run` are in this folder.
    pub fn at(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    fn text(&self, path: &str) -> String {
        let bytes = fs::read(self.root.join(path)).unwrap_or_default();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    /// A port's file; an error if there is none.
    pub fn port(&self, path: &Path) -> std::io::Result<PortFile> {
        let path = path.canonicalize()?;
        let metadata = path.metadata()?;
        Ok(PortFile {
            is_device: metadata.file_type().is_char_device(),
            mode: metadata.mode() & 0o777,
            group: self.group_name(metadata.gid()),
            is_in_group: self.groups().contains(&metadata.gid()),
            is_ignored_by_modem_manager: self.is_ignored(metadata.rdev()),
            path,
        })
    }

    /// A group's name, or its number as text.
    fn group_name(&self, gid: u32) -> String {
        let groups = self.text("etc/group");
        let name = groups.lines().find_map(|line| {
            let mut fields = line.split(':');
            let name = fields.next()?;
            (fields.nth(1)?.parse() == Ok(gid)).then(|| name.to_owned())
        });
        name.unwrap_or_else(|| gid.to_string())
    }

    /// The groups of this process.
    fn groups(&self) -> Vec<u32> {
        let status = self.text("proc/self/status");
        let numbers = |key: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(key)).unwrap_or_default();
            line.split_whitespace().filter_map(|word| word.parse().ok()).collect::<Vec<u32>>()
        };
        // The second number is the effective one.
        numbers("Gid:").into_iter().skip(1).take(1).chain(numbers("Groups:")).collect()
    }

    /// Whether udev's database says that ModemManager leaves a device alone.
    fn is_ignored(&self, rdev: u64) -> bool {
        // As in makedev(3).
        let major = rdev >> 8 & 0xFFF | rdev >> 32 & !0xFFF;
        let minor = rdev & 0xFF | rdev >> 12 & 0xFFFF_FF00;
        let entry = self.text(&format!("run/udev/data/c{major}:{minor}"));
        entry.lines().any(|line| line == "E:ID_MM_DEVICE_IGNORE=1")
    }

    /// Every process, with its folder.
    fn processes(&self) -> impl Iterator<Item = (u32, PathBuf)> {
        let entries = fs::read_dir(self.root.join("proc")).into_iter().flatten().flatten();
        entries.filter_map(|entry| Some((entry.file_name().to_str()?.parse().ok()?, entry.path())))
    }

    /// Whether ModemManager runs: it opens new ports for seconds to find out whether they are modems.
    pub fn has_modem_manager(&self) -> bool {
        self.processes().any(|(_, folder)| name_of(&folder) == "ModemManager")
    }

    /// The other programs that have a file open.
    pub fn holders(&self, path: &Path) -> Holders {
        let mut holders = Holders::default();
        for (pid, folder) in self.processes().filter(|(pid, _)| *pid != std::process::id()) {
            let Ok(open) = fs::read_dir(folder.join("fd")) else {
                holders.hidden += 1;
                continue;
            };
            let has = open.flatten().any(|entry| fs::read_link(entry.path()).is_ok_and(|to| to == path));
            if has {
                holders.seen.push(Holder { pid, name: name_of(&folder) });
            }
        }
        holders.seen.sort_by_key(|holder| holder.pid);
        holders
    }

    /// How many boards are in the chip's bootloader, by USB.
    pub fn bootloaders(&self) -> usize {
        let entries = fs::read_dir(self.root.join("sys/bus/usb/devices")).into_iter().flatten().flatten();
        let is = |folder: PathBuf| {
            let id = |name: &str| fs::read_to_string(folder.join(name)).unwrap_or_default();
            (id("idVendor").trim(), id("idProduct").trim()) == BOOTLOADER
        };
        entries.filter(|entry| is(entry.path())).count()
    }
}

fn name_of(folder: &Path) -> String {
    String::from_utf8_lossy(&fs::read(folder.join("comm")).unwrap_or_default()).trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder with these files, and links where the content begins with `->`.
    fn system(files: &[(&str, &str)]) -> (tempfile::TempDir, System) {
        let folder = tempfile::tempdir().unwrap();
        for (name, content) in files {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            match content.strip_prefix("->") {
                Some(to) => std::os::unix::fs::symlink(to, path).unwrap(),
                None => fs::write(path, content).unwrap(),
            }
        }
        let system = System::at(folder.path());
        (folder, system)
    }

    #[test]
    fn the_programs_that_hold_a_port_are_found_and_those_of_others_counted() {
        let (_folder, system) = system(&[
            ("proc/12/comm", "minicom\n"),
            ("proc/12/fd/3", "->/dev/ttyACM0"),
            ("proc/7/comm", "ModemManager\n"),
            ("proc/7/fd/0", "->/dev/null"),
            ("proc/7/fd/9", "->/dev/ttyACM0"),
            ("proc/1/comm", "systemd\n"),
            ("proc/uptime", "1"),
        ]);
        let holders = system.holders(Path::new("/dev/ttyACM0"));
        let named = |pid, name: &str| Holder { pid, name: name.to_owned() };
        assert_eq!(holders.seen, [named(7, "ModemManager"), named(12, "minicom")]);
        assert_eq!(holders.hidden, 1);
        assert!(system.has_modem_manager());
        assert_eq!(system.holders(Path::new("/dev/ttyACM1")).seen, []);
        let (_empty, nothing) = self::system(&[]);
        assert_eq!(nothing.holders(Path::new("/dev/ttyACM0")), Holders::default());
        assert!(!nothing.has_modem_manager());
    }

    #[test]
    fn a_port_s_group_and_what_udev_says_of_it_are_known() {
        let gid = Path::new("/dev/null").metadata().unwrap().gid();
        let (_folder, system) = system(&[
            ("etc/group", &format!("bin:x:99999:\nbad line\ndialout:x:{gid}:me\n")),
            ("proc/self/status", "Name:\tx\nUid:\t5\t5\t5\t5\nGid:\t77\t78\t77\t77\nGroups:\t20 44\n"),
            // The null device has the numbers 1 and 3.
            ("run/udev/data/c1:3", "E:ID_MM_CANDIDATE=1\nE:ID_MM_DEVICE_IGNORE=1\n"),
        ]);
        let port = system.port(Path::new("/dev/null")).unwrap();
        assert!(port.is_device && port.is_ignored_by_modem_manager, "{port:?}");
        assert_eq!((port.group.as_str(), port.is_in_group), ("dialout", false));
        assert_eq!(system.groups(), [78, 20, 44]);
        let other = system.port(Path::new("/dev/zero")).unwrap();
        assert!(!other.is_ignored_by_modem_manager);
        let (folder, nobody) = self::system(&[("file", "")]);
        assert!(!nobody.port(&folder.path().join("file")).unwrap().is_device);
        assert!(nobody.port(&folder.path().join("absent")).is_err());
        assert_eq!(nobody.group_name(4242), "4242");
    }

    #[test]
    fn boards_in_their_bootloader_are_counted() {
        let (_folder, system) = system(&[
            ("sys/bus/usb/devices/1-1/idVendor", "0483\n"),
            ("sys/bus/usb/devices/1-1/idProduct", "df11\n"),
            ("sys/bus/usb/devices/1-2/idVendor", "1209\n"),
            ("sys/bus/usb/devices/1-2/idProduct", "0001\n"),
            ("sys/bus/usb/devices/usb1/uevent", ""),
        ]);
        assert_eq!(system.bootloaders(), 1);
    }

    /// What a user is told to write is what packages install.
    #[test]
    fn the_rules_are_those_that_are_packaged() {
        let packaged = include_str!("../../../packaging/60-cantap.rules");
        for rule in UDEV_RULES.lines() {
            assert!(packaged.lines().any(|line| line == rule), "{rule}");
        }
    }
}
