//! What a test may send while a kernel drives the board: for each line, one answer. An answer is an object with the figures, or a
//! line that begins with `error:`.

use std::fs;
use std::path::Path;

use cantap_wire::{CHANNELS, Frame};
use serde_json::json;

use super::board::{Board, BusLoad, Crossed};
use cantap_emu::traffic::Kind;
use cantap_emu::usb_host::Request;

const SET_ENDPOINT_FEATURE: (u8, u8) = (0x02, 3);
const ENDPOINT_HALT: u16 = 0;

/// What a line asks for that does not concern the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ServerAction {
    /// Nothing.
    None,
    /// Whether time stands still while the kernel does not read.
    ClientPace(bool),
    /// The cable is plugged into the QEMU that waits for a device.
    Redirect,
    /// The cable is pulled.
    Unplug,
    /// The end.
    Quit,
}

/// Carries out a line.
pub fn obey(line: &str, board: &mut Board, folder: &Path) -> Result<ServerAction, String> {
    let words: Vec<&str> = line.split_whitespace().collect();
    match words[..] {
        ["status"] => {}
        ["mark"] => board.mark(),
        // Traffic on both channels, once they are opened.
        ["traffic", percent, kind, ref rate @ ..] => {
            let bitrate_bps = match *rate {
                [] => None,
                [rate] => Some(number(rate)?),
                _ => return Err("traffic PERCENT KIND [BITRATE]".to_owned()),
            };
            board.set_load(load(percent, kind, bitrate_bps)?);
        }
        ["play", channel, percent, kind, count] => {
            board.play(index(channel)?, load(percent, kind, None)?, number(count)?);
        }
        ["send", channel, frame] => {
            let frame = frame.parse::<Frame>().map_err(|error| error.to_string())?;
            board.send(index(channel)?, frame);
        }
        ["acknowledge", yes_or_no] => board.acknowledge(yes_or_no == "yes"),
        ["noise", percent] => board.make_noise(number(percent)?),
        ["pace", "client"] => return Ok(ServerAction::ClientPace(true)),
        ["pace", "real"] => return Ok(ServerAction::ClientPace(false)),
        // Puts the device behind a high-speed hub, with this many microframes per transaction; 0 is a root port again.
        ["hub", microframes] => {
            let microframes = number(microframes)?;
            board.with_host(|host, _| *host.timing_mut() = host.timing_mut().behind_hub(microframes));
        }
        // Every n-th handshake is lost; 0 loses none.
        ["lose", every] => {
            let every = number(every)?;
            board.with_host(|host, _| host.drop_handshake_every(Some(every).filter(|every| *every > 1)));
        }
        // Halts an endpoint, given by its address in hexadecimal, behind the kernel's back, which then sees STALL.
        ["halt", address] => {
            let address = u16::from_str_radix(address, 16).map_err(|error| error.to_string())?;
            let (kind, request) = SET_ENDPOINT_FEATURE;
            board.with_urbs(|urbs| urbs.ask(Request::new(kind, request, ENDPOINT_HALT, address, 0)));
        }
        ["suspend"] => board.with_host(|host, _| host.suspend()),
        ["resume"] => board.with_host(cantap_emu::usb_host::UsbHost::resume),
        ["redirect"] => return Ok(ServerAction::Redirect),
        ["unplug"] => return Ok(ServerAction::Unplug),
        // Writes what each controller received and sent, as FOLDER/NAME.taken1 and so on; NAME.stamps1 has when each of the received
        // frames was valid, in nanoseconds.
        ["dump", name] => dump(board, folder, name)?,
        ["quit"] => return Ok(ServerAction::Quit),
        _ => return Err(format!("no such line: {line}")),
    }
    Ok(ServerAction::None)
}

fn number<T: std::str::FromStr>(text: &str) -> Result<T, String> {
    text.parse().map_err(|_| format!("not a number: {text}"))
}

fn load(percent: &str, kind: &str, bitrate_bps: Option<u32>) -> Result<BusLoad, String> {
    Ok(BusLoad { percent: number(percent)?, kind: kind.parse::<Kind>()?, bitrate_bps })
}

fn index(channel: &str) -> Result<usize, String> {
    let number = number::<usize>(channel)?;
    if (1..=CHANNELS).contains(&number) { Ok(number - 1) } else { Err(format!("no such channel: {channel}")) }
}

fn dump(board: &Board, folder: &Path, name: &str) -> Result<(), String> {
    for n in 0..CHANNELS {
        let (taken, sent) = board.books(n);
        let lines = |frames: &[Crossed], line: &dyn Fn(&Crossed) -> String| {
            frames.iter().fold(String::new(), |lines, crossed| lines + &line(crossed) + "\n")
        };
        let frame = |crossed: &Crossed| crossed.frame.to_string();
        let stamp = |crossed: &Crossed| (crossed.valid * 1000 / board.clock().us(1)).to_string();
        for (what, lines) in
            [("taken", lines(taken, &frame)), ("stamps", lines(taken, &stamp)), ("sent", lines(sent, &frame))]
        {
            let path = folder.join(format!("{name}.{what}{}", n + 1));
            fs::write(&path, lines).map_err(|error| format!("{}: {error}", path.display()))?;
        }
    }
    Ok(())
}

/// The figures since the mark, as one line.
pub fn figures(board: &Board) -> String {
    let (from, now) = board.figures();
    let count = |field: fn(&super::board::Figures) -> u64| field(&now) - field(&from);
    let (taken, sent): (Vec<_>, Vec<_>) =
        (0..CHANNELS).map(|n| (board.books(n).0.len(), board.books(n).1.len())).unzip();
    let each = |field: fn(&super::board::Figures) -> [u64; CHANNELS]| {
        std::iter::zip(field(&now), field(&from)).map(|(now, from)| now - from).collect::<Vec<_>>()
    };
    json!({
        "wall_s": (now.at - from.at).as_secs_f64(),
        "emulated_s": count(|f| f.cycles) as f64 / board.clock().hz() as f64,
        "computing_s": now.computing.as_secs_f64() - from.computing.as_secs_f64(),
        "starving_s": now.starving.as_secs_f64() - from.starving.as_secs_f64(),
        "taken": taken,
        "sent": sent,
        "dominant_bits": each(|f| f.dominant_bits),
        "openings": each(|f| f.openings),
        "in_packets": count(|f| f.usb.in_packets),
        "in_bytes": count(|f| f.usb.in_bytes),
        "out_packets": count(|f| f.usb.out_packets),
        "notifications": count(|f| f.usb.notifications),
        "repeated": count(|f| f.usb.repeated),
        "thrown_away": count(|f| f.usb.thrown_away),
        "next_data1": board.with_urbs(|urbs| urbs.next_data1()).map(u8::from),
        "silences": count(|f| f.usb.silences),
        "stalls": count(|f| f.usb.stalls),
        "dropped_handshakes": count(|f| f.usb.dropped_handshakes),
        "bus_resets": count(|f| f.bus_resets),
        "chip_resets": count(|f| f.chip_resets),
        "odd_accesses": board.machine().board().odd_accesses().len(),
    })
    .to_string()
}
