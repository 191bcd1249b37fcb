//! The kernel's side: the socket, rtnetlink, and the list of interfaces.

use std::collections::BTreeSet;
use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;
use std::time::Duration;

use nix::sys::socket::{
    AddressFamily, MsgFlags, SockFlag, SockProtocol, SockType, recv, send, setsockopt, socket, sockopt,
};
use nix::sys::time::{TimeVal, TimeValLike};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::interface::{Interface, Kernel};
use super::link::{self, Link};
use super::link_change;
use crate::interface_name;
use crate::raw_can::{BATCH, Message, Options, RawFdFrame, RawFrame, RawSocket};

/// Where the kernel lists its network interfaces.
const NETWORK: &str = "/sys/class/net";
/// Where it lists who receives from its CAN interfaces.
const RECEIVERS: &str = "/proc/net/can";
/// `ARPHRD_CAN` of `linux/if_arp.h`, as listed there.
const TYPE_OF_CAN: &str = "280";
/// The longest answer about one interface is much shorter.
const ANSWER_BYTES: usize = 32 * 1024;
/// The kernel answers at once, but for an adapter that is slow to start or to stop.
const ANSWER_WITHIN_S: i64 = 5;

/// Whether there is a CAN interface of this name.
pub(crate) fn exists(name: &str) -> bool {
    is_can(Path::new(NETWORK), name)
}

/// The names of the CAN interfaces.
pub(crate) fn interfaces() -> Vec<String> {
    let entries = std::fs::read_dir(NETWORK).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut names: Vec<String> = names.filter(|name| exists(name)).collect();
    names.sort();
    names
}

/// What a message says of them, where another one was named.
pub(super) fn there() -> String {
    match interfaces() {
        there if there.is_empty() => {
            "there is none here: plug an adapter in that Linux has a driver for (or, as root, for a virtual one: ip link add vcan0 type vcan && ip link set vcan0 up)"
                .to_owned()
        }
        there => format!("there are {}", there.join(", ")),
    }
}

fn is_can(network: &Path, name: &str) -> bool {
    interface_name::is_possible(name)
        && std::fs::read_to_string(network.join(name).join("type"))
            .is_ok_and(|kind| kind.trim() == TYPE_OF_CAN)
}

/// Whether its driver takes an adapter's word that a frame was sent, as `gs_usb` does: candleLight's firmware returns a frame when its controller has
/// it, which is before it is on the bus, if it ever is.
fn echoes_early(network: &Path, name: &str) -> bool {
    let driver = std::fs::read_link(network.join(name).join("device/driver"));
    driver.is_ok_and(|driver| driver.file_name().is_some_and(|name| name == "gs_usb"))
}

/// An interface of this computer.
pub(crate) struct LinuxInterface {
    name: String,
    socket: Option<RawSocket>,
}

impl LinuxInterface {
    pub fn new(name: &str) -> Self {
        Self { name: name.to_owned(), socket: None }
    }

    /// Whether the controller stamps what it receives. An error is that there is no socket for the interface.
    pub fn has_hardware_stamps(&self) -> io::Result<bool> {
        RawSocket::open(&self.name, Options::default()).map(|socket| socket.has_hardware_stamps())
    }
}

/// Asks the kernel about an interface.
fn ask(name: &str) -> io::Result<Link> {
    link::answer(&exchange(&link::request(name))?)
}

/// Sends the kernel a message, and returns its answer.
fn exchange(message: &[u8]) -> io::Result<Vec<u8>> {
    let socket: OwnedFd =
        socket(AddressFamily::Netlink, SockType::Raw, SockFlag::SOCK_CLOEXEC, SockProtocol::NetlinkRoute)?;
    setsockopt(&socket, sockopt::ReceiveTimeout, &TimeVal::seconds(ANSWER_WITHIN_S))?;
    send(socket.as_raw_fd(), message, MsgFlags::empty())?;
    let mut answer = vec![0; ANSWER_BYTES];
    let len = recv(socket.as_raw_fd(), &mut answer, MsgFlags::empty())?;
    answer.truncate(len);
    Ok(answer)
}

/// An interface that is to be set up.
pub(super) struct KernelLink(String);

impl KernelLink {
    pub fn new(name: &str) -> Self {
        Self(name.to_owned())
    }
}

impl Kernel for KernelLink {
    fn look(&mut self) -> io::Result<Link> {
        ask(&self.0)
    }

    fn change(&mut self, message: &[u8]) -> io::Result<()> {
        link_change::acknowledged(&exchange(message)?)
    }

    fn receivers(&self) -> Vec<String> {
        receivers(Path::new(RECEIVERS), &self.0)
    }
}

