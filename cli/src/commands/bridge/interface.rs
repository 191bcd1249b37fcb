//! A Linux CAN interface, through a raw socket: many frames with each system call.

use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, bail};
use cantap_adapters::raw_can::{Options, RawSocket};

use nix::libc::{EAGAIN, ENETDOWN, ENOBUFS};

use super::raw::Raw;

/// How often a full socket is retried, a millisecond apart.
const TRIES: u32 = 200;
/// Where the kernel describes its network interfaces.
const NETWORK: &str = "/sys/class/net";
/// ARPHRD_CAN of `linux/if_arp.h`.
const TYPE_OF_CAN: &str = "280";
/// Of `linux/if.h`.
const IFF_UP: u32 = 1;
const IFF_ECHO: u32 = 1 << 18;
/// The queue length of controllers' interfaces (users of `linux/can/dev.h`); virtual ones have no driver of their own to set it, and
/// the kernel makes it 1000.
const QUEUE_OF_CONTROLLERS: &str = "10";
/// The least MTU of an interface with CAN FD: `CANFD_MTU` of `linux/can.h`.
const FD_MTU: u32 = 72;

/// Where frames go to and come from. It is a trait because there are no CAN sockets where the tests run.
pub trait Port: Send + Sync {
    /// Adds frames written by programs, up to a limit, without waiting. Returns how many the kernel has discarded so far because
    /// nobody took them.
    fn receive(&self, most: usize, frames: &mut Vec<Raw>) -> io::Result<u32>;
    /// Passes frames to programs. Returns how many were taken; an error if none was.
    fn send(&self, frames: &[Raw]) -> io::Result<usize>;
    /// A descriptor to wait on.
    fn as_fd(&self) -> Option<BorrowedFd<'_>>;
}

/// An open interface.
pub struct CanPort(RawSocket);

/// What is known of an interface before it is opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Known {
    /// The kernel does not show a sender its own frame, so a confirmation can serve as the echo.
    pub echoes: bool,
    /// It takes CAN FD frames.
    pub has_fd: bool,
}

impl CanPort {
    /// Opens an interface, which must be virtual, and up. The error contains the command for that.
    pub fn open(name: &str) -> anyhow::Result<(Self, Known)> {
        let known = look(Path::new(NETWORK), name)?;
        // Errors on this interface would be our own.
        let socket = RawSocket::open(name, Options { fd: known.has_fd, ..Options::default() })
            .with_context(|| format!("the interface '{name}' cannot be opened"))?;
        Ok((Self(socket), known))
    }
}

/// Checks whether an interface can be bridged, and how it echoes.
fn look(network: &Path, name: &str) -> anyhow::Result<Known> {
    let folder = network.join(name);
    let read = |file: &str| {
        let text = std::fs::read_to_string(folder.join(file)).unwrap_or_default();
        text.trim().to_owned()
    };
    if name.is_empty() || name.contains('/') || !folder.exists() {
        bail!(
            "there is no interface '{name}'; as root: ip link add {name} type vcan && ip link set {name} up"
        );
    }
    if read("type") != TYPE_OF_CAN {
        bail!("'{name}' is not a CAN interface; as root: ip link add can0 type vcan && ip link set can0 up");
    }
    let flags = u32::from_str_radix(read("flags").trim_start_matches("0x"), 16).unwrap_or(0);
    // The ends of a vxcan pair name each other.
    let is_pair = read("iflink") != read("ifindex");
    let is_virtual =
        folder.canonicalize().is_ok_and(|path| path.components().any(|part| part.as_os_str() == "virtual"));
    let has_controller = flags & IFF_ECHO != 0 && !is_pair && read("tx_queue_len") == QUEUE_OF_CONTROLLERS;
    if !is_virtual || has_controller {
        bail!(
            "'{name}' belongs to a CAN controller, which would send on its bus what is heard here; bridge to a virtual one, as \
             root: ip link add vcan0 type vcan && ip link set vcan0 up"
        );
    }
    if flags & IFF_UP == 0 {
        bail!("the interface '{name}' is down; as root: ip link set {name} up");
    }
    // vcan shows each frame to the other programs as it is written; so do pairs in newer kernels, although the driver does not declare
    // it.
    let has_fd = read("mtu").parse::<u32>().is_ok_and(|mtu| mtu >= FD_MTU);
    Ok(Known { echoes: is_pair && flags & IFF_ECHO != 0, has_fd })
}

