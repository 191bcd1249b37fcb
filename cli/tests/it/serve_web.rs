//! `cantap serve --web`: the page beside the other listeners. What pages may do is tested in `host/ui`; in a browser,
//! `web/page/tests/serve-web.test.mjs`.
#![cfg(unix)]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use serde_json::{Value, json};
use tungstenite::{Message, WebSocket};

use crate::served::server::{Server, cantap, run, socket, wait_for};

const PAGE: &str = "<!doctype html><head><meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'\"></head>\
                    <body><!--cantap-report--><script>page()</script></body>";
/// Longer than anything here takes.
const PATIENCE: Duration = Duration::from_mins(1);

/// A server with the page, in a folder of its own.
struct Web {
    folder: tempfile::TempDir,
    server: Server,
}

impl Web {
    /// `more` are further options; the page's address is printed last of `ways`.
    fn start(more: &str, ways: usize) -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("page.html"), PAGE).unwrap();
        std::fs::write(folder.path().join("car.dbc"), "BO_ 291 Engine: 8 A\n").unwrap();
        let remarks = std::fs::File::create(folder.path().join("remarks")).unwrap();
        let mut command = cantap(&format!("serve --unix cantap.sock --web 0 --audit audit.jsonl {more}"));
        command.env("CANTAP_PAGE", "page.html").current_dir(folder.path()).stderr(Stdio::from(remarks));
        Self { server: Server::of(&mut command, ways), folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Host and token of the page.
    fn place(&self) -> (&str, &str) {
        let url = self.server.at.last().unwrap().strip_prefix("http://").unwrap();
        url.split_once("/?token=").unwrap()
    }

    fn get(&self, request: &str) -> String {
        let (host, _) = self.place();
        http(host, &format!("GET {request} HTTP/1.1\r\nHost: {host}\r\n\r\n"))
    }

    fn page(&self) -> Page {
        let (host, token) = self.place();
        let stream = TcpStream::connect(host).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let request = tungstenite::http::Request::get(format!("ws://{host}/live?token={token}"))
            .header("Host", host)
            .header("Origin", format!("http://{host}"))
            .header("Connection", "Upgrade")
            .header("Upgrade", "websocket")
            .header("Sec-WebSocket-Version", "13")
            .header("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ==");
        let (socket, _) = tungstenite::client(request.body(()).unwrap(), stream).unwrap();
        Page { socket, state: Value::Null, next: 0 }
    }

    fn audit(&self, wanted: &str) -> Vec<Value> {
        let text = wait_for(&self.path("audit.jsonl"), wanted);
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }
}

