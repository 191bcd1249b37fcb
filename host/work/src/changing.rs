//! Frames whose values change with time: `EngineData:Speed=sine(0,120,10s),Gear=Drive`.

use std::fs;
use std::path::Path;

use cantap::Frame;
use cantap::periodic::check_modifiers;
use cantap::wire::message::{MAX_MODIFIERS, Modifier};
use cantap_firmware::bus::periodic::apply;
use cantap_signals::Decoder;
use cantap_signals::encode::{EncodeError, encode};
use cantap_trace::{clean, grammar};

/// Moments at which a frame is tried before anything is sent: a value that its signal cannot take is found then.
const TRIED: u32 = 64;
/// Values of a list, at most.
const MOST_VALUES: usize = 1_000_000;

/// Bytes of a file with a list, at most.
const MOST_BYTES: u64 = 32 << 20;

/// Why values cannot change as they should.
#[derive(Debug, thiserror::Error)]
pub enum ChangingError {
    /// No such way of changing, or something is wrong with it.
    #[error(
        "'{0}' is none of sine(LOW,HIGH,PERIOD), triangle(LOW,HIGH,PERIOD), ramp(FROM,TO,PERIOD), square(LOW,HIGH,PERIOD), random(LOW,HIGH), \
         values(1,2,3) and file(PATH), where a period is as 2s or 500ms"
    )]
    Form(String),
    /// A file of values cannot be read.
    #[error("the values in {path} cannot be read: {reason}")]
    File {
        /// As given.
        path: String,
        /// What is wrong.
        reason: String,
    },
    /// A value that comes up does not fit its signal, or the message or signal is unknown.
    #[error(transparent)]
    Value(#[from] EncodeError),
    /// A counter, random byte or checksum is not in the frame's data.
    #[error("{0}")]
    Modifier(String),
}

/// How a value changes.
#[derive(Clone, Debug, PartialEq)]
enum Wave {
    Sine {
        low: f64,
        high: f64,
        period_s: f64,
    },
    Triangle {
        low: f64,
        high: f64,
        period_s: f64,
    },
    Ramp {
        from: f64,
        to: f64,
        period_s: f64,
    },
    Square {
        low: f64,
        high: f64,
        period_s: f64,
    },
    Random {
        low: f64,
        high: f64,
    },
    /// The next one in each round, and then from the beginning again.
    Values(Vec<f64>),
}

/// A piece of the message's text.
#[derive(Clone, Debug, PartialEq)]
enum Piece {
    Text(String),
    Wave(Wave),
}

/// A message with at least one value that changes.
#[derive(Clone, Debug, PartialEq)]
pub struct Changing {
    pieces: Vec<Piece>,
    modifiers: heapless::Vec<Modifier, MAX_MODIFIERS>,
}

impl Changing {
    /// Takes `Message:Signal=value,…`; `None` if no value in it changes. Files are read now.
    pub fn parse(text: &str) -> Result<Option<Self>, ChangingError> {
        let mut pieces = Vec::new();
        let mut rest = text;
        while let Some((before, name, inside, after)) = next_call(rest) {
            let wave = Wave::new(name, inside)?;
            pieces.extend([Piece::Text(before.to_owned()), Piece::Wave(wave)]);
            rest = after;
        }
        if pieces.is_empty() {
            return Ok(None);
        }
        pieces.push(Piece::Text(rest.to_owned()));
        Ok(Some(Self { pieces, modifiers: heapless::Vec::new() }))
    }

    /// With what also changes in each frame, applied in this order as a device does it in its periodic frames.
    #[must_use]
    pub fn with_modifiers(self, modifiers: heapless::Vec<Modifier, MAX_MODIFIERS>) -> Self {
        Self { modifiers, ..self }
    }

