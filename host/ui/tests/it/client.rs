//! A server for tests, and a page's side of its connection.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use cantap::wire::message::Role;
use cantap_address::Address;
use cantap_signals::Decoder;
use cantap_trace::{TraceRecord, packed};
use cantap_ui::{Device, Server, Site, Source, Stopper, Visit};
use cantap_work::boards::Boards;
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::channels::Channels;
use cantap_work::report::Reporter;
use serde_json::{Value, json};
use tungstenite::http::Request;
use tungstenite::{Message, WebSocket};

/// A page of the right form.
pub const PAGE: &str =
    "<html><meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'\"><p>page</p></html>";
/// Longer than anything here takes.
const PATIENCE: Duration = Duration::from_mins(1);

/// A server that runs.
pub struct Running {
    pub address: SocketAddr,
    pub token: String,
    /// What it reports.
    pub reports: Receiver<String>,
    /// What visitors do.
    pub visits: Receiver<Visit>,
    stopper: Stopper,
    thread: Option<JoinHandle<()>>,
}

/// A virtual device's options, in a folder for recordings.
pub fn device(address: &str, folder: &Path, may_send: bool) -> Device {
    let addresses: Vec<Address> = vec![address.parse().unwrap()];
    Device {
        boards: Boards::new(&addresses, &Channels::all()).unwrap(),
        open: ChannelOptions::listening(vec![ChannelBitrate { channel: None, bitrate_bps: 500_000 }]),
        filters: Vec::new(),
        hosted: None,
        role: if may_send { Role::Send } else { Role::Configure },
        decoder: Decoder::new(Vec::new()),
        folder: Some(folder.to_owned()),
        record: None,
        dead_man: Duration::from_hours(1),
    }
}

impl Running {
    pub fn start(source: Source) -> Self {
        let (reports, received) = channel();
        let reporter = Reporter::new(move |_, text| drop(reports.send(text.to_owned())));
        let (visits, visited) = channel();
        let server = Server::open(
            Site::new(PAGE).unwrap(),
            source,
            "127.0.0.1:0".parse().unwrap(),
            reporter,
            Arc::new(move |_: &str, visit| drop(visits.send(visit))),
        );
        let server = server.unwrap();
        let url = server.url();
        let (address, token) = url.strip_prefix("http://").unwrap().split_once("/?token=").unwrap();
        let stopper = server.stopper();
        Self {
            address: address.parse().unwrap(),
            token: token.to_owned(),
            reports: received,
            visits: visited,
            stopper,
            thread: Some(std::thread::spawn(move || server.run().unwrap())),
        }
    }

    pub fn of(device: Device) -> Self {
        Self::start(Source::Device(Box::new(device)))
    }

    /// Sends a request as it is, and returns the answer's head and body.
    pub fn ask(&self, request: &str) -> (String, Vec<u8>) {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        // An answer that ends with a reset connection was still an answer.
        let _ = stream.read_to_end(&mut answer);
        let end =
            answer.windows(4).position(|window| window == b"\r\n\r\n").map_or(answer.len(), |at| at + 4);
        let body = answer.split_off(end);
        (String::from_utf8(answer).unwrap(), body)
    }

    /// Asks for a path with a query, as the page does.
    pub fn get(&self, path: &str) -> (String, Vec<u8>) {
        self.ask(&format!("GET {path} HTTP/1.1\r\nHost: {}\r\n\r\n", self.address))
    }

    /// Opens a WebSocket by this query, with this origin.
    pub fn socket(
        &self,
        query: &str,
        host: &str,
        origin: Option<&str>,
    ) -> Result<WebSocket<TcpStream>, String> {
        let stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut request = Request::get(format!("ws://{}/live?{query}", self.address))
            .header("Host", host)
            .header("Connection", "Upgrade")
            .header("Upgrade", "websocket")
            .header("Sec-WebSocket-Version", "13")
            .header("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ==");
        if let Some(origin) = origin {
            request = request.header("Origin", origin);
        }
        let request = request.body(()).unwrap();
        tungstenite::client(request, stream).map(|(socket, _)| socket).map_err(|error| error.to_string())
    }