fn http(host: &str, request: &str) -> String {
    let mut stream = TcpStream::connect(host).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

struct Page {
    socket: WebSocket<TcpStream>,
    state: Value,
    /// The number of the record after the latest.
    next: u64,
}

impl Page {
    fn step(&mut self) -> Value {
        match self.socket.read().unwrap() {
            Message::Binary(bytes) => {
                self.next = u64::from_le_bytes(bytes[8..16].try_into().unwrap());
                let received = json!({ "received": self.next });
                self.socket.send(Message::text(received.to_string())).unwrap();
                Value::Null
            }
            Message::Text(text) => {
                let value: Value = serde_json::from_str(text.as_str()).unwrap();
                if value["type"] == "state" {
                    self.state = value.clone();
                }
                value
            }
            _ => Value::Null,
        }
    }

    fn until(&mut self, holds: impl Fn(&Self) -> bool) {
        while !holds(self) {
            self.step();
        }
    }

    fn ask(&mut self, request: &str, parameters: &Value) -> Result<(), String> {
        let message = json!({ "number": 1, "request": request, "parameters": parameters });
        self.socket.send(Message::text(message.to_string())).unwrap();
        loop {
            let value = self.step();
            if value["type"] == "answer" {
                return value["error"].as_str().map_or(Ok(()), |error| Err(error.to_owned()));
            }
        }
    }
}

#[test]
fn the_page_is_one_more_client_which_listens_and_is_recorded() {
    let mut web = Web::start("-d virtual:load=20 -b 500k --db car.dbc --allow send --metrics 0", 3);
    let (host, token) = web.place();
    assert!(host.starts_with("127.0.0.1:") && token.len() == 32, "{host} {token}");
    let answer = web.get(&format!("/?token={token}"));
    assert!(answer.starts_with("HTTP/1.1 200 OK\r\n"), "{answer}");
    assert!(
        answer.contains("\"command\":\"cantap serve\"") && answer.contains("\"name\":\"car.dbc\""),
        "{answer}"
    );
    assert!(!answer.contains(token), "{answer}");
    assert!(web.get("/").starts_with("HTTP/1.1 403 "));
    let mut page = web.page();
    page.until(|page| page.next > 100);
    // What is allowed everywhere is not allowed to pages.
    assert_eq!(page.state["maySend"], false);
    for (request, parameters) in [
        ("mode", json!({ "normal": true, "confirmed": true })),
        ("send", json!({ "channel": 1, "frame": "123#11" })),
    ] {
        let error = page.ask(request, &parameters).unwrap_err();
        assert!(error.contains("cantap serve --allow web:send"), "{error}");
    }
    // Nothing is recorded where the server runs.
    assert!(page.ask("record", &json!({ "name": "drive.log" })).unwrap_err().contains("records nothing"));
    assert!(!web.path("drive.log").exists());
    let metrics = web.server.at[1].strip_prefix("http://").unwrap();
    let (place, _) = metrics.split_once('/').unwrap();
    let figures = http(place, &format!("GET /metrics HTTP/1.1\r\nHost: {place}\r\n\r\n"));
    assert!(figures.contains("cantap_pages{board=\"virtual:load=20\"} 1"), "{figures}");
    // Another program sees the same bus.
    let capture = format!(
        "capture -d unix:{} -n 50 -o {}",
        web.path("cantap.sock").display(),
        web.path("c.log").display()
    );
    let (code, _, err) = run(&capture);
    assert_eq!(code, Some(0), "{err}");
    let local = page.socket.get_ref().local_addr().unwrap();
    drop(page);
    let events = web.audit("\"event\":\"left\"");
    let of_page = |event: &str| {
        let found = events.iter().find(|of| of["event"] == event && of["address"] == local.to_string());
        found.unwrap_or_else(|| panic!("{event}: {events:?}")).clone()
    };
    assert_eq!(of_page("came")["client"], format!("page {local}"));
    assert!(of_page("not_done")["text"].as_str().unwrap().contains("take part in the buses"));
    assert!(
        events
            .iter()
            .any(|event| event["event"] == "refused" && event["text"].as_str().unwrap().contains("token"))
    );
    assert!(
        events.iter().any(|event| event["event"] == "opened" && event["client"] == "the page"),
        "{events:?}"
    );
    // The token is nowhere but in the address.
    for file in ["audit.jsonl", "remarks"] {
        assert!(!std::fs::read_to_string(web.path(file)).unwrap().contains(web.place().1), "{file}");
    }
    // A page that is open learns of the end.
    let mut page = web.page();
    page.until(|page| page.next > 100);
    assert!(web.server.interrupt().success());
    let end = loop {
        match page.socket.read() {
            Ok(Message::Close(Some(frame))) => break frame,
            Ok(_) => {}
            Err(error) => panic!("{error}"),
        }
    };
    assert_eq!(u16::from(end.code), 1001);
}

#[test]
fn with_its_own_permission_a_page_sends_and_everybody_can_know() {
    let web = Web::start("-d virtual:load=0 -b 500k --allow web:send", 2);
    wait_for(&web.path("remarks"), "whoever has the address of the page can send");
    let mut page = web.page();
    page.until(|page| page.state["channels"].as_array().is_some_and(|channels| channels.len() == 2));
    assert_eq!(page.state["maySend"], true);
    page.ask("mode", &json!({ "normal": true, "confirmed": true })).unwrap();
    page.ask("send", &json!({ "channel": 1, "frame": "123#C0FFEE" })).unwrap();
    let events = web.audit("\"event\":\"sent\"");
    let local = page.socket.get_ref().local_addr().unwrap();
    assert!(events.iter().any(|event| {
        event["event"] == "asked"
            && event["address"] == local.to_string()
            && event["text"].as_str().unwrap().contains("send 123#C0FFEE on channel 1")
    }));
}

/// What helps to understand the bus reaches the page as it does with `cantap ui`.
#[test]
fn the_page_is_told_who_talks_to_whom() {
    let web = Web::start("-d virtual:load=0 -b 500k --pair 6F1/12:612/F1 --xcp 7F0:7F1 --ccp 123:124", 2);
    let (_, token) = web.place();
    let answer = web.get(&format!("/?token={token}"));
    let expected =
        json!({ "pairs": ["6F1/12:612/F1"], "xcp": ["7F0:7F1"], "ccp": ["123:124"], "subjects": [] });
    let (_, told) = answer.split_once("\"connections\":").unwrap_or_else(|| panic!("{answer}"));
    let told = serde_json::Deserializer::from_str(told).into_iter::<Value>().next();
    assert_eq!(told.unwrap().unwrap(), expected);
}

/// The shared board goes and comes back: the server says so, and the page goes on.
#[test]
fn a_page_sees_a_board_that_goes_and_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("board.sock").display().to_string();
    let board = || Server::start(&format!("-d virtual:load=20 -b 500k --unix {path}"), 1);
    let first = board();
    let web = Web::start(&format!("-d unix:{path} -b 500k"), 2);
    let mut page = web.page();
    page.until(|page| page.next > 100);
    drop(first);
    page.until(|page| page.state["devices"][0]["isThere"] == false);
    let so_far = page.next;
    let _second = board();
    page.until(|page| page.state["devices"][0]["isThere"] == true);
    page.until(|page| page.next > so_far + 100);
}

#[test]
fn what_cannot_be_is_refused_before_anything_is_shared() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("page.html"), PAGE).unwrap();
    for (arguments, code, reason) in [
        ("--web 0.0.0.0", 2, "everybody on every network"),
        ("--web [::]:1", 2, "everybody on every network"),
        ("--web 192.0.2.1:80", 2, "cantap ui -d tls://"),
        ("--web localhost", 2, "is not an address"),
        ("--db car.dbc", 2, "give --web, too"),
        ("--xcp 7F0:7F1", 2, "--xcp is for the page; give --web, too"),
        ("--eds drive.eds", 2, "--eds is for the page; give --web, too"),
        ("--web --db none.dbc", 1, "none.dbc"),
        ("--web --eds none.eds", 1, "none.eds"),
        ("--web --subject 1620=uavcan.Nothing.1.0", 1, "uavcan.Nothing.1.0"),
        ("--web --allow page:send", 2, "web"),
    ] {
        let mut command =
            cantap(&format!("serve -d virtual -b 500k --unix {} {arguments}", socket(folder.path())));
        let output = command.env("CANTAP_PAGE", folder.path().join("page.html")).output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(
            output.status.code() == Some(code) && text.contains(reason),
            "{arguments}: {:?} {text}",
            output.status
        );
        assert!(output.stdout.is_empty() && !Path::new(&socket(folder.path())).exists(), "{arguments}");
    }
}
