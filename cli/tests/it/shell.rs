//! Lines of a page as a reader types them: in a shell, in one folder, with the command on the path.

use std::path::Path;
use std::process::{Command, Stdio};

/// A line in a folder. It finds and leaves nothing in the user's cache.
pub fn line(folder: &Path, line: &str) -> Command {
    let binary = Path::new(env!("CARGO_BIN_EXE_cantap"));
    let mut path = binary.parent().unwrap().as_os_str().to_owned();
    path.push(":");
    path.push(std::env::var_os("PATH").unwrap_or_default());
    let mut command = Command::new("sh");
    command.args(["-c", line]).current_dir(folder).stdin(Stdio::null());
    command.env("PATH", path).env("XDG_CACHE_HOME", "/dev/null");
    command
}

/// Runs a line to its end, which must be success, and returns its standard output.
pub fn run(command: &mut Command, line: &str) -> String {
    let output = command.output().unwrap();
    let err = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{line}: {} {err}", output.status);
    String::from_utf8_lossy(&output.stdout).into_owned()
}
