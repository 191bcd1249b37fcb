//! Commanding drives (CiA 402).

use std::io::Write as _;
use std::time::Duration;

use anyhow::anyhow;
use cantap_protocols::active::drive::{DriveStep, DriveTiming};
use cantap_protocols::canopen::drive::{DriveState, data_type, mode_name, mode_named, object_of_axis};
use cantap_protocols::canopen::eds::number;
use cantap_protocols::canopen::{CanOpen, Sheet, encode};
use cantap_trace::Seconds;
use cantap_work::drive::{
    Drive, DriveStatus, Guard, Motion, MotionOptions, TARGET_POSITION, TARGET_TORQUE, TARGET_VELOCITY,
};
use serde_json::json;

use crate::args;
use crate::speak_args::SpeakArgs;
use crate::stderr;
use crate::usage_error::usage;

const PROFILE_VELOCITY: u16 = 0x6081;
const PROFILE_ACCELERATION: u16 = 0x6083;
const PROFILE_DECELERATION: u16 = 0x6084;
const TORQUE_SLOPE: u16 = 0x6087;
const HOMING_METHOD: u16 = 0x6098;
/// What is asked before anything that can move.
const DANGER: &str = "this can move the machine: make sure that nobody and nothing is in its way, and that it can be stopped without this \
                      computer; if that is so, add --yes";

/// The command line.
#[derive(clap::Args)]
pub(super) struct DriveArgs {
    /// The drive's node number, 1 to 127.
    #[arg(value_parser = super::node)]
    node: u8,
    /// Which axis of the node, 1 to 8: the objects of each are 800h above those of the one before.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=8), global = true)]
    axis: u8,
    /// How long a state, a mode or a set-point may take to be confirmed.
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = args::positive_duration, global = true)]
    confirm: Duration,
    /// How long braking may take. After it, the drive loses its voltage all the same.
    #[arg(long, value_name = "TIME", default_value = "10s", value_parser = args::positive_duration, global = true)]
    braking: Duration,
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// Show its state, mode, error, position, velocity and torque.
    Status,
    /// The same whenever something changes, until Ctrl-C.
    Watch {
        /// The time between two looks.
        #[arg(long, value_name = "TIME", default_value = "100ms", value_parser = args::positive_duration)]
        period: Duration,
        /// End after this time.
        #[arg(short, long, value_name = "TIME", value_parser = args::positive_duration)]
        time: Option<Duration>,
    },
    /// Enable operation, state by state, and leave it so: from then on it follows its set-points. Requires --yes.
    Enable(Yes),
    /// Take its power, state by state; it brakes as it is set up to (object 605C).
    Disable,
    /// Quick stop, as it is set up (object 605A); it stays as that leaves it.
    QuickStop,
    /// Reset a fault whose cause is gone.
    FaultReset,
    /// Choose a mode of operation. While operation is enabled, this requires --yes.
    Mode {
        /// pp, pv, tq, hm, vl, ip, csp, csv, cst, the name in words, as profile-velocity, or a number, as -1.
        #[arg(allow_hyphen_values = true, value_parser = mode)]
        mode: i8,
        #[command(flatten)]
        yes: Yes,
    },
    /// Turn at a velocity, until Ctrl-C or for --time. Requires --yes.
    Velocity {
        /// The velocity (60FF), in the drive's units.
        #[arg(allow_hyphen_values = true)]
        target: String,
        #[command(flatten)]
        profile: Profile,
        #[command(flatten)]
        motion: MotionArgs,
    },
    /// Go to a position. Requires --yes.
    Position {
        /// The position (607A), in the drive's units.
        #[arg(allow_hyphen_values = true)]
        target: String,
        /// From where it is, not from its home position.
        #[arg(long)]
        relative: bool,
        /// The velocity on the way (6081), in the drive's units.
        #[arg(long, value_name = "N", allow_hyphen_values = true)]
        velocity: Option<String>,
        #[command(flatten)]
        profile: Profile,
        #[command(flatten)]
        motion: MotionArgs,
    },
    /// Look for its home position. Requires --yes.
    Home {
        /// How (6098); otherwise as it is set up.
        #[arg(long, value_name = "N", allow_hyphen_values = true)]
        method: Option<String>,
        #[command(flatten)]
        motion: MotionArgs,
    },
    /// Turn with a torque, until Ctrl-C or for --time. Requires --yes.
    Torque {
        /// The torque (6071), in thousandths of the rated torque.
        #[arg(allow_hyphen_values = true)]
        target: String,
        /// How fast it changes (6087), in thousandths of the rated torque per second.
        #[arg(long, value_name = "N", allow_hyphen_values = true)]
        slope: Option<String>,
        #[command(flatten)]
        motion: MotionArgs,
    },
}

#[derive(clap::Args)]
struct Yes {
    /// Confirm that the machine may move.
    #[arg(short, long)]
    yes: bool,
}

#[derive(clap::Args)]
struct Profile {
    /// The acceleration (6083), in the drive's units.
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    acceleration: Option<String>,
    /// The deceleration (6084), in the drive's units.
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    deceleration: Option<String>,
}

