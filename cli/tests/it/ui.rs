//! `cantap ui` as users run it; the page is a stand-in with the real one's marks. What is served is tested in `host/ui`, the page itself in
//! `web/page/tests/live.test.mjs`.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

const PAGE: &str = "<!doctype html><head><meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'\"></head>\
                    <body><!--cantap-report--><script>page()</script></body>";
const DATABASE: &str =
    "BO_ 291 Engine: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"</script><script>alert(1)</script>\" A\n";

fn directory(test: &str) -> PathBuf {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("ui").join(test);
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    std::fs::write(directory.join("page.html"), PAGE).unwrap();
    std::fs::write(directory.join("drive.log"), "(1.000000) can0 123#11\n").unwrap();
    std::fs::write(directory.join("car.dbc"), DATABASE).unwrap();
    directory
}

fn command(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.arg("ui").args(arguments).env("CANTAP_PAGE", directory.join("page.html")).current_dir(directory);
    command
}

/// One that runs, and its address.
struct Running {
    child: Child,
    host: String,
    path: String,
}

impl Running {
    fn start(directory: &Path, arguments: &[&str]) -> Self {
        let child = command(directory, arguments)
            .arg("--no-open")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        let mut child = child.unwrap();
        let mut url = String::new();
        BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut url).unwrap();
        let rest = url.trim().strip_prefix("http://").unwrap_or_else(|| panic!("{url}"));
        let (host, path) = rest.split_at(rest.find('/').unwrap());
        Self { host: host.to_owned(), path: path.to_owned(), child }
    }

    fn get(&self, path: &str) -> String {
        let mut stream = TcpStream::connect(&self.host).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {}\r\n\r\n", self.host).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn the_page_comes_with_what_it_needs_from_the_printed_address_alone() {
    let directory = directory("served");
    for (arguments, kind, name) in [
        (&["-d", "virtual:load=5", "-b", "500k", "--db", "2:car.dbc"][..], "device", "virtual:load=5"),
        (&["drive.log", "--db", "2:car.dbc"], "trace", "drive.log"),
    ] {
        let server = Running::start(&directory, arguments);
        assert!(server.host.starts_with("127.0.0.1:"), "{}", server.host);
        let answer = server.get(&server.path);
        assert!(answer.starts_with("HTTP/1.1 200 OK\r\n"), "{answer}");
        let (_, rest) = answer.split_once("<script type=\"application/json\" id=\"cantap-live\">").unwrap();
        let (about, _) = rest.split_once("</script>").unwrap();
        let about: serde_json::Value = serde_json::from_str(about).unwrap();
        assert_eq!((&about["kind"], &about["name"]), (&kind.into(), &name.into()));
        assert_eq!(
            (&about["databases"][0]["name"], &about["databases"][0]["channel"]),
            (&"car.dbc".into(), &2.into())
        );
        // Neither the token nor a script of the database is in it.
        let token = server.path.split_once("token=").unwrap().1;
        assert!(token.len() == 32 && !answer.contains(token), "{answer}");
        assert_eq!(answer.matches("<script").count(), 2, "{answer}");
        assert!(server.get("/").starts_with("HTTP/1.1 403 "));
    }
}

#[test]
fn the_virtual_vehicle_brings_its_database() {
    let directory = directory("car");
    let server = Running::start(&directory, &["virtual:car"]);
    let answer = server.get(&server.path);
    assert!(
        answer.contains("\"name\":\"car.dbc\"") && answer.contains("\"name\":\"virtual:car\""),
        "{answer}"
    );
}

#[test]
fn without_a_page_a_device_or_a_trace_it_says_what_to_do() {
    let directory = directory("refused");
    for (arguments, code, reason) in [
        (&["none.log"][..], 1, "none.log"),
        (&["-"], 1, "write standard input into one first"),
        (&["drive.log", "--allow", "send"], 2, "are for devices"),
        (&["drive.log", "-o", "new.log"], 2, "are for devices"),
        (&["-d", "virtual", "-b", "500k", "-o", "drive.log"], 1, "is not overwritten"),
        (&["-d", "virtual", "-b", "500k", "-o", "-"], 2, "a file's name"),
        (&["-d", "virtual", "-b", "500k", "-o", "new.unknown"], 1, "unknown"),
        (&["-d", "virtual", "-b", "500k", "--allow", "everything"], 2, "send"),
        (&["-d", "virtual", "--db", "none.dbc"], 1, "none.dbc"),
        (&["-d", "unix:nowhere"], 1, "nowhere"),
    ] {
        let output = command(&directory, arguments).arg("--no-open").output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(output.stdout.is_empty(), "{arguments:?}");
        assert!(
            output.status.code() == Some(code) && text.contains(reason),
            "{arguments:?}: {:?} {text}",
            output.status
        );
    }
    assert!(!directory.join("new.log").exists() && !directory.join("new.unknown").exists());
    std::fs::write(directory.join("page.html"), "<html></html>").unwrap();
    let output = command(&directory, &["drive.log", "--no-open"]).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(1) && text.contains("cargo xtask web"), "{text}");
}
