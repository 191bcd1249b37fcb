//! Answers to Wireshark's questions before a capture: interfaces, their link type, their options, the toolbar. They are sentences of
//! extcap(4).

use std::fmt::Write;

use super::bit_rates::OFFERED;
use super::places::Place;
use super::toolbar::{Control, MODES};

/// SocketCAN's link type.
const LINK_TYPE: u16 = 227;

/// Makes a text safe for a sentence: braces and line ends would end it.
fn clean(text: &str) -> String {
    let ends = |char| matches!(char, '{' | '}') || cantap_trace::clean::is_harmful(char);
    text.chars().map(|char| if ends(char) { ' ' } else { char }).collect()
}

/// The interfaces, and the toolbar that they share.
pub fn interfaces(places: &[Place]) -> String {
    let mut out = format!("extcap {{version={}}}\n", env!("CARGO_PKG_VERSION"));
    for place in places {
        let _ = writeln!(out, "interface {{value={}}}{{display={}}}", place.name(), clean(&place.shown()));
    }
    for control in Control::ALL {
        let _ = writeln!(out, "control {{number={}}}{}", control.number(), control.description());
    }
    let mut value = |control: Control, value: &str, shown: &str, default: bool| {
        let number = control.number();
        let _ = writeln!(
            out,
            "value {{control={number}}}{{value={value}}}{{display={shown}}}{{default={default}}}"
        );
    };
    for control in [Control::BitRate1, Control::BitRate2] {
        value(control, "", "as opened", true);
        for (rate, shown) in OFFERED {
            value(control, rate, shown, false);
        }
    }
    value(Control::Mode, "", "as opened", true);
    for (mode, shown) in MODES {
        // If this control becomes wider, load and losses are truncated: "1: 30 %" showed as "0 %".
        let short = shown.split(':').next().unwrap_or(shown);
        value(Control::Mode, mode, short, false);
    }
    out
}

/// The link type, which is the same for all.
pub fn link_types() -> String {
    format!("dlt {{number={LINK_TYPE}}}{{name=CAN_SOCKETCAN}}{{display=SocketCAN}}\n")
}

/// The options before a capture. The first value of each is the default.
pub fn config(place: &Place) -> String {
    let mut out = String::new();
    let mut number = 0;
    let mut arg = |out: &mut String, call: &str, rest: &str, values: &[(&str, &str)]| {
        let _ = writeln!(out, "arg {{number={number}}}{{call=--{call}}}{rest}");
        for (at, (value, shown)) in values.iter().enumerate() {
            let default = at == 0;
            let _ = writeln!(
                out,
                "value {{arg={number}}}{{value={value}}}{{display={shown}}}{{default={default}}}"
            );
        }
        number += 1;
    };
    if *place == Place::Address {
        let default = if cfg!(unix) { "unix:" } else { "tcp://127.0.0.1" };
        let rest = format!(
            "{{display=Device}}{{type=string}}{{default={default}}}{{required=true}}{{tooltip=A server (cantap serve): unix:PATH, \
             tcp://HOST:PORT, tls://HOST:PORT or ssh://[USER@]HOST[/DEVICE]; a serial port; virtual:OPTIONS; emu:FIRMWARE.elf}}"
        );
        arg(&mut out, "device", &rest, &[]);
    }
    let auto = [("auto", "saved on the board, else found by listening")];
    let off = [("off", "not captured")];
    let rates = [&auto[..], &OFFERED, &off].concat();
    for channel in [1, 2] {
        let rest = format!(
            "{{display=Bit rate of channel {channel}}}{{type=selector}}{{tooltip=A wrong one shows errors and no frames. \
             It disturbs nobody while the channel only listens}}"
        );
        arg(&mut out, &format!("bitrate{channel}"), &rest, &rates);
    }
    let rest = "{display=Mode}{type=selector}{tooltip=With only one other node on the bus, somebody has to acknowledge its frames}";
    arg(&mut out, "mode", rest, &MODES);
    out
}

#[cfg(test)]
mod tests {
    use cantap::device::Board;

    use super::*;

    /// Whether a line is a sentence: a word, and values in braces.
    fn is_sentence(line: &str) -> bool {
        let Some((word, values)) = line.split_once(' ') else { return false };
        let values = values.strip_prefix('{').and_then(|values| values.strip_suffix('}'));
        word.bytes().all(|byte| byte.is_ascii_lowercase())
            && values.is_some_and(|values| {
                values.split("}{").all(|value| value.contains('=') && !value.contains(['{', '}']))
            })
    }

    #[test]
    fn everything_that_is_said_is_a_sentence() {
        let board = Board {
            port: "/dev/ttyACM0".to_owned(),
            serial_number: None,
            product: Some("a {board}\nof mine".to_owned()),
        };
        let places = [Place::Board(board, "cantap-ttyACM0".to_owned()), Place::Virtual, Place::Address];
        let said = [interfaces(&places), link_types(), places.iter().map(config).collect()].concat();
        for line in said.lines() {
            assert!(is_sentence(line), "{line}");
        }
        assert!(said.contains("{display=a  board  of mine, CAN analyser at /dev/ttyACM0}"), "{said}");
        assert!(said.contains("dlt {number=227}{name=CAN_SOCKETCAN}"));
        // Only if somebody has to give the address.
        assert_eq!(said.matches("call=--device").count(), 1);
        assert!(said.contains(
            "{value=listen-only}{display=listen only: send and acknowledge nothing}{default=true}"
        ));
    }
}