#[derive(clap::Args)]
struct MotionArgs {
    #[command(flatten)]
    yes: Yes,
    /// How long a velocity or a torque lasts, or how long a target may take (1m by default).
    #[arg(short, long, value_name = "TIME", value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// Leave operation enabled if all went well. Otherwise, and always after an error or Ctrl-C, the motion ends with a quick stop, after which
    /// the drive loses its power.
    #[arg(long)]
    stay_enabled: bool,
    /// Have the drive end the motion by itself if it hears nothing from here for this long (500ms without a value), as when a cable is pulled: this
    /// computer sends a heartbeat, and an entry of object 1016 says so to the drive until the end.
    #[arg(long, value_name = "TIME", num_args = 0..=1, default_missing_value = "500ms", value_parser = args::positive_duration)]
    guard: Option<Duration>,
    /// The number of the node whose heartbeat that is; one that no node has.
    #[arg(long, value_name = "NODE", default_value_t = 127, value_parser = super::node, requires = "guard")]
    guard_node: u8,
}

fn mode(text: &str) -> Result<i8, String> {
    let number = || text.parse().ok().filter(|mode| *mode < 0 || mode_name(*mode).is_some());
    mode_named(text).or_else(number).ok_or_else(|| {
        "modes are pp, vl, pv, tq, hm, ip, csp, csv, cst, as in profile-velocity, or their numbers".to_owned()
    })
}

/// The objects of a node, as its sheet has them.
struct Objects<'a> {
    node: u8,
    axis: u8,
    sheet: Option<&'a Sheet>,
}

impl Objects<'_> {
    /// The bytes of a value, if it fits the object and the limits that the sheet sets.
    fn bytes(&self, index: u16, text: &str) -> anyhow::Result<Vec<u8>> {
        let of_first = index;
        let index = object_of_axis(index, self.axis);
        let entry = self.sheet.map(|sheet| sheet.eds.entry_of(index, 0));
        let entry = match entry {
            Some(None) => return Err(usage(format!("the node's sheet has no object {index:04X}"))),
            entry => entry.flatten(),
        };
        let kind = entry.and_then(|entry| entry.data_type).or_else(|| data_type(of_first));
        let kind = kind.ok_or_else(|| anyhow!("the type of {index:04X} is not known"))?;
        let data = encode(kind, text).map_err(|error| usage(format!("object {index:04X}: {error}")))?;
        let Some(entry) = entry else { return Ok(data) };
        let limit = |text: &str| number(text, self.node);
        // In the sheet's words a limit may be negative or in hexadecimal; a value is decimal, or in hexadecimal.
        let value = text
            .strip_prefix('-')
            .map_or_else(|| number(text, 0), |rest| number(rest, 0).map(|value| -value));
        let (low, high) = (limit(&entry.low_limit), limit(&entry.high_limit));
        let is_out = value
            .is_some_and(|value| low.is_some_and(|low| value < low) || high.is_some_and(|high| value > high));
        if is_out {
            let (low, high) = (&entry.low_limit, &entry.high_limit);
            let name = &entry.name;
            return Err(usage(format!(
                "object {index:04X} ({name}): {text} is outside the limits of the node's sheet, {low} to {high}"
            )));
        }
        Ok(data)
    }

    fn parameters(&self, wanted: &[(u16, &Option<String>)]) -> anyhow::Result<Vec<(u16, Vec<u8>)>> {
        let given = wanted.iter().filter_map(|(index, text)| Some((*index, text.as_deref()?)));
        given.map(|(index, text)| Ok((index, self.bytes(index, text)?))).collect()
    }
}

/// What to do, with everything checked.
enum Job {
    Report,
    Watch(Duration, Option<Duration>),
    Enable,
    Step(DriveStep),
    Mode(i8, bool),
    Move(Motion, MotionOptions),
}

impl MotionArgs {
    fn guard(&self) -> Option<Guard> {
        self.guard.map(|within| Guard { node: self.guard_node, within })
    }
}

impl What {
    /// What the drive is to watch meanwhile.
    fn guard(&self) -> Option<Guard> {
        match self {
            Self::Velocity { motion, .. }
            | Self::Position { motion, .. }
            | Self::Home { motion, .. }
            | Self::Torque { motion, .. } => motion.guard(),
            _ => None,
        }
    }

