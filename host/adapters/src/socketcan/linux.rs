//! The kernel's side: the socket, rtnetlink, and the list of interfaces.

use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;
use std::time::Duration;

use nix::sys::socket::{
    AddressFamily, MsgFlags, SockFlag, SockProtocol, SockType, recv, send, setsockopt, socket, sockopt,
};
use nix::sys::time::{TimeVal, TimeValLike};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::interface::Interface;
use super::link::{self, Link};
use crate::interface_name;
use crate::raw_can::{BATCH, Message, Options, RawFdFrame, RawFrame, RawSocket};

/// Where the kernel lists its network interfaces.
const NETWORK: &str = "/sys/class/net";
/// `ARPHRD_CAN` of `linux/if_arp.h`, as listed there.
const TYPE_OF_CAN: &str = "280";
/// The longest answer about one interface is much shorter.
const ANSWER_BYTES: usize = 32 * 1024;
/// The kernel answers at once.
const ANSWER_WITHIN_S: i64 = 1;

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

    /// Whether the controller stamps what it receives.
    pub fn has_hardware_stamps(&self) -> bool {
        RawSocket::open(&self.name, Options::default()).is_ok_and(|socket| socket.has_hardware_stamps())
    }
}

/// Asks the kernel about an interface.
fn ask(name: &str) -> io::Result<Link> {
    let socket: OwnedFd =
        socket(AddressFamily::Netlink, SockType::Raw, SockFlag::SOCK_CLOEXEC, SockProtocol::NetlinkRoute)?;
    setsockopt(&socket, sockopt::ReceiveTimeout, &TimeVal::seconds(ANSWER_WITHIN_S))?;
    send(socket.as_raw_fd(), &link::request(name), MsgFlags::empty())?;
    let mut answer = vec![0; ANSWER_BYTES];
    let len = recv(socket.as_raw_fd(), &mut answer, MsgFlags::empty())?;
    link::answer(&answer[..len])
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
