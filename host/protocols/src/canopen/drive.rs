//! Drives (CiA 402): what controlword, statusword, mode and error code stand for.
//!
//! Only objects of the first axis are known by name; those of the others lie 800h apart.

use super::eds::Eds;
use super::names;
use super::types::number_of;
use crate::{Event, Field, Value};

/// Device types with this number in their low half are drives (object 1000).
const PROFILE: u32 = 402;

/// Where the objects of drives begin, and how far those of each axis are above those of the one before (CiA 402-2).
const FIRST_OF_PROFILE: u16 = 0x6000;
const AXIS_STEP: u16 = 0x800;
/// A node has no more.
const MOST_AXES: u8 = 8;

/// An object of the first axis as another of the node's, 1 to 8, has it. Those that are not a drive's are the node's, and the same for all.
pub fn object_of_axis(index: u16, axis: u8) -> u16 {
    let offset = u16::from(axis.clamp(1, MOST_AXES) - 1) * AXIS_STEP;
    if index >= FIRST_OF_PROFILE { index.saturating_add(offset) } else { index }
}

/// The error code of the last fault.
pub const ERROR_CODE: u16 = 0x603F;
/// What the drive is to do.
pub const CONTROLWORD: u16 = 0x6040;
/// What it does.
pub const STATUSWORD: u16 = 0x6041;
/// The mode that is asked for.
pub const MODE: u16 = 0x6060;
/// The mode that it is in.
pub const MODE_DISPLAY: u16 = 0x6061;

/// A state of a drive's state machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum DriveState {
    /// It is starting.
    NotReadyToSwitchOn,
    /// No power; it may be set up.
    SwitchOnDisabled,
    /// No power; it may be switched on.
    ReadyToSwitchOn,
    /// Power, but no motion.
    SwitchedOn,
    /// It follows its set-points.
    OperationEnabled,
    /// It brakes, or has braked and holds.
    QuickStopActive,
    /// It does what it does about a fault.
    FaultReactionActive,
    /// A fault has switched it off.
    Fault,
}

impl DriveState {
    /// According to a statusword; `None` if its bits are those of no state.
    pub const fn of(statusword: u16) -> Option<Self> {
        Some(match (statusword & 0x6F, statusword & 0x4F) {
            (0x21, _) => Self::ReadyToSwitchOn,
            (0x23, _) => Self::SwitchedOn,
            (0x27, _) => Self::OperationEnabled,
            (0x07, _) => Self::QuickStopActive,
            (_, 0x00) => Self::NotReadyToSwitchOn,
            (_, 0x40) => Self::SwitchOnDisabled,
            (_, 0x0F) => Self::FaultReactionActive,
            (_, 0x08) => Self::Fault,
            _ => return None,
        })
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        names::drive_state(self as u8)
    }

    /// The state that an event says: that of a statusword that was sent or read, whatever a sheet calls it.
    pub fn in_event(event: &Event) -> Option<Self> {
        event.fields.iter().find_map(|field| match field.value {
            Value::Hex(word, 4) => {
                let state = Self::of(u16::try_from(word).ok()?)?;
                (field.text.as_deref() == Some(state.name())).then_some(state)
            }
            _ => None,
        })
    }

    /// Whether the motor may have power.
    pub const fn is_powered(self) -> bool {
        matches!(
            self,
            Self::SwitchedOn | Self::OperationEnabled | Self::QuickStopActive | Self::FaultReactionActive
        )
    }
}

/// What a controlword commands.
pub const fn command(controlword: u16) -> &'static str {
    match controlword {
        word if word & 0x80 != 0 => "fault reset",
        word if word & 0x02 == 0 => "disable voltage",
        word if word & 0x04 == 0 => "quick stop",
        word if word & 0x01 == 0 => "shutdown",
        word if word & 0x08 == 0 => "switch on",
        _ => "enable operation",
    }
}

/// The name of a mode of operation; `None` for a manufacturer's and for reserved ones.
pub fn mode_name(mode: i8) -> Option<&'static str> {
    u8::try_from(mode).ok().and_then(names::drive_mode)
}

