//! Setting an interface up, where somebody asks for just that: bit rate, mode, restart after bus-off. Nothing else in this crate does it.

use std::fmt::Write as _;
use std::io;
use std::time::Duration;

use cantap_wire::message::Mode;
use cantap_wire::record::ErrorState;
use nix::libc::{EACCES, EDOM, EINVAL, ENODEV, EOPNOTSUPP, EPERM, ERANGE};

use super::interface::Kernel;
use super::link::{CAN_CTRLMODE_FD, CAN_CTRLMODE_LISTENONLY, CAN_CTRLMODE_LOOPBACK, Link, SetUp, Timing};
use super::link_change;
use super::linux::{KernelLink, there};
use crate::interface_name::same_rate;

/// What an interface is to be set to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InterfaceSettings {
    /// In bit/s.
    pub bitrate_bps: u32,
    /// Where in the bit, in thousandths of it; `None` leaves it to the kernel.
    pub sample_point_permille: Option<u32>,
    /// Whether the interface acknowledges and sends.
    pub mode: Mode,
    /// In bit/s, for the data phases of CAN FD frames; `None` switches CAN FD off.
    pub data_bitrate_bps: Option<u32>,
    /// Time from bus-off to a restart by the kernel, in whole milliseconds; zero for none; `None` leaves it as it is.
    pub restart_after: Option<Duration>,
}

/// What the kernel says about an interface.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct CanInterface {
    /// As given.
    pub name: String,
    /// As `ip link` has it: `can` with a controller, `vcan`, `vxcan`.
    pub kind: String,
    /// Frames can pass.
    pub is_up: bool,
    /// In bit/s, if one is set.
    pub bitrate_bps: Option<u32>,
    /// In thousandths of the bit, if a bit rate is set and the driver says.
    pub sample_point_permille: Option<u32>,
    /// In bit/s, if CAN FD is on.
    pub data_bitrate_bps: Option<u32>,
    /// `None` where there is no controller.
    pub mode: Option<Mode>,
    /// Of fault confinement, if it is up and the driver says.
    pub state: Option<ErrorState>,
    /// Transmit and receive error counter, if the driver says.
    pub counters: Option<(u8, u8)>,
    /// Milliseconds from bus-off to a restart by the kernel; 0 if there is none, `None` where there is no controller.
    pub restart_ms: Option<u32>,
    /// The protocols of the kernel through which programs receive from it: `raw`, `bcm`, `isotp`, `j1939`. Those that only send are not seen.
    pub receivers: Vec<String>,
}

/// Why an interface is not set as asked. Each message says what to do next.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum InterfaceError {
    /// There is no such interface.
    #[error("'{name}' is no CAN interface of this computer: {there}")]
    NotThere {
        /// As given.
        name: String,
        /// Those that there are.
        there: String,
    },
    /// It has no controller.
    #[error(
        "'{name}' is virtual ({kind}): it has no bit rate, no mode and no bus-off; nothing has to be set"
    )]
    Virtual {
        /// As given.
        name: String,
        /// As `ip link` has it.
        kind: String,
    },
    /// Programs receive from it, and it would have to be taken down.
    #[error(
        "programs receive from '{name}' ({receivers}), and to change it takes it down, which they get as an error; end them, or confirm with --yes"
    )]
    InUse {
        /// As given.
        name: String,
        /// Through which protocols.
        receivers: String,
    },
    /// The user may not.
    #[error(
        "only root may set '{name}'. As root: {command}; or, once, let this program do it for every user who runs it: setcap cap_net_admin=ep {program}"
    )]
    NoRights {
        /// As given.
        name: String,
        /// What does it.
        command: String,
        /// This program's file.
        program: String,
    },
    /// The kernel, the driver or the controller refuses.
    #[error("'{name}' cannot {what} ({source}); {advice}. {afterwards}")]
    Refused {
        /// As given.
        name: String,
        /// What was asked for.
        what: String,
        /// The system's error.
        source: io::Error,
        /// What to do.
        advice: String,
        /// How the interface is now.
        afterwards: String,
    },
    /// It runs at another rate than was asked for.
    #[error(
        "'{name}' comes as near to {wanted_bps} bit/s as {got_bps}, which is too far off; give a bit rate that its clock reaches. {afterwards}"
    )]
    OtherRate {
        /// As given.
        name: String,
        /// In bit/s.
        wanted_bps: u32,
        /// In bit/s.
        got_bps: u32,
        /// How the interface is now.
        afterwards: String,
    },
    /// It has nothing to be restarted from.
    #[error("'{name}' is not to be restarted: {reason}")]
    NoRestart {
        /// As given.
        name: String,
        /// Why.
        reason: String,
    },
    /// The kernel answers otherwise.
    #[error("the kernel fails at '{name}' ({source}); its log (dmesg) may say more")]
    System {
        /// As given.
        name: String,
        /// The system's error.
        source: io::Error,
    },
}

