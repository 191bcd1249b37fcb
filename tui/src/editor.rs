//! The user's editor on a file, while the terminal is its own. The sources go on behind it.

use std::path::Path;
use std::process::{Child, Command, ExitStatus};

use cantap_work::interrupt;

use super::stops::Stops;

/// How often to look whether the editor has ended.
#[cfg(unix)]
const LOOK_EVERY: std::time::Duration = std::time::Duration::from_millis(30);

/// How editing ended.
pub enum Edited {
    /// The editor has ended.
    Done,
    /// There is none, or it failed.
    Failed(String),
    /// This program is to end.
    Terminated,
}

/// Has the user edit a file. The terminal must have been given back.
pub fn edit(path: &Path, stops: &Stops) -> Edited {
    let named = ["VISUAL", "EDITOR"].into_iter().filter_map(std::env::var_os);
    let editor = named.map(|name| name.to_string_lossy().into_owned()).find(|name| !name.trim().is_empty());
    let editor = editor.unwrap_or_else(|| if cfg!(windows) { "notepad" } else { "vi" }.to_owned());
    let failed =
        |reason: String| Edited::Failed(format!("the editor '{editor}' {reason}; EDITOR names another one"));
    interrupt::leave_to(|| {
        let mut child = match command(&editor, path).spawn() {
            Ok(child) => child,
            Err(error) => return failed(format!("cannot be started: {error}")),
        };
        match wait(&mut child, stops) {
            Ok(Some(status)) if status.success() => Edited::Done,
            Ok(Some(status)) => failed(format!("ended with {status}")),
            Ok(None) => Edited::Terminated,
            Err(error) => failed(format!("cannot be waited for: {error}")),
        }
    })
}

/// Through the shell, as other programs start it: the variable may hold options and quotes.
#[cfg(unix)]
fn command(editor: &str, path: &Path) -> Command {
    let mut command = Command::new("sh");
    // A name that begins with a hyphen is no option.
    let path = if path.is_relative() { Path::new(".").join(path) } else { path.to_owned() };
    command.arg("-c").arg(format!("{editor} \"$@\"")).arg("sh").arg(path);
    command
}

#[cfg(not(unix))]
fn command(editor: &str, path: &Path) -> Command {
    let mut words = editor.split_whitespace();
    let mut command = Command::new(words.next().unwrap_or_default());
    command.args(words).arg(path);
    command
}

/// Until the editor ends, or none if this program is to end before. Ctrl-Z in the editor stops both, since the shell knows them as one job.
#[cfg(unix)]
fn wait(child: &mut Child, stops: &Stops) -> std::io::Result<Option<ExitStatus>> {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use signal_hook::consts::{SIGHUP, SIGTERM, SIGTSTP};

    let ends = Arc::<AtomicBool>::default();
    let watched = [SIGTERM, SIGHUP].map(|signal| signal_hook::flag::register(signal, Arc::clone(&ends)));
    let ended = loop {
        if let Some(status) = child.try_wait()? {
            break Some(status);
        }
        if ends.load(Ordering::Relaxed) {
            let id = i32::try_from(child.id()).ok().and_then(rustix::process::Pid::from_raw);
            // It may have ended on its own.
            let _ = id.map(|id| rustix::process::kill_process(id, rustix::process::Signal::TERM));
            child.wait()?;
            break None;
        }
        if stops.asked() {
            signal_hook::low_level::emulate_default_handler(SIGTSTP)?;
        }
        std::thread::sleep(LOOK_EVERY);
    };
    watched.into_iter().flatten().for_each(|id| _ = signal_hook::low_level::unregister(id));
    Ok(ended)
}

#[cfg(not(unix))]
fn wait(child: &mut Child, _: &Stops) -> std::io::Result<Option<ExitStatus>> {
    child.wait().map(Some)
}
