//! How such a chip is set: what it is, what it can, and its bus.

use std::time::Duration;

use cantap_wire::Refusal;

use super::{ANSWER_WITHIN, Elm327, Family, INTERRUPT, Ids, QUIET, START_WITHIN};
use crate::driver::{OpenError, Opening};
use crate::interface_name::same_rate;

/// User protocol B (data sheet, "Programmable Parameters", PP 2C): 11 bit identifiers to send, data of any length, receive both kinds, no
/// formatting.
const BOTH_IDS: u8 = 0b1110_0000;
/// What the divisor of a user protocol divides, in bit/s, and its largest value.
const DIVIDED_BPS: u32 = 500_000;
const MAX_DIVISOR: u32 = 0x40;
/// CAN with an identifier of 11 bits and no formatting (STN manual, `STP`).
const STN_RAW_CAN: &str = "STP31";

/// An answer as lines, or the reason why there is none.
type Answer = Result<Option<Vec<String>>, String>;

impl Elm327 {
    /// Finds out what it is and what it can.
    pub(super) fn set_up(&mut self, ids: Option<Ids>, address: &str) -> Result<(), OpenError> {
        let expected = self.family.expected();
        let foreign = || OpenError::Foreign { address: address.to_owned(), expected };
        self.line.write(INTERRUPT);
        self.line.discard(QUIET).map_err(|_| foreign())?;
        let greeting = self.ask("ATZ", START_WITHIN).ok().flatten().ok_or_else(foreign)?;
        let banner = greeting.iter().find(|line| is_banner(line)).ok_or_else(foreign)?;
        self.version = version(banner);
        if self.family == Family::Stn {
            let stn = self.ask("STI", ANSWER_WITHIN).ok().flatten().unwrap_or_default();
            let stn = stn.iter().find(|line| line.starts_with("STN")).ok_or_else(foreign)?;
            self.version = version(stn);
        }
        // A chip that refuses one of these prints more than it must, or remembers what it was set to.
        for command in ["ATE0", "ATL0", "ATS0", "ATM0", "ATAL"] {
            self.ask(command, ANSWER_WITHIN).ok().flatten().ok_or_else(foreign)?;
        }
        // Without these, its lines are no frames.
        for command in ["ATH1", "ATCAF0"] {
            if !self.accepts(command, ANSWER_WITHIN) {
                return Err(OpenError::Unsuitable { address: address.to_owned(), command });
            }
        }
        let is_in_step = self.answers_in_step();
        self.is_silent = is_in_step && self.silence(true);
        if !is_in_step || !self.answers_in_step() {
            return Err(foreign());
        }
        if self.family == Family::Stn {
            self.has_dlc = self.accepts("ATD1", ANSWER_WITHIN);
            return Ok(());
        }
        self.ids = match ids {
            Some(ids) => ids,
            None if self.accepts(&user_protocol(1), ANSWER_WITHIN) => Ids::Both,
            None => Ids::Standard,
        };
        Ok(())
    }

    /// Whether the next answer is the one to the next command. Where answers come twice or late, a refusal to be silent would be taken for another
    /// command's `OK`.
    fn answers_in_step(&mut self) -> bool {
        let answer = self.ask("ATI", ANSWER_WITHIN);
        matches!(answer, Ok(Some(lines)) if lines.last().is_some_and(|line| is_banner(line)))
    }

    /// Sets whether it acknowledges nothing while it monitors. Returns whether it has confirmed that.
    fn silence(&mut self, is_silent: bool) -> bool {
        let stn = if is_silent { "STCMM0" } else { "STCMM1" };
        let elm = if is_silent { "ATCSM1" } else { "ATCSM0" };
        self.family == Family::Stn && self.accepts(stn, ANSWER_WITHIN) || self.accepts(elm, ANSWER_WITHIN)
    }

