//! PEAK's and Kvaser's libraries, as DLLs made from what stands in for them in the adapters' tests. What a library is to do is said by the variable
//! `STANDIN`.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use xshell::{Shell, cmd};

use super::{COMPILER, Windows, ends_well, says, wait};
use crate::workspace;

/// A maker's library.
struct Library {
    /// Its source among the stand-ins.
    source: &'static str,
    dll: &'static str,
    scheme: &'static str,
    /// Another address of its adapter.
    other: &'static str,
    /// A channel that it does not have.
    absent: &'static str,
    /// The driver's words about an adapter that was pulled out.
    pulled: &'static str,
}

const LIBRARIES: [Library; 2] = [
    Library {
        source: "pcanbasic",
        dll: "PCANBasic.dll",
        scheme: "pcan",
        other: "pcan:?data-bitrate=2M",
        absent: "pcan:PCAN_USBBUS7",
        pulled: "A hardware handle is invalid",
    },
    Library {
        source: "canlib",
        dll: "canlib32.dll",
        scheme: "kvaser",
        other: "kvaser:0",
        absent: "kvaser:7",
        pulled: "Hardware error",
    },
];

/// Where a 64-bit DLL says for which processor it is, behind the offset that is kept at this place, and what it says.
const OFFSET_AT: usize = 0x3C;
const X86_64: [u8; 2] = 0x8664_u16.to_le_bytes();
const X86: [u8; 2] = 0x014C_u16.to_le_bytes();

impl Windows {
    /// What a user does with such an adapter: found in the system's folder, not in the current one, and by a path.
    pub fn uses_makers_libraries(&self, shell: &Shell) -> Result<()> {
        let system = self.prefix.join("drive_c/windows/system32");
        let installed = LIBRARIES.each_ref().map(|library| system.join(library.dll));
        for there in &installed {
            shell.remove_path(there)?;
        }
        for (library, there) in LIBRARIES.iter().zip(&installed) {
            let here = self.builds(shell, library)?;
            self.refuses_what_is_no_library(shell, library, &here)?;
            shell.copy_file(&here, there)?;
            self.captures_and_sends(library)?;
            self.refuses_and_loses(library)?;
            shell.remove_path(there)?;
        }
        // Both are there: one that hangs, dies or invents does not hide the other's channels.
        for (library, there) in LIBRARIES.iter().zip(&installed) {
            shell.copy_file(self.folder.join(library.dll), there)?;
        }
        for (way, expected) in [("hangs", "kvaser:0"), ("dies", "kvaser:0"), ("refuses", "pcan:PCAN_USBBUS1")]
        {
            says(&self.as_libraries(way, "list")?, expected)
                .with_context(|| format!("a library that {way}"))?;
        }
        let listed = self.as_libraries("lies", "list")?;
        ensure!(listed.lines().count() == 4, "a library that lies about its channels:\n{listed}");
        Ok(())
    }

    fn builds(&self, shell: &Shell, library: &Library) -> Result<PathBuf> {
        let here = self.folder.join(library.dll);
        let code =
            workspace::root().join("host/adapters/tests/stand_in").join(library.source).with_extension("c");
        cmd!(shell, "{COMPILER} -shared -O1 -Wall -Wextra -Werror -static -o {here} {code} -lpthread")
            .run()?;
        Ok(here)
    }

    /// One that is not installed, one in the current folder, one for other processors, and a text.
    fn refuses_what_is_no_library(&self, shell: &Shell, library: &Library, here: &Path) -> Result<()> {
        let Library { dll, scheme, .. } = library;
        let capture = format!("capture -b 500k -n 1 -d {scheme}:");
        says(&self.fails("talks", &capture)?, &format!("{dll} cannot be loaded"))?;
        let mut bytes = shell.read_binary_file(here)?;
        let offset = bytes.get(OFFSET_AT..OFFSET_AT + 4).and_then(|bytes| bytes.try_into().ok());
        let machine = u32::from_le_bytes(offset.context("no DLL")?) as usize + 4;
        let machine = bytes.get_mut(machine..machine + 2).context("no DLL")?;
        ensure!(machine == X86_64, "{dll} is for another processor already");
        machine.copy_from_slice(&X86);
        for (name, content) in [("x86.dll", bytes), ("text.dll", b"no library\n".repeat(400))] {
            shell.write_file(self.folder.join(name), content)?;
            let refused = self.fails("talks", &format!("{capture}?library={}", self.windows_path(name)))?;
            says(&refused, "cannot be loaded")?;
            says(&refused, "is no library for x86_64, as this program is")?;
        }
        Ok(())
    }