    /// The frame of a round (from 0) that is due so many seconds after the first.
    pub fn frame(
        &self,
        decoder: &Decoder,
        channel: Option<u8>,
        since_s: f64,
        round: u32,
    ) -> Result<Frame, ChangingError> {
        let mut text = String::new();
        for (place, piece) in (0..).zip(&self.pieces) {
            match piece {
                Piece::Text(piece) => text.push_str(piece),
                Piece::Wave(wave) => text.push_str(&wave.value(since_s, round, place).to_string()),
            }
        }
        let frame = encode(decoder, channel, &text)?.frame;
        check_modifiers(&frame, &self.modifiers)
            .map_err(|error| ChangingError::Modifier(error.to_string()))?;
        Ok(modified(&frame, &self.modifiers, round))
    }

    /// Tries every value of its lists, and moments of the longest period.
    pub fn check(&self, decoder: &Decoder, channel: Option<u8>) -> Result<Frame, ChangingError> {
        let waves = self.pieces.iter().filter_map(|piece| match piece {
            Piece::Wave(wave) => Some(wave),
            Piece::Text(_) => None,
        });
        let (mut period_s, mut rounds) = (0.0_f64, TRIED);
        for wave in waves {
            period_s = period_s.max(wave.period_s());
            if let Wave::Values(values) = wave {
                rounds = rounds.max(values.len() as u32);
            }
        }
        for round in 0..rounds {
            self.frame(decoder, channel, period_s * f64::from(round) / f64::from(TRIED), round)?;
        }
        self.frame(decoder, channel, 0.0, 0)
    }
}

/// A frame as it is in a round, from 0, with what a device would change in it.
pub fn modified(frame: &Frame, modifiers: &[Modifier], round: u32) -> Frame {
    apply(modifiers, frame, round, mixed(round, u32::MAX))
}

/// The first `=NAME(…)` outside of quotes: what is before the name, the name, what is in the brackets, what is after them.
fn next_call(text: &str) -> Option<(&str, &str, &str, &str)> {
    let mut is_quoted = false;
    for (at, character) in text.char_indices() {
        is_quoted ^= character == '"';
        if character != '=' || is_quoted {
            continue;
        }
        let value = &text[at + 1..];
        let name_end = value.find(|character: char| !character.is_ascii_lowercase()).unwrap_or(value.len());
        if name_end == 0 || !value[name_end..].starts_with('(') {
            continue;
        }
        let inside = &value[name_end + 1..];
        let close = inside.find(')')?;
        return Some((&text[..=at], &value[..name_end], &inside[..close], &inside[close + 1..]));
    }
    None
}

impl Wave {
    fn new(name: &str, inside: &str) -> Result<Self, ChangingError> {
        let wrong = || ChangingError::Form(format!("{name}({inside})"));
        let number = |text: &str| text.trim().parse().ok().filter(|value: &f64| value.is_finite());
        let parts: Vec<&str> = inside.split(',').collect();
        let range = || Some((number(parts.first()?)?, number(parts.get(1)?)?));
        let waved = || {
            let period_s = grammar::duration(parts.get(2)?.trim()).ok()?.as_secs_f64();
            let (first, second) = range().filter(|_| parts.len() == 3 && period_s > 0.0)?;
            Some((first, second, period_s))
        };
        let wave = match name {
            "sine" => waved().map(|(low, high, period_s)| Self::Sine { low, high, period_s }),
            "triangle" => waved().map(|(low, high, period_s)| Self::Triangle { low, high, period_s }),
            "ramp" => waved().map(|(from, to, period_s)| Self::Ramp { from, to, period_s }),
            "square" => waved().map(|(low, high, period_s)| Self::Square { low, high, period_s }),
            "random" => range().filter(|_| parts.len() == 2).map(|(low, high)| Self::Random { low, high }),
            "values" => parts.iter().map(|part| number(part)).collect::<Option<_>>().map(Self::Values),
            "file" => return of_file(inside.trim()).map(Self::Values),
            _ => None,
        };
        wave.ok_or_else(wrong)
    }