    /// A page that begins.
    pub fn page(&self) -> Page {
        self.page_after("")
    }

    /// A page that goes on somewhere.
    pub fn page_after(&self, more: &str) -> Page {
        let host = self.address.to_string();
        let query = format!("token={}{more}", self.token);
        Page::new(self.socket(&query, &host, Some(&format!("http://{host}"))).unwrap())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stopper.stop();
        let ended = self.thread.take().map(JoinHandle::join);
        if !std::thread::panicking() {
            ended.unwrap().unwrap();
        }
    }
}

/// A page's side.
pub struct Page {
    pub socket: WebSocket<TcpStream>,
    pub run: String,
    pub state: Value,
    pub notices: Vec<String>,
    pub records: Vec<TraceRecord>,
    /// The number of the record after the latest.
    pub next: u64,
    /// Whether it says how far it has come.
    pub acknowledges: bool,
    answers: Vec<Value>,
    number: u64,
}

impl Page {
    fn new(socket: WebSocket<TcpStream>) -> Self {
        let mut page = Self {
            socket,
            run: String::new(),
            state: Value::Null,
            notices: Vec::new(),
            records: Vec::new(),
            next: 0,
            acknowledges: true,
            answers: Vec::new(),
            number: 0,
        };
        page.until(|page| !page.state.is_null() && !page.run.is_empty());
        page
    }

    /// Takes the next message.
    pub fn step(&mut self) -> Result<(), tungstenite::Error> {
        match self.socket.read()? {
            Message::Binary(bytes) => {
                let number = |at: usize| u64::from_le_bytes(bytes[8 * at..8 * at + 8].try_into().unwrap());
                let (first, next) = (number(0), number(1));
                assert!(first >= self.next, "{first} comes after {}", self.next);
                self.next = next;
                let mut rest = &bytes[24..];
                while let Some((len, after)) = rest.split_first_chunk::<4>() {
                    let (chunk, after) = after.split_at(u32::from_le_bytes(*len) as usize);
                    packed::read(chunk, |record| self.records.push(*record)).unwrap();
                    rest = after;
                }
                if self.acknowledges {
                    self.say(&json!({ "received": next }));
                }
            }
            Message::Text(text) => {
                let value: Value = serde_json::from_str(text.as_str()).unwrap();
                match value["type"].as_str().unwrap() {
                    "hello" => self.run = value["run"].as_str().unwrap().to_owned(),
                    "state" => self.state = value,
                    "notice" => self.notices.push(value["text"].as_str().unwrap().to_owned()),
                    "answer" => self.answers.push(value),
                    other => panic!("{other}"),
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Takes messages until this holds.
    pub fn until(&mut self, holds: impl Fn(&Self) -> bool) {
        while !holds(self) {
            self.step().unwrap();
        }
    }

    pub fn say(&mut self, value: &Value) {
        self.socket.send(Message::text(value.to_string())).unwrap();
    }

    /// Asks, and waits for the answer.
    pub fn ask(&mut self, request: &str, parameters: &Value) -> Result<Value, String> {
        self.number += 1;
        let number = self.number;
        self.say(&json!({ "number": number, "request": request, "parameters": parameters }));
        self.until(|page| page.answers.iter().any(|answer| answer["number"] == number));
        let answer = self.answers.iter().find(|answer| answer["number"] == number).unwrap();
        match answer["error"].as_str() {
            Some(error) => Err(error.to_owned()),
            None => Ok(answer["ok"].clone()),
        }
    }

    /// Frames so far.
    pub fn frames(&self) -> usize {
        self.records.iter().filter(|record| record.frame().is_some()).count()
    }
}
