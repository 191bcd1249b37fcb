//! `cargo xtask ci --only windows`: the command built for Windows and run under Wine, beside the one of this system.

mod makers;

use std::io::{BufRead, BufReader};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use xshell::{Shell, cmd};

use crate::machine::Machine;
use crate::outcome::Outcome;
use crate::tests;
use crate::toolchain::{self, Toolchain};
use crate::workspace;

const TARGET: &str = "x86_64-pc-windows-gnu";
const COMPILER: &str = "x86_64-w64-mingw32-gcc";
const PACKAGES: [&str; 3] = ["gcc-mingw-w64-x86-64", "wine64", "wine"];
/// Everything but Parquet, which takes longer to compile than all the rest.
const FEATURES: &str = "emu,sqlite,tls,zstd";
/// Formats that are written on both systems and compared.
const FORMATS: [&str; 7] = ["blf", "asc", "trc", "mf4", "pcapng", "csv", "log.gz"];
/// How long something may take that a user would not wait for: then it hangs.
const PATIENCE: Duration = Duration::from_mins(3);

/// Builds it and tries what depends on the system.
pub fn check(machine: &Machine) -> Result<Outcome> {
    let shell = &machine.shell;
    if !toolchain::is_installed("wine") || !toolchain::is_installed(COMPILER) {
        if !toolchain::can_install() {
            let packages = PACKAGES.join(" ");
            return Ok(Outcome::Skipped(format!(
                "there is no Wine and no {COMPILER}; on Debian run `apt-get install {packages}`"
            )));
        }
        toolchain::install(shell, &PACKAGES)?;
    }
    let Some(chip) = Toolchain::with_std(machine.chip()?.ok(), shell, TARGET)? else {
        return Ok(Outcome::Skipped(format!(
            "no standard library for {TARGET}; run `rustup target add {TARGET}`"
        )));
    };
    let target = workspace::target().join("windows");
    chip.cargo_for(shell, "build", TARGET, "std,panic_unwind", &target)?
        .env("CARGO_TARGET_X86_64_PC_WINDOWS_GNU_LINKER", COMPILER)
        .env("CARGO_PROFILE_DEV_DEBUG", "0")
        .args(["-p", "cantap-cli", "--no-default-features", "--features", FEATURES])
        .run()?;
    // With another selection of packages, other people's crates would be compiled again.
    tests::build(shell)?;
    let windows = Windows::prepare(shell, &target)?;
    windows.captures_and_converts(shell)?;
    windows.captures_from_a_port(shell)?;
    windows.is_ended_by_ctrl_c(shell)?;
    windows.writes_into_a_named_pipe(shell)?;
    windows.uses_makers_libraries(shell)?;
    Ok(Outcome::Passed)
}

/// A folder with the command for Windows, and Wine's own.
struct Windows {
    folder: PathBuf,
    prefix: PathBuf,
    /// The command of this system.
    here: PathBuf,
}

impl Windows {
    fn prepare(shell: &Shell, target: &Path) -> Result<Self> {
        let (folder, prefix) = (target.join("run"), target.join("wine"));
        shell.remove_path(&folder)?;
        shell.create_dir(&folder)?;
        shell.copy_file(target.join(TARGET).join("debug/cantap.exe"), &folder)?;
        let sources = workspace::root().join("xtask/wine");
        let (library, random) = (folder.join("bcryptprimitives.dll"), sources.join("bcryptprimitives.c"));
        cmd!(shell, "{COMPILER} -shared -O1 -o {library} {random} -ladvapi32").run()?;
        let (program, pipe) = (folder.join("pipe.exe"), sources.join("pipe.c"));
        cmd!(shell, "{COMPILER} -O1 -Wall -Werror -o {program} {pipe}").run()?;
        let windows = Self { folder, prefix, here: workspace::target().join("debug/cantap") };
        // Wine makes its own folder at the first start.
        ends_well(windows.command("cantap.exe", &["--version"]))?;
        Ok(windows)
    }

    fn command(&self, program: &str, arguments: &[&str]) -> Command {
        let mut command = Command::new("wine");
        command.arg(program).args(arguments).current_dir(&self.folder).env("WINEPREFIX", &self.prefix);
        // Its remarks about screens and missing parts.
        command.env("WINEDEBUG", "-all").env_remove("DISPLAY").stdin(Stdio::null());
        command
    }

    /// Runs `cantap.exe`, and returns what it printed.
    fn cantap(&self, line: &str) -> Result<String> {
        ends_well(self.line(line)).with_context(|| format!("cantap.exe {line}"))
    }

    fn line(&self, line: &str) -> Command {
        println!("$ wine cantap.exe {line}");
        self.command("cantap.exe", &line.split(' ').collect::<Vec<_>>())
    }

    /// What it records is what this system reads, and both write the same bytes of it.
    fn captures_and_converts(&self, shell: &Shell) -> Result<()> {
        let here = &self.here;
        says(&self.cantap("demo --time 1s")?, "every frame sent was received in order or counted lost")?;
        self.cantap("capture -d virtual:load=50 -b 500k -n 2000 -o cap.log")?;
        let theirs = shell.clone();
        theirs.change_dir(&self.folder);
        for format in FORMATS {
            let (there, own) = (format!("cap.{format}"), format!("own.{format}"));
            self.cantap(&format!("convert cap.log {there}"))?;
            cmd!(theirs, "{here} convert cap.log {own}").quiet().ignore_stderr().run()?;
            ensure!(
                theirs.read_binary_file(&there)? == theirs.read_binary_file(&own)?,
                "{there} differs from what this system writes"
            );
            let statistics = self.cantap(&format!("stats {there} --json"))?;
            let own = cmd!(theirs, "{here} stats {there} --json").quiet().ignore_stderr().read()?;
            ensure!(statistics.trim() == own.trim(), "{statistics}\n{own}");
        }
        says(&self.cantap("monitor --once cap.blf --view fixed")?, "Period ms")
    }