    /// Selects the bus: its bit rate, which identifiers, and whether to acknowledge frames.
    pub(super) fn select(&mut self, opening: Opening) -> Result<(), Refusal> {
        if !self.answers_in_step() {
            return Err(Refusal::Hardware);
        }
        let silent = self.silence(opening.listen_only);
        if opening.listen_only && !silent {
            return Err(Refusal::Unsupported);
        }
        if self.family == Family::Stn && self.accepts(STN_RAW_CAN, ANSWER_WITHIN) {
            let rate = format!("STPBR{}", opening.bitrate_bps);
            self.must(&rate, Refusal::BadTiming)?;
            // Every frame passes, and none is taken for a part of a longer message.
            self.must("STFCFC", Refusal::Unsupported)?;
            return self.must("STFAP00,00", Refusal::Unsupported);
        }
        let protocol = match (self.ids, opening.bitrate_bps) {
            (Ids::Both, rate) => {
                let divisor = divisor(rate).ok_or(Refusal::BadTiming)?;
                self.must(&user_protocol(divisor), Refusal::BadTiming)?;
                'B'
            }
            (Ids::Standard, 500_000) => '6',
            (Ids::Extended, 500_000) => '7',
            (Ids::Standard, 250_000) => '8',
            (Ids::Extended, 250_000) => '9',
            (Ids::Standard | Ids::Extended, _) => return Err(Refusal::BadTiming),
        };
        // `ATTP` is not remembered beyond this; an old copy may know `ATSP` alone.
        if !self.accepts(&format!("ATTP{protocol}"), ANSWER_WITHIN) {
            self.must(&format!("ATSP{protocol}"), Refusal::BadTiming)?;
        }
        // Some copies accept what they then do not do.
        match self.ask("ATDPN", ANSWER_WITHIN) {
            Ok(Some(lines)) => match lines.last().map(String::as_str) {
                Some("?") => Ok(()),
                Some(number) if number.trim_start_matches('A').ends_with(protocol) => Ok(()),
                _ => Err(Refusal::BadTiming),
            },
            Ok(None) | Err(_) => Err(Refusal::Hardware),
        }
    }

    /// What makes it monitor.
    pub(super) const fn monitor_command(&self) -> &'static str {
        match self.family {
            Family::Elm => "ATMA",
            // `STMA` takes every frame for a part of a longer message.
            Family::Stn => "STM",
        }
    }

    fn accepts(&mut self, command: &str, within: Duration) -> bool {
        is_ok(&self.ask(command, within))
    }

    fn must(&mut self, command: &str, refusal: Refusal) -> Result<(), Refusal> {
        match self.ask(command, ANSWER_WITHIN) {
            Ok(None) | Err(_) => Err(Refusal::Hardware),
            answer if is_ok(&answer) => Ok(()),
            Ok(Some(_)) => Err(refusal),
        }
    }
}

/// What it says of itself.
fn is_banner(line: &str) -> bool {
    line.contains("ELM32") || line.starts_with("OBDII")
}

fn is_ok(answer: &Answer) -> bool {
    matches!(answer, Ok(Some(lines)) if lines.last().is_some_and(|line| line == "OK"))
}

/// The command that sets user protocol B.
fn user_protocol(divisor: u32) -> String {
    format!("ATPB{BOTH_IDS:02X}{divisor:02X}")
}

/// The divisor of a bit rate, if there is one.
fn divisor(bitrate_bps: u32) -> Option<u32> {
    (1..=MAX_DIVISOR).find(|divisor| same_rate(DIVIDED_BPS / divisor, bitrate_bps))
}

/// The numbers behind the `v` of `ELM327 v1.5` and `STN1110 v4.0.4`.
fn version(banner: &str) -> [u16; 3] {
    let mut numbers = [0; 3];
    let text = banner.rsplit_once('v').map_or("", |(_, text)| text);
    for (number, digits) in numbers.iter_mut().zip(text.split('.')) {
        let digits: String = digits.chars().take_while(char::is_ascii_digit).collect();
        *number = digits.parse().unwrap_or(0);
    }
    numbers
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bit_rates_are_those_that_the_divisor_gives() {
        let rates = [500_000, 250_000, 125_000, 100_000, 83_333, 50_000, 33_333, 20_000, 10_000];
        assert_eq!(rates.map(divisor), [1, 2, 4, 5, 6, 10, 15, 25, 50].map(Some));
        assert_eq!([1_000_000, 800_000, 400_000, 0].map(divisor), [None; 4]);
        assert_eq!(user_protocol(25), "ATPBE019");
    }

    #[test]
    fn versions_are_read_from_banners() {
        assert_eq!(version("ELM327 v1.4b"), [1, 4, 0]);
        assert_eq!(version("STN1110 v4.0.4"), [4, 0, 4]);
        assert_eq!(version("ELM327"), [0; 3]);
    }
}