    const fn period_s(&self) -> f64 {
        match self {
            Self::Sine { period_s, .. }
            | Self::Triangle { period_s, .. }
            | Self::Ramp { period_s, .. }
            | Self::Square { period_s, .. } => *period_s,
            Self::Random { .. } | Self::Values(_) => 0.0,
        }
    }

    fn value(&self, since_s: f64, round: u32, place: u32) -> f64 {
        let turn = |period_s: f64| (since_s / period_s).rem_euclid(1.0);
        let between = |low: f64, high: f64, share: f64| low * (1.0 - share) + high * share;
        match self {
            Self::Sine { low, high, period_s } => {
                let share = 0.5 + 0.5 * (turn(*period_s) * std::f64::consts::TAU).sin();
                between(*low, *high, share)
            }
            Self::Triangle { low, high, period_s } => {
                between(*low, *high, 1.0 - (2.0 * turn(*period_s) - 1.0).abs())
            }
            Self::Ramp { from, to, period_s } => between(*from, *to, turn(*period_s)),
            Self::Square { low, high, period_s } => {
                if turn(*period_s) < 0.5 {
                    *low
                } else {
                    *high
                }
            }
            Self::Random { low, high } => {
                between(*low, *high, f64::from(mixed(round, place)) / f64::from(u32::MAX))
            }
            Self::Values(values) => values[round as usize % values.len()],
        }
    }
}

/// One value for each line of a text; what follows a comma, semicolon or blank in it does not count.
fn of_file(path: &str) -> Result<Vec<f64>, ChangingError> {
    let wrong = |reason: String| ChangingError::File { path: path.to_owned(), reason };
    let about = fs::metadata(Path::new(path)).map_err(|error| wrong(error.to_string()))?;
    if !about.is_file() || about.len() > MOST_BYTES {
        return Err(wrong(format!("it is no file of at most {MOST_BYTES} bytes")));
    }
    let text = fs::read_to_string(Path::new(path)).map_err(|error| wrong(error.to_string()))?;
    let mut values = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let first = line.split([',', ';', ' ', '\t']).next().unwrap_or_default();
        if first.is_empty() && line.trim().is_empty() {
            continue;
        }
        let value = first.parse().ok().filter(|value: &f64| value.is_finite());
        match value {
            Some(value) => values.push(value),
            // A heading.
            None if number == 1 => {}
            None => {
                return Err(wrong(format!(
                    "line {number} begins with no number: {}",
                    clean::line(&line.chars().take(40).collect::<String>())
                )));
            }
        }
        if values.len() > MOST_VALUES {
            return Err(wrong(format!("they are more than {MOST_VALUES}")));
        }
    }
    if values.is_empty() { Err(wrong("there is none in it".to_owned())) } else { Ok(values) }
}

