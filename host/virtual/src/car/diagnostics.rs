//! Answers of the engine's and the gearbox's ECUs to testers: OBD-II (SAE J1979) and some services of UDS (ISO 14229-1).

use super::values::VIN;
use super::vehicle::Vehicle;

/// The negative response of UDS and OBD.
const NEGATIVE: u8 = 0x7F;
const SERVICE_NOT_SUPPORTED: u8 = 0x11;
const SUB_FUNCTION_NOT_SUPPORTED: u8 = 0x12;
const WRONG_LENGTH: u8 = 0x13;
const OUT_OF_RANGE: u8 = 0x31;
/// In a sub-function: suppress the positive response.
const SUPPRESS: u8 = 0x80;
/// P0128, coolant does not reach its temperature: three bytes in UDS, the first two in OBD.
const TROUBLE: [u8; 3] = [0x01, 0x28, 0x00];
/// Test failed since it was cleared, confirmed, and failed in this cycle (ISO 14229-1:2020, annex D.2).
const TROUBLE_STATUS: u8 = 0x2A;
const SUPPORTED_STATUS: u8 = 0x7F;

/// The addressed ECU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Who {
    Engine,
    Transmission,
}

impl Who {
    const fn name(self) -> &'static [u8; 20] {
        match self {
            Self::Engine => b"ECM\0-EngineControl\0\0",
            Self::Transmission => b"TCM\0-TransmissionCtl",
        }
    }

    const fn part_number(self) -> &'static [u8] {
        match self {
            Self::Engine => b"CANTAP-ECM-01",
            Self::Transmission => b"CANTAP-TCM-01",
        }
    }

    const fn calibration(self) -> &'static [u8; 16] {
        match self {
            Self::Engine => b"CTECM2026A000001",
            Self::Transmission => b"CTTCM2026A000001",
        }
    }
}

/// One ECU's memory.
#[derive(Debug)]
pub struct Diagnostics {
    who: Who,
    /// Whether it has stored its trouble code.
    pub faulty: bool,
    session: u8,
}

impl Diagnostics {
    /// As initially: the engine's ECU has a trouble code.
    pub const fn new(who: Who) -> Self {
        Self { who, faulty: matches!(who, Who::Engine), session: 1 }
    }

    /// The answer to a request; `None` if there is none. To a request to all ECUs, none answers that it does not know it.
    pub fn answer(&mut self, request: &[u8], to_all: bool, car: &Vehicle) -> Option<Vec<u8>> {
        let (&service, rest) = request.split_first()?;
        let result = match service {
            0x01 => self.current(rest, car),
            0x03 => Ok(self.trouble_codes()),
            0x04 | 0x14 => self.clear(service, rest),
            0x07 | 0x0A => Ok(vec![service | 0x40, 0]),
            0x09 => self.information(rest),
            0x10 => self.control_session(rest),
            0x11 => {
                self.session = 1;
                reset(rest)
            }
            0x19 => self.read_trouble(rest),
            0x22 => self.read_data(rest, car),
            0x3E => tester_present(rest),
            _ => Err(SERVICE_NOT_SUPPORTED),
        };
        // OBD's own services stay silent about what is not supported.
        let silent = to_all || service < 0x10;
        match result {
            Ok(answer) if answer.is_empty() => None,
            Ok(answer) => Some(answer),
            Err(SERVICE_NOT_SUPPORTED | SUB_FUNCTION_NOT_SUPPORTED | OUT_OF_RANGE) if silent => None,
            Err(why) => Some(vec![NEGATIVE, service, why]),
        }
    }

