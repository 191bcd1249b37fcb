//! What a drive is to do, how long that may take, and what is known of it.

use crate::canopen::drive::DriveState;

/// What a drive is to do next. Each ends when its statusword confirms it, or with the reason why not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DriveStep {
    /// Nothing: its state and its values are read.
    Inspect,
    /// To operation enabled, state by state.
    Enable,
    /// To switch on disabled, state by state. It brakes as it is set up to (object 605C).
    Disable,
    /// Out of a fault, by the rising edge of the bit for that.
    ResetFault,
    /// A quick stop. It brakes as it is set up to (605A), and stays as that leaves it.
    QuickStop,
    /// A quick stop, and no voltage as soon as it stands: for the end of a motion, whatever the state was. If it does not brake within its
    /// time, it loses the voltage all the same.
    Stop,
    /// This mode of operation (6060), confirmed by its display (6061).
    SetMode(i8),
    /// Writes an object, with sub-index 0.
    Write {
        /// The object.
        index: u16,
        /// Its new value.
        data: Vec<u8>,
    },
    /// Takes the target position over, by handshake: the bit for a new set-point until the drive has acknowledged it, and no longer.
    SetPoint {
        /// From where it is, or is going to.
        relative: bool,
    },
    /// Starts homing.
    Home,
    /// Goes on until the target is reached.
    Reach {
        /// The target is a home position.
        is_homing: bool,
        /// The longest it may take, in nanoseconds.
        within_ns: u64,
    },
    /// Goes on as it does for this long, in nanoseconds; without a time, until it is ended from outside.
    Hold(Option<u64>),
}

impl DriveStep {
    /// Whether the drive should keep on working meanwhile: an emergency, a silent heartbeat and the like end it.
    pub(super) const fn is_work(&self) -> bool {
        !matches!(self, Self::Inspect | Self::Disable | Self::ResetFault | Self::QuickStop | Self::Stop)
    }
}

/// How long things may take, in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DriveTiming {
    /// Each answer of the node.
    pub answer_ns: u64,
    /// A change of state, a new mode, the acknowledgement of a set-point.
    pub confirm_ns: u64,
    /// Braking.
    pub stop_ns: u64,
    /// Between two questions for the statusword.
    pub poll_ns: u64,
}

impl Default for DriveTiming {
    /// 1 s, 2 s, 10 s, 20 ms.
    fn default() -> Self {
        Self {
            answer_ns: 1_000_000_000,
            confirm_ns: 2_000_000_000,
            stop_ns: 10_000_000_000,
            poll_ns: 20_000_000,
        }
    }
}

/// What was last read of a drive; `None` where it was not, or where it does not have the object. Positions, velocities and torques are in the
/// drive's own units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DriveValues {
    /// Object 6041.
    pub statusword: Option<u16>,
    /// Object 6061.
    pub mode: Option<i8>,
    /// Object 603F.
    pub error_code: Option<u16>,
    /// Object 6064.
    pub position: Option<i32>,
    /// Object 606C.
    pub velocity: Option<i32>,
    /// Object 6077, in thousandths of the rated torque.
    pub torque: Option<i16>,
    /// Object 606F: what is slower stands.
    pub velocity_threshold: Option<u16>,
    /// Object 1017, in milliseconds.
    pub heartbeat_ms: Option<u16>,
}

impl DriveValues {
    /// The last confirmed state.
    pub const fn state(&self) -> Option<DriveState> {
        match self.statusword {
            Some(word) => DriveState::of(word),
            None => None,
        }
    }

    /// Whether a bit of the statusword is set.
    pub(super) fn has(&self, bit: u8) -> bool {
        self.statusword.is_some_and(|word| word >> bit & 1 == 1)
    }

    /// Whether it stands: by its velocity, or else by the bit that says so.
    pub(super) fn stands(&self) -> bool {
        let threshold = u32::from(self.velocity_threshold.unwrap_or(0));
        self.velocity.map_or_else(|| self.has(10), |velocity| velocity.unsigned_abs() <= threshold)
    }
}