/// The number of a mode of operation by its name or its usual short form, as `profile velocity` or `pv`.
pub fn mode_named(name: &str) -> Option<i8> {
    const SHORT: [(&str, i8); 9] = [
        ("pp", 1),
        ("vl", 2),
        ("pv", 3),
        ("tq", 4),
        ("hm", 6),
        ("ip", 7),
        ("csp", 8),
        ("csv", 9),
        ("cst", 10),
    ];
    let name = name.replace('-', " ").to_ascii_lowercase();
    SHORT
        .into_iter()
        .find(|(short, mode)| *short == name || mode_name(*mode) == Some(&name))
        .map(|(_, mode)| mode)
}

/// What an error code stands for, as specifically as it is known.
pub fn error(code: u16) -> &'static str {
    names::drive_emergency(code).unwrap_or_else(|| names::emergency(code))
}

/// The bits of a statusword that are no state, with commas. Two of them depend on the mode of operation.
pub fn status_flags(statusword: u16, mode: Option<i8>) -> String {
    let by_mode = |bit: u8| match (bit, mode) {
        (12, Some(1)) => "set-point acknowledged",
        (12, Some(3)) => "speed is zero",
        (12, Some(6)) => "homing attained",
        (12, Some(7)) => "interpolation active",
        (12, Some(8..=10)) => "follows the command value",
        (13, Some(1 | 8)) => "following error",
        (13, Some(3)) => "too much slippage",
        (13, Some(6)) => "homing error",
        (12, _) => "bit 12",
        _ => "bit 13",
    };
    let set = (0..16_u8).filter(|bit| statusword >> bit & 1 == 1);
    let named = set.filter_map(|bit| match bit {
        12 | 13 => Some(by_mode(bit)),
        _ => names::status_bit(bit),
    });
    named.collect::<Vec<_>>().join(", ")
}

/// The bits of a controlword that are not part of the command, with commas.
fn control_flags(controlword: u16, mode: Option<i8>) -> String {
    let named = (4..16_u8).filter(|bit| controlword >> bit & 1 == 1 && *bit != 7).map(|bit| {
        match (bit, mode) {
            (4, Some(1)) => "new set-point",
            (5, Some(1)) => "change at once",
            (6, Some(1)) => "relative",
            (9, Some(1)) => "change on set-point",
            (4, Some(6)) => "start homing",
            (4, Some(7)) => "interpolate",
            (4, Some(2)) => "enable ramp",
            (5, Some(2)) => "unlock ramp",
            (6, Some(2)) => "use reference",
            (8, _) => "halt",
            _ => return format!("bit {bit}"),
        }
        .to_owned()
    });
    named.collect::<Vec<_>>().join(", ")
}

/// The type of an object (CiA 301, table 44).
pub const fn data_type(index: u16) -> Option<u16> {
    Some(match index {
        MODE | MODE_DISPLAY | 0x6098 => 0x02,
        ERROR_CODE | CONTROLWORD | STATUSWORD | 0x6066 | 0x6068 | 0x606D..=0x6070 | 0x6072 => 0x06,
        0x605A..=0x605E | 0x6071 | 0x6074 | 0x6077 | 0x6078 => 0x03,
        0x6062..=0x6064 | 0x606B | 0x606C | 0x607A | 0x607C | 0x60FF => 0x04,
        0x6065 | 0x6067 | 0x6075 | 0x6076 | 0x607F | 0x6081..=0x6085 | 0x6087 | 0x609A | 0x6502 => 0x07,
        _ => return None,
    })
}

/// What is known of a node as a drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DriveView {
    /// Whether it is one, as its device type or its objects show.
    is_drive: Option<bool>,
    mode: Option<i8>,
}

impl DriveView {
    /// By the device type in a node's sheet, if nothing was heard.
    #[must_use]
    pub fn or_sheet(self, sheet: Option<&Eds>, node: u8) -> Self {
        let device_type = || sheet?.value_of(0x1000, 0, node);
        let is_drive = self.is_drive.or_else(|| device_type().map(|number| number & 0xFFFF == PROFILE));
        Self { is_drive, ..self }
    }

    /// Whether it is one.
    pub const fn is_drive(self) -> bool {
        matches!(self.is_drive, Some(true))
    }

    /// Learns from an object's value: its device type says what a node is, and if that is unknown, that it has a controlword or a
    /// statusword of 16 bits. `bits` is the value's length.
    pub fn learn(&mut self, index: u16, sub: u8, bits: usize, bytes: &[u8]) {
        match (index, sub, bits) {
            (0x1000, 0, 32) => self.is_drive = Some(number_of(bytes) & 0xFFFF == PROFILE),
            (CONTROLWORD | STATUSWORD, 0, 16) => self.is_drive = self.is_drive.or(Some(true)),
            // What is asked for is only in force when it is displayed, but a drive may have no display mapped.
            (MODE | MODE_DISPLAY, 0, 8) => self.mode = bytes.first().map(|mode| *mode as i8),
            _ => {}
        }
    }