    /// Service 01: up to six current values.
    fn current(&self, pids: &[u8], car: &Vehicle) -> Result<Vec<u8>, u8> {
        let mut answer = vec![0x41];
        for &pid in pids.iter().take(6) {
            let supported: &dyn Fn(u8) -> bool = &|pid| self.pid(pid, car).is_some();
            let value = if pid.is_multiple_of(0x20) {
                let bits = (1..=0x20).fold(0_u32, |bits, n| {
                    let next = pid.saturating_add(n);
                    let there = supported(next) || n == 0x20 && (next..=0x60).any(supported);
                    bits << 1 | u32::from(there)
                });
                // The first list is always present.
                (bits > 0 || pid == 0).then(|| bits.to_be_bytes().to_vec())
            } else {
                self.pid(pid, car)
            };
            if let Some(value) = value {
                answer.push(pid);
                answer.extend(value);
            }
        }
        if answer.len() > 1 { Ok(answer) } else { Err(OUT_OF_RANGE) }
    }

    /// A value of service 01, encoded as in SAE J1979-DA.
    fn pid(&self, pid: u8, car: &Vehicle) -> Option<Vec<u8>> {
        let percent = |value: f64| vec![(value.clamp(0.0, 100.0) * 2.55).round() as u8];
        let degrees = |value: f64| vec![(value.clamp(-40.0, 215.0) + 40.0).round() as u8];
        let word = |value: f64| (value.clamp(0.0, 65_535.0).round() as u16).to_be_bytes().to_vec();
        Some(match (self.who, pid) {
            (_, 0x01) => vec![u8::from(self.faulty) << 7 | u8::from(self.faulty), 0x07, 0x65, 0x00],
            (_, 0x0D) => vec![(car.speed * 3.6).clamp(0.0, 255.0).round() as u8],
            (_, 0x1C) => vec![6],
            (_, 0x42) => word(car.battery * 1000.0),
            (Who::Transmission, _) => return None,
            (_, 0x04) => percent(car.load()),
            (_, 0x05) => degrees(car.coolant),
            (_, 0x0B) => vec![car.manifold() as u8],
            (_, 0x0C) => word(car.rpm * 4.0),
            (_, 0x0E) => vec![((car.ignition() + 64.0) * 2.0) as u8],
            (_, 0x0F) => degrees(car.intake),
            (_, 0x10) => word(car.rpm * (0.15 + car.load() / 120.0) * 0.6),
            (_, 0x11) => percent(car.throttle),
            (_, 0x1F) => word(car.seconds()),
            (_, 0x21) => word(if self.faulty { 12.0 + car.trip / 1000.0 } else { 0.0 }),
            (_, 0x2F) => percent(car.fuel / 0.55),
            (_, 0x31) => word(412.0 + car.trip / 1000.0),
            (_, 0x33) => vec![101],
            (_, 0x46) => degrees(car.ambient()),
            (_, 0x49) => percent(car.pedal),
            (_, 0x51) => vec![1],
            (_, 0x5C) => degrees(car.oil),
            (_, 0x5E) => word(car.fuel_rate * 20.0),
            _ => return None,
        })
    }

    fn trouble_codes(&self) -> Vec<u8> {
        if self.faulty { vec![0x43, 1, TROUBLE[0], TROUBLE[1]] } else { vec![0x43, 0] }
    }

    fn clear(&mut self, service: u8, rest: &[u8]) -> Result<Vec<u8>, u8> {
        match (service, rest) {
            (0x04, []) | (0x14, [0xFF, 0xFF, 0xFF] | [0x01, 0x28, 0x00]) => {
                self.faulty = false;
                Ok(vec![service | 0x40])
            }
            (0x14, [_, _, _]) => Err(OUT_OF_RANGE),
            _ => Err(WRONG_LENGTH),
        }
    }

    /// Service 09: identification of the car and its ECUs.
    fn information(&self, rest: &[u8]) -> Result<Vec<u8>, u8> {
        let &[kind] = rest else { return Err(WRONG_LENGTH) };
        let text = |text: &[u8]| Ok([&[0x49, kind, 1], text].concat());
        match (self.who, kind) {
            (Who::Engine, 0x00) => Ok(vec![0x49, 0, 0x54, 0x40, 0, 0]),
            (Who::Transmission, 0x00) => Ok(vec![0x49, 0, 0x14, 0x40, 0, 0]),
            (Who::Engine, 0x02) => text(VIN),
            (_, 0x04) => text(self.who.calibration()),
            (_, 0x06) => text(&[0x1A, 0x2B, 0x3C, 0x4D]),
            (_, 0x0A) => text(self.who.name()),
            _ => Err(OUT_OF_RANGE),
        }
    }