/// What the kernel says about an interface.
///
/// # Errors
/// There is no such interface.
pub fn can_interface(name: &str) -> Result<CanInterface, InterfaceError> {
    let mut kernel = KernelLink::new(name);
    look(&mut kernel, name).map(|link| described(name, link, kernel.receivers()))
}

/// Sets an interface: takes it down, sets it, takes it up. If that fails, what was set before is set again. One that is already so is left alone.
/// Returns whether it had to be changed.
///
/// # Errors
/// See [`InterfaceError`]; [`InterfaceError::InUse`] not if `even_if_used`.
pub fn set_can_interface(
    name: &str,
    settings: &InterfaceSettings,
    even_if_used: bool,
) -> Result<bool, InterfaceError> {
    set(&mut KernelLink::new(name), name, settings, even_if_used)
}

/// Takes an interface down. Returns whether it was up.
///
/// # Errors
/// See [`InterfaceError`]; [`InterfaceError::InUse`] not if `even_if_used`.
pub fn take_down_can_interface(name: &str, even_if_used: bool) -> Result<bool, InterfaceError> {
    take_down(&mut KernelLink::new(name), name, even_if_used)
}

/// Restarts the controller of an interface that is off its bus. It then waits for the bus to be idle, as after each bus-off.
///
/// # Errors
/// It is not off its bus, or the kernel restarts it by itself.
pub fn restart_can_interface(name: &str) -> Result<(), InterfaceError> {
    restart(&mut KernelLink::new(name), name)
}

fn described(name: &str, link: Link, receivers: Vec<String>) -> CanInterface {
    let has_controller = link.kind == "can";
    let mode = match (link.set_up.mode & CAN_CTRLMODE_LOOPBACK != 0, link.listen_only) {
        (false, false) => Mode::Normal,
        (false, true) => Mode::ListenOnly,
        (true, false) => Mode::Loopback,
        (true, true) => Mode::SilentLoopback,
    };
    let sample_point = Some(link.set_up.timing[1]).filter(|point| *point > 0);
    CanInterface {
        name: name.to_owned(),
        is_up: link.is_up,
        sample_point_permille: link.bitrate_bps.and(sample_point),
        bitrate_bps: link.bitrate_bps,
        data_bitrate_bps: link.data_bitrate_bps,
        mode: has_controller.then_some(mode),
        // The kernel has a state for one that is down, too.
        state: link.state.filter(|_| link.is_up),
        counters: link.counters.filter(|_| link.is_up),
        restart_ms: has_controller.then_some(link.set_up.restart_ms),
        kind: link.kind,
        receivers,
    }
}

fn look(kernel: &mut impl Kernel, name: &str) -> Result<Link, InterfaceError> {
    let name = name.to_owned();
    match kernel.look() {
        Ok(link) if link.is_can => Ok(link),
        Err(source) if source.raw_os_error() != Some(ENODEV) => Err(InterfaceError::System { name, source }),
        Ok(_) | Err(_) => Err(InterfaceError::NotThere { name, there: there() }),
    }
}

/// The same of an interface with a controller.
fn look_at_controller(kernel: &mut impl Kernel, name: &str) -> Result<Link, InterfaceError> {
    let link = look(kernel, name)?;
    if link.kind == "can" {
        return Ok(link);
    }
    let kind = if link.kind.is_empty() { "no controller".to_owned() } else { link.kind };
    Err(InterfaceError::Virtual { name: name.to_owned(), kind })
}

/// Whoever receives from an interface that is up is not disturbed without having been asked.
fn ask_users(
    kernel: &impl Kernel,
    name: &str,
    link: &Link,
    even_if_used: bool,
) -> Result<(), InterfaceError> {
    let receivers = kernel.receivers();
    if !link.is_up || even_if_used || receivers.is_empty() {
        return Ok(());
    }
    Err(InterfaceError::InUse { name: name.to_owned(), receivers: receivers.join(", ") })
}

fn no_rights(name: &str, command: String) -> InterfaceError {
    let program = std::env::current_exe().map(|path| path.display().to_string());
    let program = program.unwrap_or_else(|_| "the program's file".to_owned());
    InterfaceError::NoRights { name: name.to_owned(), command, program }
}

fn is_forbidden(error: &io::Error) -> bool {
    matches!(error.raw_os_error(), Some(EPERM | EACCES))
}