impl Port for CanPort {
    fn receive(&self, most: usize, frames: &mut Vec<Raw>) -> io::Result<u32> {
        let mut messages = Vec::new();
        match self.0.receive(most, &mut messages) {
            // An interface that is down may come up again.
            Err(error) if error.raw_os_error() != Some(ENETDOWN) => return Err(error),
            _ => {}
        }
        frames.extend(messages.iter().filter_map(|message| Raw::of(message.bytes())));
        Ok(messages.iter().rev().find_map(|message| message.dropped).unwrap_or(0))
    }

    fn send(&self, frames: &[Raw]) -> io::Result<usize> {
        let mut sent = 0;
        let mut tries = 0;
        while sent < frames.len() {
            match self.0.send_messages(frames[sent..].iter().map(Raw::bytes)) {
                Ok(count) => {
                    sent += count;
                    tries = 0;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if matches!(error.raw_os_error(), Some(EAGAIN | ENOBUFS)) && tries < TRIES => {
                    tries += 1;
                    std::thread::sleep(Duration::from_millis(1));
                }
                Err(_) if sent > 0 => return Ok(sent),
                Err(error) => return Err(error),
            }
        }
        Ok(sent)
    }

    fn as_fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.0.as_fd())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An interface, as shown by the kernel.
    fn interface(network: &Path, place: &str, name: &str, files: [(&str, &str); 6]) {
        let folder = network.join("devices").join(place).join("net").join(name);
        std::fs::create_dir_all(&folder).unwrap();
        for (file, text) in files {
            std::fs::write(folder.join(file), format!("{text}\n")).unwrap();
        }
        std::os::unix::fs::symlink(folder, network.join(name)).unwrap();
    }

    #[test]
    fn only_virtual_can_interfaces_that_are_up_are_bridged_and_the_error_says_what_root_must_run() {
        let folder = tempfile::tempdir().unwrap();
        let with_mtu = |mtu, kind, flags, index, link, queue| {
            let kind = [("type", kind), ("flags", flags), ("ifindex", index)];
            let [kind, flags, index] = kind;
            [kind, flags, index, ("iflink", link), ("tx_queue_len", queue), ("mtu", mtu)]
        };
        let files = |kind, flags, index, link, queue| with_mtu("16", kind, flags, index, link, queue);
        for (place, name, files) in [
            ("virtual", "vcan0", files("280", "0xc1", "4", "4", "1000")),
            ("virtual", "fd", with_mtu("72", "280", "0xc1", "12", "12", "1000")),
            ("virtual", "old", files("280", "0x400c1", "5", "6", "1000")),
            ("virtual", "new", files("280", "0xc1", "7", "8", "1000")),
            ("virtual", "down", files("280", "0x80", "9", "9", "1000")),
            ("virtual", "slcan0", files("280", "0x400c1", "10", "10", "10")),
            ("pci0", "can0", files("280", "0x400c1", "11", "11", "10")),
            ("virtual", "lo", files("772", "0x9", "1", "1", "1000")),
        ] {
            interface(folder.path(), place, name, files);
        }
        let look = |name| look(folder.path(), name).map_err(|error| error.to_string());
        assert_eq!(look("vcan0"), Ok(Known { echoes: false, has_fd: false }));
        assert_eq!(look("fd"), Ok(Known { echoes: false, has_fd: true }));
        assert_eq!(look("new"), Ok(Known { echoes: false, has_fd: false }));
        assert_eq!(look("old"), Ok(Known { echoes: true, has_fd: false }));
        for (name, part) in [
            ("can7", "ip link add can7 type vcan && ip link set can7 up"),
            ("down", "ip link set down up"),
            ("slcan0", "belongs to a CAN controller"),
            ("can0", "belongs to a CAN controller"),
            ("lo", "not a CAN interface"),
            ("../x", "no interface"),
        ] {
            let error = look(name).unwrap_err();
            assert!(error.contains(part), "{name}: {error}");
        }
    }
}