    fn control_session(&mut self, rest: &[u8]) -> Result<Vec<u8>, u8> {
        let &[kind] = rest else { return Err(WRONG_LENGTH) };
        let session = kind & !SUPPRESS;
        if !matches!(session, 1 | 3) {
            return Err(SUB_FUNCTION_NOT_SUPPORTED);
        }
        self.session = session;
        // P2 is 50 ms, P2* 5 s.
        Ok(if kind & SUPPRESS == 0 { vec![0x50, session, 0x00, 0x32, 0x01, 0xF4] } else { Vec::new() })
    }

    /// Service 19: number and list of trouble codes.
    fn read_trouble(&self, rest: &[u8]) -> Result<Vec<u8>, u8> {
        let stored = |mask: u8| self.faulty && TROUBLE_STATUS & mask != 0;
        match *rest {
            [0x01, mask] => Ok(vec![0x59, 0x01, SUPPORTED_STATUS, 0x01, 0, u8::from(stored(mask))]),
            [0x02, mask] => {
                let mut answer = vec![0x59, 0x02, SUPPORTED_STATUS];
                if stored(mask) {
                    answer.extend(TROUBLE);
                    answer.push(TROUBLE_STATUS);
                }
                Ok(answer)
            }
            [0x0A] => {
                let status = if self.faulty { TROUBLE_STATUS } else { 0 };
                Ok([&[0x59, 0x0A, SUPPORTED_STATUS][..], &TROUBLE, &[status]].concat())
            }
            [0x01 | 0x02 | 0x0A, ..] | [] => Err(WRONG_LENGTH),
            _ => Err(SUB_FUNCTION_NOT_SUPPORTED),
        }
    }

    /// Service 22: values by identifier, several at a time.
    fn read_data(&self, rest: &[u8], car: &Vehicle) -> Result<Vec<u8>, u8> {
        let (pairs, []) = rest.as_chunks::<2>() else { return Err(WRONG_LENGTH) };
        if pairs.is_empty() {
            return Err(WRONG_LENGTH);
        }
        let mut answer = vec![0x62];
        for pair in pairs {
            let value = match (self.who, u16::from_be_bytes(*pair)) {
                (_, 0xF190) => VIN.to_vec(),
                (_, 0xF187) => self.who.part_number().to_vec(),
                (_, 0xF18C) => b"0000000042".to_vec(),
                (_, 0xF195) => b"1.0.0".to_vec(),
                (_, 0xF186) => vec![self.session],
                (Who::Engine, 0x0100) => ((car.rpm * 4.0) as u16).to_be_bytes().to_vec(),
                (Who::Engine, 0x0101) => vec![(car.coolant + 40.0) as u8],
                (Who::Transmission, 0x0200) => vec![car.gear],
                _ => continue,
            };
            answer.extend(pair);
            answer.extend(value);
        }
        // Unknown ones are left out, unless all of them are.
        if answer.len() > 1 { Ok(answer) } else { Err(OUT_OF_RANGE) }
    }
}

fn reset(rest: &[u8]) -> Result<Vec<u8>, u8> {
    match *rest {
        [kind] if matches!(kind & !SUPPRESS, 1..=3) => {
            Ok(if kind & SUPPRESS == 0 { vec![0x51, kind] } else { Vec::new() })
        }
        [_] => Err(SUB_FUNCTION_NOT_SUPPORTED),
        _ => Err(WRONG_LENGTH),
    }
}

fn tester_present(rest: &[u8]) -> Result<Vec<u8>, u8> {
    match *rest {
        [0] => Ok(vec![0x7E, 0]),
        [SUPPRESS] => Ok(Vec::new()),
        [_] => Err(SUB_FUNCTION_NOT_SUPPORTED),
        _ => Err(WRONG_LENGTH),
    }
}