/// A number that looks random: the same for the same round, so that a run can be repeated.
const fn mixed(round: u32, place: u32) -> u32 {
    let mut bits = (round as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (place as u64) << 32;
    bits = (bits ^ bits >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ bits >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
    (bits ^ bits >> 31) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_signals::Source;

    fn decoder() -> Decoder {
        let text = "BO_ 291 M: 8 N\n SG_ Speed : 0|16@1+ (0.1,0) [0|200] \"\" N\n SG_ Gear : 16|8@1+ (1,0) [0|5] \"\" N\n\
                    VAL_ 291 Gear 0 \"Park, really\" 1 \"Drive\" ;\n";
        let database = cantap_signals::dbc::parse("m.dbc", text.as_bytes()).unwrap();
        Decoder::new(vec![Source { channel: None, database }])
    }

    fn bytes(changing: &Changing, since_s: f64, round: u32) -> (u16, u8) {
        let frame = changing.frame(&decoder(), None, since_s, round).unwrap();
        let data = frame.padded_data();
        (u16::from_le_bytes([data[0], data[1]]), data[2])
    }

    #[test]
    fn values_change_as_their_names_say() {
        let at = |text: &str, since_s, round| {
            let changing = Changing::parse(&format!("M:Speed={text},Gear=1")).unwrap().unwrap();
            changing.check(&decoder(), None).unwrap();
            let (speed, gear) = bytes(&changing, since_s, round);
            assert_eq!(gear, 1);
            speed
        };
        let over = |text: &str, times: [f64; 4]| times.map(|since_s| at(text, since_s, 0));
        assert_eq!(over("sine(0,100,4s)", [0.0, 1.0, 2.0, 3.0]), [500, 1000, 500, 0]);
        assert_eq!(over("triangle(0,100,4s)", [0.0, 1.0, 2.0, 7.0]), [0, 500, 1000, 500]);
        assert_eq!(over("ramp(100,0,4s)", [0.0, 1.0, 3.0, 4.0]), [1000, 750, 250, 1000]);
        assert_eq!(over("square(0,100,4s)", [0.0, 1.9, 2.0, 4.0]), [0, 0, 1000, 0]);
        assert_eq!([0, 1, 2, 3].map(|round| at("values(1, 2.5,3)", 0.0, round)), [10, 25, 30, 10]);
        let random: Vec<_> = (0..200).map(|round| at("random(20,30)", 0.0, round)).collect();
        assert!(random.iter().all(|value| (200..=300).contains(value)));
        assert!(random.iter().any(|value| *value < 220) && random.iter().any(|value| *value > 280));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("values.csv");
        fs::write(&path, "speed,comment\n7.5,a\n\n8\n").unwrap();
        assert_eq!(at(&format!("file({})", path.display()), 0.0, 1), 80);
    }

    #[test]
    fn counter_and_checksum_are_those_of_a_device() {
        let modifiers = [
            Modifier::Counter { byte: 3, low_bit: 0, bits: 4 },
            Modifier::Checksum { byte: 7, algorithm: cantap::wire::message::Checksum::Xor },
        ];
        let modifiers = heapless::Vec::from_slice(&modifiers).unwrap();
        let changing = Changing::parse("M:Speed=values(1,2)").unwrap().unwrap().with_modifiers(modifiers);
        let data = |round| changing.frame(&decoder(), None, 0.0, round).unwrap().padded_data();
        assert_eq!(data(17), [20, 0, 0, 1, 0, 0, 0, 21]);
    }

    #[test]
    fn what_does_not_change_is_left_to_others_and_what_cannot_is_refused() {
        for plain in ["M:Speed=12,Gear=Drive", "M:Gear=\"Park, really\"", "M:Gear=\"=sine(1,2,3)\"", "M"] {
            assert_eq!(Changing::parse(plain).unwrap(), None, "{plain}");
        }
        for wrong in [
            "sine(0,100)",
            "sine(0,100,0s)",
            "sine(0,x,1s)",
            "wave(1,2,3s)",
            "values()",
            "random(1)",
            "ramp(1,2,3,4s)",
        ] {
            let error = Changing::parse(&format!("M:Speed={wrong}")).unwrap_err().to_string();
            assert!(error.contains("sine(LOW,HIGH,PERIOD)"), "{wrong}: {error}");
        }
        let error = Changing::parse("M:Speed=file(/nowhere)").unwrap_err().to_string();
        assert!(error.contains("/nowhere"), "{error}");
        let refused = |text: &str| {
            let changing = Changing::parse(text).unwrap().unwrap();
            changing.check(&decoder(), None).unwrap_err().to_string()
        };
        assert!(refused("M:Speed=sine(0,300,1s)").contains("Speed"));
        assert!(refused("M:Speed=values(1,2,999)").contains("Speed"));
        assert!(refused("M:Gear=sine(0,1,1s)").contains("Gear"));
        assert!(refused("Other:Speed=sine(0,1,1s)").contains("Other"));
    }
}