fn set<K: Kernel>(
    kernel: &mut K,
    name: &str,
    settings: &InterfaceSettings,
    even_if_used: bool,
) -> Result<bool, InterfaceError> {
    let before = look_at_controller(kernel, name)?;
    if before.is_up && is_so(&before, settings) {
        return Ok(false);
    }
    ask_users(kernel, name, &before, even_if_used)?;
    let (wanted, restart) = (wanted(&before, settings), settings.restart_after.is_some());
    let (down, up) = (link_change::up(wanted.index, false), link_change::up(wanted.index, true));
    let refused = |kernel: &mut K, what: &str, source: io::Error| {
        if is_forbidden(&source) {
            return no_rights(name, command(name, settings, &before));
        }
        let advice = match source.raw_os_error() {
            Some(EOPNOTSUPP) => "leave out what its driver or controller does not have",
            Some(EINVAL | ERANGE | EDOM) => "give a bit rate and a sample point that its clock reaches",
            Some(ENODEV) => "look whether it is still plugged in",
            _ => "the kernel's log (dmesg) may say more",
        };
        let (name, what, advice) = (name.to_owned(), what.to_owned(), advice.to_owned());
        InterfaceError::Refused {
            afterwards: put_back(kernel, &name, &before, restart),
            name,
            what,
            source,
            advice,
        }
    };
    if before.is_up
        && let Err(error) = kernel.change(&down)
    {
        return Err(refused(kernel, "be taken down", error));
    }
    if let Err(error) = kernel.change(&link_change::set(&wanted, restart)) {
        return Err(refused(kernel, &format!("be set to {}", in_words(settings)), error));
    }
    // Before it is on the bus: the kernel takes what is within five per cent.
    let now = look(kernel, name)?;
    let rates = [(settings.bitrate_bps, now.bitrate_bps), (wanted.data_timing[0], now.data_bitrate_bps)];
    let rates = rates.map(|(wanted_bps, got_bps)| (wanted_bps, got_bps.unwrap_or(0)));
    if let Some((wanted_bps, got_bps)) = rates.into_iter().find(|(wanted, got)| !same_rate(*wanted, *got)) {
        let afterwards = put_back(kernel, name, &before, restart);
        return Err(InterfaceError::OtherRate { name: name.to_owned(), wanted_bps, got_bps, afterwards });
    }
    if let Err(error) = kernel.change(&up) {
        return Err(refused(kernel, "be taken up", error));
    }
    Ok(true)
}

/// Whether it runs as it should.
fn is_so(link: &Link, settings: &InterfaceSettings) -> bool {
    let mode = modes(settings);
    let sample_point = link.set_up.timing[1];
    link.bitrate_bps.is_some_and(|rate| same_rate(rate, settings.bitrate_bps))
        && link.set_up.mode & link_change::MODES == mode
        && settings.sample_point_permille.is_none_or(|wanted| wanted == sample_point)
        && settings
            .data_bitrate_bps
            .is_none_or(|wanted| link.data_bitrate_bps.is_some_and(|rate| same_rate(rate, wanted)))
        && settings.restart_after.is_none_or(|after| after.as_millis() == link.set_up.restart_ms.into())
}

fn modes(settings: &InterfaceSettings) -> u32 {
    let fd = if settings.data_bitrate_bps.is_some() { CAN_CTRLMODE_FD } else { 0 };
    fd | match settings.mode {
        Mode::Normal => 0,
        Mode::ListenOnly => CAN_CTRLMODE_LISTENONLY,
        Mode::Loopback => CAN_CTRLMODE_LOOPBACK,
        Mode::SilentLoopback => CAN_CTRLMODE_LOOPBACK | CAN_CTRLMODE_LISTENONLY,
    }
}

fn wanted(before: &Link, settings: &InterfaceSettings) -> SetUp {
    let (mut timing, mut data_timing) = (Timing::default(), Timing::default());
    timing[0] = settings.bitrate_bps;
    timing[1] = settings.sample_point_permille.unwrap_or(0);
    data_timing[0] = settings.data_bitrate_bps.unwrap_or(0);
    let restart_ms =
        settings.restart_after.map_or(0, |after| u32::try_from(after.as_millis()).unwrap_or(u32::MAX));
    SetUp { index: before.set_up.index, timing, data_timing, mode: modes(settings), restart_ms }
}

/// Sets again what was set before, the restart if it was to be changed, and says how the interface is now.
fn put_back(kernel: &mut impl Kernel, name: &str, before: &Link, restart: bool) -> String {
    let to = again(&before.set_up);
    if to.timing == Timing::default() {
        return format!("{name} had no bit rate before, and is down");
    }
    // It may be up.
    let down = kernel.change(&link_change::up(to.index, false));
    let mut done = down.and_then(|()| kernel.change(&link_change::set(&to, restart)));
    if before.is_up {
        done = done.and_then(|()| kernel.change(&link_change::up(to.index, true)));
    }
    let is = if before.is_up { "runs" } else { "is down, and set" };
    match done {
        Ok(()) => format!("{name} {is} as before"),
        Err(error) => format!(
            "{name} could not be put back as it was ({error}); look at it with ip -details link show {name}"
        ),
    }
}

