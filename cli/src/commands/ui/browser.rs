//! Opens the user's browser. Other users of the machine see what programs are started with, so the address, which has the token in it, stands
//! in a file that only this user may read, and the browser is given that file's name.

use std::io::{self, Write};
use std::path::Path;
use std::process::{Command, Stdio};

use tempfile::NamedTempFile;

/// Opens an address of our own. The file may go when the browser has read it.
pub fn open(url: &str) -> io::Result<NamedTempFile> {
    let mut file = tempfile::Builder::new().prefix("cantap-ui-").suffix(".html").tempfile()?;
    // The address has letters, digits and :/?=. alone.
    writeln!(
        file,
        "<!doctype html><meta charset=\"utf-8\"><meta name=\"referrer\" content=\"no-referrer\">\
         <meta http-equiv=\"refresh\" content=\"0;url={url}\"><title>cantap</title><a href=\"{url}\">cantap</a>"
    )?;
    file.flush()?;
    let mut child =
        command(file.path()).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
    // Whoever opens it ends soon, or is the browser itself and ends with it.
    std::thread::Builder::new().name("cantap-browser".to_owned()).spawn(move || child.wait())?;
    Ok(file)
}

#[cfg(target_os = "macos")]
fn command(path: &Path) -> Command {
    let mut command = Command::new("open");
    command.arg(path);
    command
}

#[cfg(windows)]
fn command(path: &Path) -> Command {
    let mut command = Command::new("explorer");
    command.arg(path);
    command
}

#[cfg(not(any(windows, target_os = "macos")))]
fn command(path: &Path) -> Command {
    let mut command = Command::new("xdg-open");
    command.arg(path);
    command
}

#[cfg(test)]
mod tests {
    #[cfg(unix)]
    #[test]
    fn only_this_user_reads_the_token() {
        use std::os::unix::fs::PermissionsExt as _;
        let file = tempfile::Builder::new().prefix("cantap-ui-").suffix(".html").tempfile().unwrap();
        assert_eq!(file.as_file().metadata().unwrap().permissions().mode() & 0o077, 0);
    }
}