    /// Wine's COM7 is a pseudo-terminal with a virtual device behind it.
    fn captures_from_a_port(&self, shell: &Shell) -> Result<()> {
        let mut device =
            Command::new(&self.here).args(["virtual", "load=60"]).stdout(Stdio::piped()).spawn()?;
        let mut place = String::new();
        BufReader::new(device.stdout.take().context("no output")?).read_line(&mut place)?;
        let port = self.prefix.join("dosdevices/com7");
        shell.remove_path(&port)?;
        symlink(place.trim(), &port)?;
        let captured = self.cantap("capture -d COM7 -b 1M -n 20000 -o port.blf");
        device.kill()?;
        device.wait()?;
        captured?;
        let summary = self.summary(shell, "port.blf")?;
        says(&summary, "20000 frames in ")?;
        says(&summary, " on 2 channels, 0 lost, 0 errors")
    }

    /// Ctrl-C ends a capture, and what was captured is there.
    fn is_ended_by_ctrl_c(&self, shell: &Shell) -> Result<()> {
        let arguments = "capture -d virtual:load=50 -b 500k -o ended.blf".split(' ').collect::<Vec<_>>();
        let mut command = self.command("cantap.exe", &arguments);
        let child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().context("wine")?;
        let begun = Instant::now();
        let file = self.folder.join("ended.blf");
        while !file.metadata().is_ok_and(|file| file.len() > 100_000) {
            ensure!(begun.elapsed() < PATIENCE, "nothing was captured");
            std::thread::sleep(Duration::from_millis(100));
        }
        let number = child.id().to_string();
        cmd!(shell, "kill -INT {number}").run()?;
        let output = wait(child)?;
        let told = String::from_utf8_lossy(&output.stderr);
        says(&told, "lost: controller 0, queue 0, link 0, host 0")?;
        says(&self.summary(shell, "ended.blf")?, " on 2 channels, 0 lost, 0 errors")
    }

    /// As Wireshark asks for it.
    fn writes_into_a_named_pipe(&self, shell: &Shell) -> Result<()> {
        const PIPE: &str = r"\\.\pipe\cantap";
        says(&self.cantap("extcap --extcap-interfaces")?, "interface {value=cantap-virtual}")?;
        let reader = self.command("pipe.exe", &[PIPE, "piped.pcapng"]).spawn().context("wine")?;
        let line = ["extcap", "--extcap-interface", "cantap-virtual", "--capture", "--fifo", PIPE];
        // It refuses a pipe that is not there yet.
        let begun = Instant::now();
        let mut capture = loop {
            let mut capture =
                self.command("cantap.exe", &line).stderr(Stdio::null()).spawn().context("wine")?;
            let file = self.folder.join("piped.pcapng");
            let is_there = || file.metadata().is_ok_and(|file| file.len() > 100_000);
            while !is_there() && capture.try_wait()?.is_none() && begun.elapsed() < PATIENCE {
                std::thread::sleep(Duration::from_millis(100));
            }
            if is_there() {
                break capture;
            }
            capture.kill()?;
            ensure!(begun.elapsed() < PATIENCE, "nothing came through the pipe");
        };
        let number = capture.id().to_string();
        cmd!(shell, "kill -INT {number}").run()?;
        capture.wait()?;
        ensure!(wait(reader)?.status.success(), "the pipe's reader failed");
        says(&self.summary(shell, "piped.pcapng")?, " on 2 channels, 0 lost, 0 errors")
    }

    /// The first line that this system's statistics have to say.
    fn summary(&self, shell: &Shell, file: &str) -> Result<String> {
        let (here, file) = (&self.here, self.folder.join(file));
        let text = cmd!(shell, "{here} stats {file}").quiet().read()?;
        Ok(text.lines().next().unwrap_or_default().to_owned())
    }
}

/// What it printed to standard output, or what it printed to standard error as the error.
fn ends_well(mut command: Command) -> Result<String> {
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().context("wine")?;
    let output = wait(child)?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).replace('\r', "");
    ensure!(output.status.success(), "{}: {}", output.status, text(&output.stderr));
    Ok(text(&output.stdout))
}

fn says(text: &str, what: &str) -> Result<()> {
    ensure!(text.contains(what), "expected '{what}' in:\n{text}");
    Ok(())
}

/// Its output; a program that hangs is ended.
fn wait(mut child: Child) -> Result<std::process::Output> {
    let number = child.id().to_string();
    let (done, is_done) = std::sync::mpsc::channel::<()>();
    // Another thread, because its output has to be read meanwhile.
    let watch = std::thread::spawn(move || {
        let hangs = is_done.recv_timeout(PATIENCE) == Err(std::sync::mpsc::RecvTimeoutError::Timeout);
        if hangs {
            let _ = Command::new("kill").args(["-KILL", &number]).status();
        }
        hangs
    });
    drop(child.stdin.take());
    let output = child.wait_with_output()?;
    drop(done);
    if watch.join().unwrap_or_default() {
        bail!("it hung: {}", String::from_utf8_lossy(&output.stderr));
    }
    Ok(output)
}
