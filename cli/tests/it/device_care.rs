//! `cantap update`, with and without dfu-util, and `cantap identify`, `reset`.
#![cfg(unix)]

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use cantap::wire::PROTOCOL_VERSION;
use cantap::wire::image::{MAGIC, finish};

/// An image for a board: where a firmware describes itself, as the linker lays it out, then made whole as by `cargo xtask dist`.
fn image(board: &str, protocol: u16) -> Vec<u8> {
    let mut image = [0x2002_0000_u32, 0x0800_0195, 0, 0].map(u32::to_le_bytes).concat();
    image.extend(MAGIC);
    for half in [1, protocol, 9, 8, 7, 0] {
        image.extend(u16::to_le_bytes(half));
    }
    let mut name = [0; 24];
    name[..board.len()].copy_from_slice(board.as_bytes());
    image.extend(name);
    image.extend([0; 8 + 300]);
    finish(&mut image).unwrap();
    image
}

/// A folder for this test only, with a firmware image in it.
fn folder(name: &str) -> (PathBuf, PathBuf) {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("it's a firmware.bin");
    std::fs::write(&path, image("virtual", PROTOCOL_VERSION)).unwrap();
    (folder, path)
}

/// Runs with nothing but this folder in the search path.
fn cantap(path: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let Output { status, stdout, stderr } = command.args(arguments).env("PATH", path).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// A dfu-util that records how it was called.
fn fake_dfu_util(folder: &Path, exit_code: u8, mode: u32) {
    let script = format!(
        "#!/bin/sh\n[ \"$1\" = --version ] && exit 0\nprintf '%s\\n' \"$@\" > '{}/called'\nexit {exit_code}\n",
        folder.display()
    );
    let path = folder.join("dfu-util");
    std::fs::write(&path, script).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
}

#[test]
fn without_dfu_util_nothing_is_done() {
    let (folder, image) = folder("no-dfu-util");
    // There is no such device: an attempt to open it would be reported first.
    let (code, out, err) =
        cantap(&folder, &["update", "--dfu-util", "-d", "/dev/nowhere", image.to_str().unwrap()]);
    assert_eq!((code, out.as_str()), (Some(1), ""));
    assert!(err.contains("dfu-util cannot be started; install it"), "{err}");
    fake_dfu_util(&folder, 0, 0o644);
    let (code, _, err) =
        cantap(&folder, &["update", "--dfu-util", "-d", "/dev/nowhere", image.to_str().unwrap()]);
    assert!(code == Some(1) && err.contains("Nothing was done"), "{err}");
}

#[test]
fn dfu_util_writes_the_image_where_it_is_installed() {
    let (folder, image) = folder("dfu-util");
    fake_dfu_util(&folder, 0, 0o755);
    let (code, out, err) =
        cantap(&folder, &["update", "--dfu-util", "-d", "virtual", image.to_str().unwrap()]);
    assert_eq!((code, out.as_str(), err.as_str()), (Some(0), "virtual now runs firmware 9.8.7\n", ""));
    let called = std::fs::read_to_string(folder.join("called")).unwrap();
    let arguments = format!("-d\n0483:df11\n-a\n0\n-s\n0x08000000:leave\n-w\n-D\n{}\n", image.display());
    assert_eq!(called, arguments);
}

#[test]
fn a_dfu_util_that_fails_is_told_with_the_line_to_repeat() {
    let (folder, image) = folder("failing-dfu-util");
    fake_dfu_util(&folder, 74, 0o755);
    let (code, _, err) = cantap(&folder, &["update", "--dfu-util", "-d", "virtual", image.to_str().unwrap()]);
    assert!(code == Some(1) && err.contains("dfu-util failed"), "{err}");
    let line = err.split('`').nth(1).unwrap();
    assert!(line.starts_with("cantap update --in-bootloader virtual --dfu-util '"), "{err}");
    // The line does what the first attempt should have done.
    fake_dfu_util(&folder, 0, 0o755);
    let line = line.replacen("cantap", env!("CARGO_BIN_EXE_cantap"), 1);
    let run = Command::new("/bin/sh").args(["-c", &line]).env("PATH", &folder).status().unwrap();
    assert!(run.success());
    let called = std::fs::read_to_string(folder.join("called")).unwrap();
    assert_eq!(called.lines().last(), image.to_str());
}

#[test]
fn another_board_s_image_half_of_one_and_another_protocol_s_never_restart_the_device() {
    let (folder, whole) = folder("other-images");
    fake_dfu_util(&folder, 0, 0o755);
    let other = folder.join("other.bin");
    let update = |content: &[u8], option: &str| {
        std::fs::write(&other, content).unwrap();
        let mut line = vec!["update", "--dfu-util", "-d", "virtual", other.to_str().unwrap()];
        line.extend(option.split_whitespace());
        let (code, _, err) = cantap(&folder, &line);
        (code, err, folder.join("called").exists())
    };
    let whole = std::fs::read(whole).unwrap();
    let mut damaged = whole.clone();
    damaged[200] ^= 4;
    for (content, part) in [
        (image("olimex-p405", PROTOCOL_VERSION), "is for 'olimex-p405', and the device is 'virtual'"),
        (whole[..whole.len() / 2 + 20].to_vec(), "bytes are there; fetch it again"),
        (damaged, "its CRC is wrong"),
        (image("virtual", PROTOCOL_VERSION + 1), "--other-protocol"),
        (whole[..16].to_vec(), "not a firmware of cantap"),
    ] {
        let (code, err, called) = update(&content, "");
        assert!(code == Some(1) && err.contains(part) && !called, "{part}: {err}");
    }
    let (code, err, called) = update(&image("virtual", PROTOCOL_VERSION + 1), "--other-protocol");
    assert!(code == Some(0) && called, "{err}");
}

#[test]
fn what_is_no_image_never_brings_the_device_out_of_its_firmware() {
    let (folder, _) = folder("no-image");
    let other = folder.join("other.bin");
    for (content, part) in [
        (b"\x7FELF and more".as_slice(), "ELF"),
        (b"short", "too short"),
        (b"a text that is long enough to have two words", "not a firmware image"),
    ] {
        std::fs::write(&other, content).unwrap();
        // There is no such device: an attempt to open it would be reported first.
        let (code, _, err) = cantap(&folder, &["update", "-d", "/dev/nowhere", other.to_str().unwrap()]);
        assert!(code == Some(1) && err.contains(part), "{err}");
    }
    let (code, _, err) = cantap(&folder, &["update", "-d", "virtual", "nowhere.bin"]);
    assert!(code == Some(1) && err.contains("cannot read 'nowhere.bin'"), "{err}");
}

#[test]
fn identify_and_reset_say_what_they_did_and_refuse_nonsense() {
    let (folder, _) = folder("care");
    assert_eq!(cantap(&folder, &["identify", "-d", "virtual"]).1, "its LEDs blink for 5 s\n");
    assert_eq!(cantap(&folder, &["reset", "-d", "virtual"]), (Some(0), "restarting\n".into(), String::new()));
    for line in [["identify", "-d", "virtual", "-t", "0"], ["identify", "-d", "virtual", "-t", "256"]] {
        assert_eq!(cantap(&folder, &line).0, Some(2), "{line:?}");
    }
    for command in ["identify", "reset"] {
        let (code, _, err) = cantap(&folder, &[command, "-d", "/dev/nowhere"]);
        assert!(code == Some(1) && err.contains("cantap list"), "{err}");
    }
}
