//! What a server counts, for Prometheus: text over HTTP, which answers `GET /metrics` and nothing else.
//!
//! A web page can make a browser ask here, also by a name of its own that leads to this computer. So a request must name an address, or
//! `localhost`, as its host, and nothing in the answer allows a page of another origin to read it.

use std::fmt::Write as _;
use std::io::{self, Write as _};
use std::net::{IpAddr, SocketAddr, TcpStream};
use std::sync::{Arc, Weak};
use std::time::Duration;

use cantap::device::{channel_number, write_patiently};
use cantap_wire::Channel;
use cantap_wire::message::Role;

use crate::Board;
use crate::board_figures::BoardFigures;
use crate::door::{AdmittedClient, Door};
use crate::listen::Listening;
use crate::totals::ChannelTotals;

/// Longest request.
const MOST_BYTES: usize = 8 * 1024;
/// A request must be whole, and its answer taken, within this time.
const PATIENCE: Duration = Duration::from_secs(5);
/// Limit for connections at a time: a scraper needs one.
const MOST_CONNECTIONS: usize = 8;

/// Answers at an address. Whoever reaches it reads it: there is no authentication, and the only names in it are the boards'.
pub fn listen(boards: &[Arc<Board>], address: SocketAddr) -> io::Result<Listening> {
    let door = Door::open("metrics reader", address, Role::Listen, MOST_CONNECTIONS)?;
    // A connection does not keep a server that ends from leaving its buses.
    let names = distinct(boards.iter().map(|board| board.name()));
    let boards: Vec<(String, Weak<Board>)> =
        names.into_iter().zip(boards.iter().map(Arc::downgrade)).collect();
    Listening::start("cantap-metrics", Some(door.address), move || {
        let boards = boards.clone();
        let turn_away = |_: &mut TcpStream, _, _| ();
        door.admit(turn_away, move |visitor| {
            // Whoever has left needs no answer.
            let _ = serve(&boards, visitor);
        })
    })
}

/// The boards' names as labels. Of several boards with one name, the second has `#2` after it: two rows with the same labels would be no
/// metrics.
fn distinct<'n>(names: impl Iterator<Item = &'n str>) -> Vec<String> {
    let mut all: Vec<String> = Vec::new();
    for name in names {
        let numbered = (2..).map(|number| format!("{name}#{number}"));
        let mut candidates = std::iter::once(name.to_owned()).chain(numbered);
        all.extend(candidates.find(|candidate| !all.contains(candidate)));
    }
    all
}

fn serve(boards: &[(String, Weak<Board>)], mut visitor: AdmittedClient) -> io::Result<()> {
    let mut request = Vec::new();
    let mut bytes = [0; 1024];
    let end = b"\r\n\r\n";
    while !request.windows(end.len()).any(|window| window == end) {
        if request.len() > MOST_BYTES || visitor.has_been_for(PATIENCE) {
            return Ok(());
        }
        let Some(len) = visitor.read(&mut bytes) else { return Ok(()) };
        request.extend_from_slice(&bytes[..len]);
    }
    let (status, body) = match check(&request) {
        Ok(()) => ("200 OK", text(boards)),
        Err(status) => (status, format!("{status}\n")),
    };
    let answer = format!(
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\nContent-Length: {}\r\n\
         Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\nConnection: close\r\n\r\n{body}",
        body.len()
    );
    write_patiently(&mut visitor.stream, answer.as_bytes(), PATIENCE)?;
    visitor.stream.flush()
}

/// Whether a request is answered; if not, with which status.
fn check(request: &[u8]) -> Result<(), &'static str> {
    const BAD: &str = "400 Bad Request";
    let text = std::str::from_utf8(request).map_err(|_| BAD)?;
    let head = text.split("\r\n\r\n").next().unwrap_or_default();
    let mut lines = head.split("\r\n");
    let first: Vec<&str> = lines.next().unwrap_or_default().split(' ').collect();
    let [method, path, "HTTP/1.1" | "HTTP/1.0"] = first[..] else { return Err(BAD) };
    let mut hosts = lines.filter_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.eq_ignore_ascii_case("host").then(|| value.trim())
    });
    let (Some(host), None) = (hosts.next(), hosts.next()) else { return Err(BAD) };
    if !is_address(host) {
        return Err("421 Misdirected Request");
    }
    match (method, path) {
        ("GET", "/metrics") => Ok(()),
        ("GET", _) => Err("404 Not Found"),
        _ => Err("405 Method Not Allowed"),
    }
}

/// Whether a host is given by its address, with or without a port, or as this computer.
fn is_address(host: &str) -> bool {
    let name =
        host.rsplit_once(':').filter(|(_, port)| port.parse::<u16>().is_ok()).map_or(host, |(name, _)| name);
    host.parse::<SocketAddr>().is_ok()
        || name.eq_ignore_ascii_case("localhost")
        || name.trim_matches(['[', ']']).parse::<IpAddr>().is_ok()
}

/// Adds a line: its labels and its figure.
type Row<'a> = &'a mut dyn FnMut(&str, u64);
/// One figure of a channel.
type OfChannel = fn(&ChannelTotals) -> u64;