    fn captures_and_sends(&self, library: &Library) -> Result<()> {
        let Library { dll, scheme, other, .. } = library;
        let log = format!("{scheme}.log");
        let capture = format!("capture -b 500k -n 100 -o {log} --force -d");
        for address in [
            format!("{scheme}:?library={}", self.windows_path(dll)),
            format!("{scheme}:"),
            (*other).to_owned(),
        ] {
            self.as_libraries("talks", &format!("{capture} {address}"))?;
            self.has_talked(&log, 100, address.contains("data-bitrate"))?;
        }
        says(&self.as_libraries("talks", "list")?, &format!("{scheme}:"))?;
        says(&self.as_libraries("talks", &format!("info -d {scheme}:"))?, "yes, confirmed by the adapter")?;
        let sent = self
            .as_libraries("", &format!("send -d {scheme}: -b 500k 1 123#0102 1ABCDEF0#0102030405060708"))?;
        says(&sent, "123#0102")?;
        says(&sent, "1ABCDEF0#0102030405060708")
    }

    /// A channel that does not exist, an adapter that will not be silent, and one that is pulled out in the middle.
    fn refuses_and_loses(&self, library: &Library) -> Result<()> {
        let Library { scheme, absent, pulled, .. } = library;
        says(&self.fails("talks", &format!("capture -b 500k -n 1 -d {absent}"))?, "there are")?;
        let refused = self.fails("acknowledges", &format!("capture -b 500k -n 1 -d {scheme}:"))?;
        ensure!(!refused.contains("panicked"), "{refused}");
        let log = format!("{scheme}-pulled.log");
        let mut command = self.line(&format!("capture -b 500k -t 3s -o {log} --force -d {scheme}:"));
        command
            .env("STANDIN", "vanishes")
            .stdout(std::process::Stdio::piped())
            .stderr(std::process::Stdio::piped());
        let output = wait(command.spawn().context("wine")?)?;
        says(&String::from_utf8_lossy(&output.stderr), pulled)?;
        // The library is loaded anew when the capture goes on, and says the same again: what came first is what counts.
        self.has_talked(&log, 50, false)
    }

    /// Runs `cantap.exe` with libraries that behave in this way, and returns what it printed.
    fn as_libraries(&self, way: &str, line: &str) -> Result<String> {
        let mut command = self.line(line);
        command.env("STANDIN", way);
        ends_well(command).with_context(|| format!("STANDIN={way} cantap.exe {line}"))
    }

    /// The same with a command that must fail: why it did.
    fn fails(&self, way: &str, line: &str) -> Result<String> {
        match self.as_libraries(way, line) {
            Ok(printed) => bail!("cantap.exe {line} was to fail, and printed:\n{printed}"),
            Err(error) => Ok(format!("{error:#}")),
        }
    }

    /// A file of this folder as Windows writes it. Wine's drive Z is the root.
    fn windows_path(&self, name: &str) -> String {
        format!(r"Z:{}", self.folder.join(name).display().to_string().replace('/', r"\"))
    }

    /// Whether a log begins with what the libraries say: so many frames, one each millisecond by the adapter's stamps.
    fn has_talked(&self, log: &str, count: usize, is_fd: bool) -> Result<()> {
        let text = std::fs::read_to_string(self.folder.join(log))?;
        let expected = (0..count).map(|number| {
            let id = if number % 2 == 0 {
                format!("{:03X}", 0x100 + number)
            } else {
                format!("{:08X}", 0x18DA_0000 + number)
            };
            let (mark, len) = if is_fd { ("##1", 64) } else { ("#", number % 9) };
            format!("{id}{mark}{}", format!("{number:02X}").repeat(len))
        });
        let words = |line: &str| line.split(' ').map(str::to_owned).collect::<Vec<_>>();
        // Error frames have identifiers of eight digits that begin with 2.
        let is_frame = |words: &Vec<String>| words.len() == 3 && !words[2].starts_with("20");
        let lines: Vec<Vec<String>> = text.lines().map(words).filter(is_frame).collect();
        let frames: Vec<&str> = lines.iter().take(count).map(|words| words[2].as_str()).collect();
        ensure!(frames == expected.collect::<Vec<_>>(), "{log}:\n{text}");
        let time = |words: &[String]| words[0].trim_matches(['(', ')']).parse::<f64>();
        let took = time(&lines[count - 1])? - time(&lines[0])?;
        let expected = count as f64 / 1e3;
        ensure!(
            (expected - 0.003..expected + 0.001).contains(&took),
            "{log}: {count} milliseconds, by the adapter's stamps, are {took} s"
        );
        Ok(())
    }
}