    /// Says what an object's value means, with a second field for the bits of a word.
    pub fn explain(self, index: u16, sub: u8, bytes: &[u8], mut field: Field, fields: &mut Vec<Field>) {
        if !self.is_drive() || sub != 0 {
            fields.push(field);
            return;
        }
        let number = number_of(bytes);
        let (word, flags) =
            (number as u16, |name, flags: String| (!flags.is_empty()).then(|| Field::text(name, flags)));
        let mut more = None;
        match (index, bytes.len()) {
            (CONTROLWORD, 2) => {
                field.value = Value::Hex(word.into(), 4);
                field.text = Some(command(word).into());
                more = flags("control_flags", control_flags(word, self.mode));
            }
            (STATUSWORD, 2) => {
                field.value = Value::Hex(word.into(), 4);
                field.text = DriveState::of(word).map(|state| state.name().into());
                more = flags("status_flags", status_flags(word, self.mode));
            }
            (MODE | MODE_DISPLAY, 1) => {
                field.value = Value::Number((number as i8).into());
                field.text = mode_name(number as i8).map(Into::into);
            }
            (ERROR_CODE, 2) => {
                field.value = Value::Hex(word.into(), 4);
                field.text = Some(error(word).into());
            }
            _ => {}
        }
        fields.push(field);
        fields.extend(more);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CiA 402's table of states: each with all bits that it leaves open.
    #[test]
    fn a_statusword_is_one_state_whatever_its_other_bits_are() {
        for (state, mask, bits) in [
            (DriveState::NotReadyToSwitchOn, 0x4F, 0x00),
            (DriveState::SwitchOnDisabled, 0x4F, 0x40),
            (DriveState::ReadyToSwitchOn, 0x6F, 0x21),
            (DriveState::SwitchedOn, 0x6F, 0x23),
            (DriveState::OperationEnabled, 0x6F, 0x27),
            (DriveState::QuickStopActive, 0x6F, 0x07),
            (DriveState::FaultReactionActive, 0x4F, 0x0F),
            (DriveState::Fault, 0x4F, 0x08),
        ] {
            let words = (0..=u16::MAX).filter(|word| word & mask == bits);
            assert!(words.clone().count() >= 0x200);
            for word in words {
                assert_eq!(DriveState::of(word), Some(state), "{word:04X}");
            }
        }
        assert_eq!((DriveState::of(0x01), DriveState::of(0x60 | 0x0C)), (None, None));
        assert_eq!(DriveState::Fault.name(), "fault");
    }

    #[test]
    fn words_modes_and_codes_have_names() {
        let commands = [0x06, 0x07, 0x0F, 0x1F, 0x02, 0x0B, 0x00, 0x80, 0x0D].map(command);
        assert_eq!(
            commands,
            [
                "shutdown",
                "switch on",
                "enable operation",
                "enable operation",
                "quick stop",
                "quick stop",
                "disable voltage",
                "fault reset",
                "disable voltage",
            ]
        );
        assert_eq!(
            status_flags(0x1637, Some(1)),
            "voltage enabled, remote, target reached, set-point acknowledged"
        );
        assert_eq!(status_flags(0x2000, Some(6)), "homing error");
        assert_eq!(status_flags(0xF180, None), "warning, bit 8, bit 12, bit 13, bit 14, bit 15");
        assert_eq!(control_flags(0x015F, Some(1)), "new set-point, relative, halt");
        assert_eq!(control_flags(0x801F, None), "bit 4, bit 15");
        assert_eq!((mode_name(3), mode_name(-1), mode_name(5)), (Some("profile velocity"), None, None));
        for (name, mode) in
            [("pv", Some(3)), ("profile-velocity", Some(3)), ("csp", Some(8)), ("", None), ("x", None)]
        {
            assert_eq!(mode_named(name), mode, "{name}");
        }
        assert_eq!(
            (error(0x8611), error(0x2345), error(0)),
            ("following error", "current, device output side", "no error, or reset")
        );
    }
}