/// All figures in Prometheus's text format.
fn text(boards: &[(String, Weak<Board>)]) -> String {
    let mut out = String::new();
    let all: Vec<_> =
        boards.iter().filter_map(|(name, board)| Some((label(name), board.upgrade()?.figures()))).collect();
    let mut family = |name: &str, kind: &str, help: &str, rows: &mut dyn FnMut(Row<'_>)| {
        // Writing to memory cannot fail.
        let _ = write!(out, "# HELP {name} {help}\n# TYPE {name} {kind}\n");
        rows(&mut |labels, value| {
            let _ = writeln!(out, "{name}{{{labels}}} {value}");
        });
    };
    let mut of_boards = |name: &str, kind: &str, help: &str, of: fn(&BoardFigures) -> u64| {
        family(name, kind, help, &mut |row| {
            for (board, metrics) in &all {
                row(&format!("board=\"{board}\""), of(metrics));
            }
        });
    };
    of_boards("cantap_board_up", "gauge", "Whether the board is there.", |of| of.is_there.into());
    of_boards("cantap_clients", "gauge", "Clients with a connection.", |of| of.clients);
    of_boards("cantap_pages", "gauge", "Pages that are open, on the first board.", |of| of.pages);
    of_boards("cantap_places", "gauge", "Limit for clients at each listener.", |of| of.places);
    of_boards("cantap_refused_total", "counter", "Connections and requests that were refused.", |of| {
        of.refused
    });
    let mut of_channels = |name: &str, help: &str, of: OfChannel| {
        family(name, "counter", help, &mut |row| {
            for (number, (board, metrics)) in all.iter().enumerate() {
                for (channel, totals) in Channel::ALL.into_iter().zip(&metrics.channels) {
                    let channel = channel_number(number, channel);
                    row(&format!("board=\"{board}\",channel=\"{channel}\""), of(totals));
                }
            }
        });
    };
    of_channels("cantap_frames_received_total", "Frames received.", |of| of.received);
    of_channels("cantap_frames_sent_total", "Frames that the board sent.", |of| of.transmitted);
    of_channels(
        "cantap_bus_bits_total",
        "Bits of these frames on the bus; the rate over the bit rate is the load.",
        |of| of.bits,
    );
    of_channels("cantap_send_failures_total", "Frames that could not be sent.", |of| of.transmit_failures);
    of_channels("cantap_bus_errors_total", "Bus errors.", |of| of.bus_errors);
    of_channels(
        "cantap_off_bus_total",
        "How often the board was off the bus while somebody listened.",
        |of| of.off_bus,
    );
    let stages: [(&str, OfChannel); 4] = [
        ("controller", |of| of.lost_controller),
        ("queue", |of| of.lost_queue),
        ("link", |of| of.lost_link),
        ("host", |of| of.lost_host),
    ];
    let help = "Frames lost, by stage; those of the stage host are the sum over the clients that lost them; an adapter that does not count its losses has no controller stage.";
    family("cantap_frames_lost_total", "counter", help, &mut |row| {
        for (number, (board, metrics)) in all.iter().enumerate() {
            for (channel, totals) in Channel::ALL.into_iter().zip(&metrics.channels) {
                let channel = channel_number(number, channel);
                for (stage, of) in stages {
                    // What nobody counts has no figure.
                    if stage == "controller" && !metrics.counts_losses {
                        continue;
                    }
                    row(&format!("board=\"{board}\",channel=\"{channel}\",stage=\"{stage}\""), of(totals));
                }
            }
        }
    });
    family("cantap_bitrate_bps", "gauge", "Bit rate of each channel that is open.", &mut |row| {
        for (number, (board, metrics)) in all.iter().enumerate() {
            for (channel, bitrate_bps) in Channel::ALL.into_iter().zip(metrics.bitrates_bps) {
                let channel = channel_number(number, channel);
                if let Some(bitrate_bps) = bitrate_bps {
                    row(&format!("board=\"{board}\",channel=\"{channel}\""), bitrate_bps.into());
                }
            }
        }
    });
    out
}

/// A label's value: what would end it is escaped.
fn label(text: &str) -> String {
    text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boards_of_one_name_have_labels_of_their_own() {
        let labels = |names: &[&str]| distinct(names.iter().copied());
        assert_eq!(labels(&["a", "b"]), ["a", "b"]);
        assert_eq!(labels(&["a", "a", "a#2", "a"]), ["a", "a#2", "a#2#2", "a#3"]);
    }

    #[test]
    fn only_the_figures_are_given_and_only_to_whoever_asks_for_an_address() {
        let ask = |first: &str, host: &str| check(format!("{first}\r\nHost: {host}\r\n\r\n").as_bytes());
        for host in ["127.0.0.1:29539", "localhost", "LocalHost:1", "[::1]:29539", "192.0.2.7"] {
            assert_eq!(ask("GET /metrics HTTP/1.1", host), Ok(()), "{host}");
        }
        // A name of somebody else's that leads here.
        for host in ["evil.example:29539", "localhost.evil.example", "", "127.0.0.1.evil.example"] {
            assert_eq!(ask("GET /metrics HTTP/1.1", host), Err("421 Misdirected Request"), "{host}");
        }
        let status = |first: &str| ask(first, "localhost").err().map(|status| &status[..3]);
        assert_eq!(status("GET / HTTP/1.1"), Some("404"));
        assert_eq!(status("GET /metrics/../x HTTP/1.1"), Some("404"));
        assert_eq!(status("POST /metrics HTTP/1.1"), Some("405"));
        for bad in ["GET /metrics", "GET /metrics HTTP/2", "", "GET  /metrics HTTP/1.1", "\0"] {
            assert_eq!(status(bad), Some("400"), "{bad}");
        }
        assert_eq!(check(b"GET /metrics HTTP/1.1\r\n\r\n"), Err("400 Bad Request"));
        let twice = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n";
        assert_eq!(check(twice), Err("400 Bad Request"));
    }

    #[test]
    fn a_board_s_name_stays_within_its_label() {
        assert_eq!(label("a\"} 1\nx\\"), "a\\\"} 1\\nx\\\\");
    }
}
