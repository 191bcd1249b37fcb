//! candump's log lines over TCP, for `nc` and for SavvyCAN's log server: clients receive and cannot send.

use std::io;
use std::net::SocketAddr;
use std::net::TcpStream;
use std::sync::Arc;

use cantap::device::{channel_number, is_idle, write_patiently};
use cantap::{Device, TraceRecord};
use cantap_wire::message::Role;
use cantap_wire::{Channel, Refusal};

use crate::door::{AdmittedClient, Door};
use crate::feed::{self, Feed, Losses, Source};
use crate::foreign;
use crate::left_out::{LOST, LeftOut};
use crate::listen::{Listening, only_loopback, turn_away};
use crate::places::NoPlace;
use crate::writer::PATIENCE;
use crate::{Board, News};

/// Limit for records waiting for one client, in addition to those in the server's queue.
const HELD_RECORDS: usize = 1 << 16;

/// Admits clients at an address of this machine (loopback). They receive every channel of the boards whose bit rate is known, with
/// consecutive numbers as everywhere.
pub fn listen(boards: &[Arc<Board>], address: SocketAddr) -> io::Result<Listening> {
    only_loopback(address)?;
    let most = boards.first().map_or(0, |board| board.most_clients());
    let door = Door::open("line reader", address, Role::Listen, most)?;
    let boards = boards.to_vec();
    Listening::start("cantap-lines", Some(door.address), move || {
        let of_client = boards.clone();
        let turn_away = |stream: &mut TcpStream, name: String, full: NoPlace| {
            turn_away(&boards[0], stream, name, &full);
        };
        door.admit(turn_away, move |visitor| {
            let AdmittedClient { stream, name, place, .. } = visitor;
            // It need not say anything.
            place.is_served();
            if let Err(reason) = serve(&of_client, stream, &name) {
                of_client[0].tell(News::Refused { client: name, reason });
            }
        })
    })
}

/// A device for a board of this process, for a client that has its place at a listener.
pub(crate) fn device_of(board: &Board, name: &str, role: Role) -> Result<Device, String> {
    let link = board.link_placed(name, role).map_err(|refused| refused.to_string())?;
    Device::over_holding(link, name, HELD_RECORDS.min(board.most_records()))
        .map_err(|error| error.to_string())
}

fn serve(boards: &[Arc<Board>], stream: TcpStream, name: &str) -> Result<(), String> {
    if is_over(&stream)? {
        return Ok(());
    }
    let mut sources = Vec::new();
    for board in boards {
        let device = Arc::new(device_of(board, name, Role::Listen)?);
        for channel in Channel::ALL {
            match device.open_channel(channel, None) {
                // The bit rate of its bus is unknown.
                Ok(_) | Err(cantap::DeviceError::Refused { refusal: Refusal::NothingSaved }) => {}
                Err(error) => return Err(error.to_string()),
            }
        }
        sources.push(Source::new(board, &device));
    }
    let mut lines = Lines { stream, out: String::new(), stranger: None };
    let untold = feed::run(&mut sources, &mut lines);
    if let Some(reason) = lines.stranger {
        return Err(reason);
    }
    let mut left_out = LeftOut::default();
    left_out.count(LOST, untold);
    left_out.report(true, &boards[0], name);
    Ok(())
}

/// A client's lines.
struct Lines {
    stream: TcpStream,
    out: String,
    /// What it speaks instead of nothing.
    stranger: Option<String>,
}

impl Feed for Lines {
    fn is_over(&mut self) -> bool {
        if !self.out.is_empty() {
            return false;
        }
        is_over(&self.stream).unwrap_or_else(|reason| {
            self.stranger = Some(reason);
            true
        })
    }

    fn take(&mut self, source: usize, records: &[TraceRecord]) -> Losses {
        for record in records {
            let Some(channel) = Channel::from_number(record.channel) else { continue };
            crate::text::put_line(&mut self.out, channel_number(source, channel), record);
        }
        Losses::ToldByWriting
    }

    fn is_empty(&self) -> bool {
        self.out.is_empty()
    }

    fn write(&mut self) -> io::Result<()> {
        write_patiently(&mut self.stream, self.out.as_bytes(), PATIENCE)?;
        self.out.clear();
        Ok(())
    }
}

/// Whether the other end has closed, as far as that shows without sending. An error says what a client that speaks another protocol speaks:
/// a browser that a web page has sent here, for example.
fn is_over(stream: &TcpStream) -> Result<bool, String> {
    let mut first = [0; foreign::ENOUGH];
    match stream.peek(&mut first) {
        Ok(0) => Ok(true),
        Ok(len) if foreign::protocol(&first[..len]).is_some() => Err(foreign::reason(&first[..len])),
        Ok(_) => Ok(false),
        Err(error) => Ok(!is_idle(&error)),
    }
}