/// A timing as the kernel takes it: by its segments, or where its driver has a list of bit rates, by the bit rate. Both at once it refuses.
fn again(before: &SetUp) -> SetUp {
    let as_taken = |timing: Timing| match timing {
        [_, _, quantum_ns, prop, segment1, segment2, jump_width, _] if quantum_ns > 0 => {
            [0, 0, quantum_ns, prop, segment1, segment2, jump_width, 0]
        }
        [bitrate_bps, ..] => [bitrate_bps, 0, 0, 0, 0, 0, 0, 0],
    };
    let has_fd = before.mode & CAN_CTRLMODE_FD != 0;
    let data_timing = if has_fd { as_taken(before.data_timing) } else { Timing::default() };
    SetUp { timing: as_taken(before.timing), data_timing, ..*before }
}

/// What was asked for, as a message has it.
fn in_words(settings: &InterfaceSettings) -> String {
    let mut text = format!("{} bit/s, {}", settings.bitrate_bps, settings.mode.name());
    // Writing to a String cannot fail.
    if let Some(point) = settings.sample_point_permille {
        let _ = write!(text, ", sampled at {} %", f64::from(point) / 10.0);
    }
    if let Some(rate) = settings.data_bitrate_bps {
        let _ = write!(text, ", CAN FD at {rate} bit/s");
    }
    match settings.restart_after.map(|after| after.as_millis()) {
        None => {}
        Some(0) => text.push_str(", not restarted after bus-off"),
        Some(after) => {
            let _ = write!(text, ", restarted {after} ms after bus-off");
        }
    }
    text
}

/// The lines for root that do the same.
fn command(name: &str, settings: &InterfaceSettings, before: &Link) -> String {
    let down = if before.is_up { format!("ip link set {name} down && ") } else { String::new() };
    let mut text = format!("{down}ip link set {name} up type can bitrate {}", settings.bitrate_bps);
    // Writing to a String cannot fail.
    if let Some(point) = settings.sample_point_permille {
        let _ = write!(text, " sample-point {}", f64::from(point) / 1e3);
    }
    let (wanted, now) = (modes(settings), before.set_up.mode);
    match settings.data_bitrate_bps {
        Some(rate) => {
            let _ = write!(text, " dbitrate {rate} fd on");
        }
        None if now & CAN_CTRLMODE_FD != 0 => text.push_str(" fd off"),
        None => {}
    }
    for (flag, option) in [(CAN_CTRLMODE_LISTENONLY, "listen-only"), (CAN_CTRLMODE_LOOPBACK, "loopback")] {
        if (wanted | now) & flag != 0 {
            let _ = write!(text, " {option} {}", if wanted & flag != 0 { "on" } else { "off" });
        }
    }
    if let Some(after) = settings.restart_after {
        let _ = write!(text, " restart-ms {}", after.as_millis());
    }
    text
}

fn take_down(kernel: &mut impl Kernel, name: &str, even_if_used: bool) -> Result<bool, InterfaceError> {
    let before = look(kernel, name)?;
    if !before.is_up {
        return Ok(false);
    }
    ask_users(kernel, name, &before, even_if_used)?;
    kernel.change(&link_change::up(before.set_up.index, false)).map(|()| true).map_err(|source| {
        if is_forbidden(&source) {
            return no_rights(name, format!("ip link set {name} down"));
        }
        InterfaceError::System { name: name.to_owned(), source }
    })
}

fn restart(kernel: &mut impl Kernel, name: &str) -> Result<(), InterfaceError> {
    let before = look_at_controller(kernel, name)?;
    let no_restart = |reason: String| InterfaceError::NoRestart { name: name.to_owned(), reason };
    if !before.is_up {
        return Err(no_restart(format!(
            "it is down; cantap interface {name} -b 500k, with the bus's bit rate, takes it up"
        )));
    }
    if before.set_up.restart_ms > 0 {
        return Err(no_restart(format!("the kernel does it {} ms after bus-off", before.set_up.restart_ms)));
    }
    if let Some(state) = before.state
        && state != ErrorState::BusOff
    {
        return Err(no_restart(format!("it is not off its bus (error state: {})", state.name())));
    }
    kernel.change(&link_change::restart(before.set_up.index)).map_err(|source| {
        if is_forbidden(&source) {
            return no_rights(name, format!("ip link set {name} type can restart"));
        }
        no_restart(format!("the kernel refuses ({source}); take it down and up again"))
    })
}

#[cfg(test)]
mod tests;