    fn job(&self, objects: &Objects<'_>) -> anyhow::Result<Job> {
        let confirmed = |yes: &Yes| if yes.yes { Ok(()) } else { Err(usage(DANGER)) };
        let options = |motion: &MotionArgs, parameters| {
            confirmed(&motion.yes)?;
            Ok::<_, anyhow::Error>(MotionOptions {
                parameters,
                time: motion.time,
                stay_enabled: motion.stay_enabled,
            })
        };
        Ok(match self {
            Self::Status => Job::Report,
            Self::Watch { period, time } => Job::Watch(*period, *time),
            Self::Enable(yes) => {
                confirmed(yes)?;
                Job::Enable
            }
            Self::Disable => Job::Step(DriveStep::Disable),
            Self::QuickStop => Job::Step(DriveStep::QuickStop),
            Self::FaultReset => Job::Step(DriveStep::ResetFault),
            Self::Mode { mode, yes } => Job::Mode(*mode, yes.yes),
            Self::Velocity { target, profile, motion } => {
                let parameters = objects.parameters(&[
                    (PROFILE_ACCELERATION, &profile.acceleration),
                    (PROFILE_DECELERATION, &profile.deceleration),
                ])?;
                let target = objects.bytes(TARGET_VELOCITY, target)?;
                Job::Move(Motion::Velocity(target), options(motion, parameters)?)
            }
            Self::Position { target, relative, velocity, profile, motion } => {
                let parameters = objects.parameters(&[
                    (PROFILE_VELOCITY, velocity),
                    (PROFILE_ACCELERATION, &profile.acceleration),
                    (PROFILE_DECELERATION, &profile.deceleration),
                ])?;
                let target = objects.bytes(TARGET_POSITION, target)?;
                Job::Move(Motion::Position { target, relative: *relative }, options(motion, parameters)?)
            }
            Self::Home { method, motion } => {
                let parameters = objects.parameters(&[(HOMING_METHOD, method)])?;
                Job::Move(Motion::Home, options(motion, parameters)?)
            }
            Self::Torque { target, slope, motion } => {
                let parameters = objects.parameters(&[(TORQUE_SLOPE, slope)])?;
                let target = objects.bytes(TARGET_TORQUE, target)?;
                Job::Move(Motion::Torque(target), options(motion, parameters)?)
            }
        })
    }
}

/// Runs it.
pub(super) fn run(
    speak: &SpeakArgs,
    args: &DriveArgs,
    answer_ns: u64,
    sheets: Vec<Sheet>,
) -> anyhow::Result<()> {
    let own = sheets.iter().find(|sheet| sheet.node == Some(args.node));
    let sheet = own.or_else(|| sheets.iter().find(|sheet| sheet.node.is_none()));
    // Everything is checked before anything is sent.
    let job = args.what.job(&Objects { node: args.node, axis: args.axis, sheet })?;
    let timing = DriveTiming {
        answer_ns,
        confirm_ns: args::nanoseconds(args.confirm),
        stop_ns: args::nanoseconds(args.braking),
        ..DriveTiming::default()
    };
    let device = speak.open()?;
    let mut speaking = speak.speak(&device, Box::new(CanOpen::new(sheets)));
    let (channel, is_json) = (speak.channel().number(), speak.json);
    let on_status = move |status: &DriveStatus| {
        let mut out = std::io::stdout().lock();
        if is_json {
            writeln!(out, "{}", line(channel, status))?;
        } else {
            // The state that it is in now is in the last line.
            for state in status.states.iter().rev().skip(1).rev() {
                writeln!(out, "{}: {}", status.name(), state.name())?;
            }
            writeln!(out, "{status}")?;
        }
        out.flush()
    };
    let mut drive = Drive::new(&mut speaking, args.node, args.axis, timing, Box::new(on_status));
    let done = match job {
        Job::Report => drive.report().map(|()| None),
        Job::Watch(period, time) => drive.watch(period, time).map(|()| None),
        Job::Enable => drive.enable().map(Some),
        Job::Step(step) => drive.single(step).map(|()| None),
        Job::Mode(mode, yes) => choose(&mut drive, mode, yes).map(|()| None),
        Job::Move(motion, options) => args
            .what
            .guard()
            .map_or(Ok(()), |guard| watch_us(&mut drive, guard))
            .and_then(|()| drive.move_it(&motion, &options).map(Some)),
    };
    drop(drive);
    if let Some(text) = done? {
        stderr::tell(&format!("cantap: {text}\n"));
    }
    drop(speaking);
    device.stop()?;
    Ok(())
}

fn watch_us(drive: &mut Drive<'_, '_>, guard: Guard) -> anyhow::Result<()> {
    let text = drive.guard(guard)?;
    stderr::tell(&format!("cantap: {text}\n"));
    Ok(())
}

fn choose(drive: &mut Drive<'_, '_>, mode: i8, yes: bool) -> anyhow::Result<()> {
    drive.step(DriveStep::Inspect)?;
    if drive.state() == Some(DriveState::OperationEnabled) && !yes {
        return Err(usage(format!("operation is enabled; {DANGER}")));
    }
    drive.step(DriveStep::SetMode(mode))?;
    drive.report()
}

/// Its time is written with every digit, and therefore by hand.
fn line(channel: u8, status: &DriveStatus) -> String {
    let values = &status.values;
    let names: Vec<_> = status.states.iter().map(|state| state.name()).collect();
    let rest = json!({
        "channel": channel,
        "node": status.node,
        "axis": status.axis,
        "states": names,
        "state": values.state().map(DriveState::name),
        "statusword": values.statusword,
        "flags": status.flags(),
        "mode": values.mode,
        "mode_name": status.mode(),
        "error_code": values.error_code,
        "error": status.error(),
        "position": values.position,
        "velocity": values.velocity,
        "torque": values.torque,
    });
    format!("{{\"time_s\":{},{}", Seconds(status.time_ns), &rest.to_string()[1..])
}