/// The protocols through which programs receive from an interface, as the kernel lists them: each line is a filter, and its last word the protocol.
fn receivers(lists: &Path, name: &str) -> Vec<String> {
    let mut found = BTreeSet::new();
    for list in ["all", "err", "fil", "inv", "sff", "eff"] {
        let text = std::fs::read_to_string(lists.join(format!("rcvlist_{list}"))).unwrap_or_default();
        for line in text.lines() {
            let mut words = line.split_whitespace();
            if words.next() == Some(name) && words.clone().count() == 6 {
                found.extend(words.next_back().map(str::to_owned));
            }
        }
    }
    found.into_iter().collect()
}

impl Interface for LinuxInterface {
    fn look(&mut self) -> io::Result<Link> {
        let link = ask(&self.name)?;
        Ok(Link { echoes: link.echoes && !echoes_early(Path::new(NETWORK), &self.name), ..link })
    }

    fn open(&mut self) -> io::Result<()> {
        let options = Options { errors: true, fd: true, own: true, stamps: true };
        self.socket = Some(RawSocket::open(&self.name, options)?);
        Ok(())
    }

    fn close(&mut self) {
        self.socket = None;
    }

    fn wait(&mut self, wait: Duration) {
        let Some(socket) = &self.socket else { return std::thread::sleep(wait) };
        if wait.is_zero() {
            return;
        }
        let Ok(wait) = Timespec::try_from(wait) else { return };
        // Whatever it says, the next read says more.
        let _ = poll(&mut [PollFd::new(socket, PollFlags::IN)], Some(&wait));
    }

    fn receive(&mut self, messages: &mut Vec<Message>) -> io::Result<()> {
        self.socket.as_ref().map_or(Ok(()), |socket| socket.receive(BATCH, messages))
    }

    fn send(&mut self, frame: &RawFrame) -> io::Result<()> {
        match &self.socket {
            Some(socket) => socket.send(std::slice::from_ref(frame)).map(|_| ()),
            None => Err(io::ErrorKind::NotConnected.into()),
        }
    }

    fn send_fd(&mut self, frame: &RawFdFrame) -> io::Result<()> {
        self.socket.as_ref().map_or(Err(io::ErrorKind::NotConnected.into()), |socket| socket.send_fd(frame))
    }

    fn dropped(&mut self) -> Option<u32> {
        self.socket.as_ref()?.dropped().ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_can_interfaces_are_listed() {
        let folder = tempfile::tempdir().unwrap();
        for (name, kind) in [("can0", "280\n"), ("lo", "772\n")] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
            std::fs::write(folder.path().join(name).join("type"), kind).unwrap();
        }
        let is_can = |name| is_can(folder.path(), name);
        assert!(is_can("can0"));
        assert!(!is_can("lo") && !is_can("can1") && !is_can("") && !is_can("..") && !is_can("can0/../can0"));
    }

    #[test]
    fn who_receives_from_an_interface_is_read_from_the_kernel_s_lists() {
        let folder = tempfile::tempdir().unwrap();
        let head = "\nreceive list 'rx_all':\n  device   can_id   can_mask  function          userdata          matches  ident\n";
        let lines = "   can0     000    00000000  0000000000000000  0000000000000000        12  raw\n  (can1: no entry)\n";
        std::fs::write(folder.path().join("rcvlist_all"), format!("{head}{lines}  (any: no entry)\n"))
            .unwrap();
        let lines = "   can0     7e8    c00007ff  0000000000000000  0000000000000000         0  isotp\n   can10     123    c00007ff  0000000000000000  0000000000000000         0  bcm\n";
        std::fs::write(folder.path().join("rcvlist_sff"), lines).unwrap();
        assert_eq!(receivers(folder.path(), "can0"), ["isotp", "raw"]);
        assert_eq!(receivers(folder.path(), "can1"), [""; 0]);
        assert_eq!(receivers(&folder.path().join("none"), "can0"), [""; 0]);
    }

    #[test]
    fn what_the_driver_of_gs_usb_adapters_returns_is_no_proof() {
        let folder = tempfile::tempdir().unwrap();
        for (name, driver) in [("can0", "gs_usb"), ("can1", "peak_usb")] {
            let device = folder.path().join(name).join("device");
            std::fs::create_dir_all(&device).unwrap();
            std::os::unix::fs::symlink(format!("../../bus/usb/drivers/{driver}"), device.join("driver"))
                .unwrap();
        }
        let early = |name| echoes_early(folder.path(), name);
        assert!(early("can0") && !early("can1") && !early("vcan0"));
    }

    /// This kernel may know nothing about CAN, but it knows its own interfaces.
    #[test]
    fn the_kernel_s_answers_are_read() {
        let Ok(loopback) = ask("lo") else { return };
        assert!(!loopback.is_can && loopback.kind.is_empty());
        let error = ask("no-such-thing").unwrap_err();
        assert_eq!(error.raw_os_error(), Some(nix::libc::ENODEV));
    }
}
