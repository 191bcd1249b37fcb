//! A raw CAN socket: many frames with each system call, and what the kernel says about each.

use std::io::{self, IoSlice, IoSliceMut};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use nix::errno::Errno;
use nix::libc;
use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, MultiHeaders, recvmmsg, sendmmsg, setsockopt, sockopt,
};
use nix::sys::time::TimeSpec;
use rustix::net::{RecvAncillaryBuffer, RecvFlags};
use socketcan::{CanSocket, Socket, SocketOptions};

use super::frame::{RawFdFrame, RawFrame};

/// Bytes of a CAN FD frame, `struct canfd_frame` of `linux/can.h`.
const FD_BYTES: usize = size_of::<RawFdFrame>();
/// Messages per system call.
pub const BATCH: usize = 64;
/// Room for messages that wait, as root and as anybody else. The kernel doubles the figure, and a message takes less than a kilobyte of it.
const BUFFER_AS_ROOT: usize = 32 << 20;
const BUFFER: usize = 8 << 20;
/// `SO_MEMINFO` of `asm-generic/socket.h`, and the place of the dropped messages in it (`linux/sock_diag.h`).
const SO_MEMINFO: i32 = 55;
const MEMINFO_DROPS: usize = 8;

/// What a socket is for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Options {
    /// Whether it receives error frames, of all classes.
    pub errors: bool,
    /// Whether it receives CAN FD frames.
    pub fd: bool,
    /// Whether it receives what it has sent itself: once that was on the bus, if the driver can tell.
    pub own: bool,
    /// Whether messages have stamps.
    pub stamps: bool,
}

/// A received message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message {
    pub(crate) buffer: [u8; FD_BYTES],
    pub(crate) len: usize,
    /// It was sent through this socket.
    pub is_own: bool,
    /// How many messages this socket had dropped before this one, if the kernel says so. The count starts again after 2^32.
    pub dropped: Option<u32>,
    /// When the driver passed it to the kernel, since 1970.
    pub software: Option<Duration>,
    /// The controller's stamp, by its own clock.
    pub hardware: Option<Duration>,
}

impl Message {
    /// One with these bytes, of which there are 72 at most, and nothing said about it.
    pub fn new(bytes: &[u8]) -> Self {
        let len = bytes.len().min(FD_BYTES);
        let mut buffer = [0; FD_BYTES];
        buffer[..len].copy_from_slice(&bytes[..len]);
        Self { buffer, len, is_own: false, dropped: None, software: None, hardware: None }
    }

    /// Its bytes: 16 for a classic frame, 72 for one of CAN FD.
    pub fn bytes(&self) -> &[u8] {
        &self.buffer[..self.len]
    }
}

/// A socket bound to an interface.
pub struct RawSocket {
    socket: CanSocket,
    /// It receives what it sends.
    own: bool,
    /// Something was sent, so what is received may be its own.
    has_sent: AtomicBool,
}

impl RawSocket {
    /// Opens an interface.
    pub fn open(interface: &str, options: Options) -> io::Result<Self> {
        let socket = CanSocket::open(interface)?;
        if options.errors {
            socket.set_error_filter_accept_all()?;
        } else {
            socket.set_error_filter_drop_all()?;
        }
        if options.fd {
            socket.set_socket_option_int(libc::SOL_CAN_RAW, libc::CAN_RAW_FD_FRAMES, 1)?;
        }
        socket.set_loopback(true)?;
        socket.set_recv_own_msgs(options.own)?;
        setsockopt(&socket, sockopt::RxqOvfl, &1)?;
        if options.stamps {
            socket.set_timestamping(
                libc::SOF_TIMESTAMPING_RX_SOFTWARE
                    | libc::SOF_TIMESTAMPING_SOFTWARE
                    | libc::SOF_TIMESTAMPING_RX_HARDWARE
                    | libc::SOF_TIMESTAMPING_RAW_HARDWARE,
            )?;
        }
        // As much as this user may have; otherwise what the system gives everyone.
        if setsockopt(&socket, sockopt::RcvBufForce, &BUFFER_AS_ROOT).is_err() {
            let _ = setsockopt(&socket, sockopt::RcvBuf, &BUFFER);
        }
        Ok(Self { socket, own: options.own, has_sent: AtomicBool::new(false) })
    }

    /// Adds what is there, up to a limit, without waiting.
    pub fn receive(&self, most: usize, messages: &mut Vec<Message>) -> io::Result<()> {
        if !self.own || !self.has_sent.load(Ordering::Relaxed) {
            return self.receive_batch(most, messages);
        }
        let first = messages.len();
        while messages.len() - first < most {
            let next = match self.next_is_own() {
                // After the others it comes again.
                Err(_) if messages.len() > first => None,
                next => next?,
            };
            let Some(is_own) = next else { break };
            let before = messages.len();
            self.receive_batch(1, messages)?;
            if let Some(message) = messages.get_mut(before) {
                message.is_own = is_own;
            }
        }
        Ok(())
    }

    /// Whether the next message was sent through this socket, if there is one: nix cuts the flag that says so from the batch's.
    fn next_is_own(&self) -> io::Result<Option<bool>> {
        let flags = RecvFlags::PEEK | RecvFlags::DONTWAIT;
        let mut control = RecvAncillaryBuffer::default();
        match rustix::net::recvmsg(&self.socket, &mut [], &mut control, flags) {
            Ok(message) => Ok(Some(message.flags.bits() & libc::MSG_CONFIRM as u32 != 0)),
            Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    fn receive_batch(&self, most: usize, messages: &mut Vec<Message>) -> io::Result<()> {
        let most = most.min(BATCH);
        let space = nix::cmsg_space!(u32, [TimeSpec; 3]);
        let mut headers = MultiHeaders::<()>::preallocate(most, Some(space));
        let mut buffers = vec![[0; FD_BYTES]; most];
        let mut headings = Vec::with_capacity(most);
        let taken = {
            let mut slices: Vec<[IoSliceMut<'_>; 1]> =
                buffers.iter_mut().map(|buffer| [IoSliceMut::new(buffer)]).collect();
            let fd = self.socket.as_raw_fd();
            recvmmsg(fd, &mut headers, slices.iter_mut(), MsgFlags::MSG_DONTWAIT, None).map(|taken| {
                for message in taken {
                    let len = message.bytes.min(FD_BYTES);
                    headings.push((len, message.cmsgs().into_iter().flatten().collect::<Vec<_>>()));
                }
            })
        };
        messages.extend(buffers.into_iter().zip(headings).map(|(buffer, (len, controls))| {
            let mut message = Message::new(&buffer[..len]);
            for control in controls {
                match control {
                    ControlMessageOwned::RxqOvfl(count) => message.dropped = Some(count),
                    ControlMessageOwned::ScmTimestampsns(stamps) => {
                        message.software = stamp(stamps.system);
                        message.hardware = stamp(stamps.hw_raw);
                    }
                    _ => {}
                }
            }
            message
        }));
        match taken {
            Ok(()) | Err(Errno::EAGAIN | Errno::EINTR) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Sends without waiting. Returns how many were taken, at least one.
    pub fn send(&self, frames: &[RawFrame]) -> io::Result<usize> {
        self.send_messages(frames.iter().map(|frame| &frame[..]))
    }

    /// Sends a CAN FD frame without waiting. The socket must have been opened for CAN FD.
    pub fn send_fd(&self, frame: &RawFdFrame) -> io::Result<()> {
        self.send_messages(std::iter::once(&frame[..])).map(|_| ())
    }

    /// Sends frames of either kind, as bytes, without waiting. Returns how many were taken, at least one. For CAN FD frames the socket must have been
    /// opened for them.
    pub fn send_messages<'m>(&self, messages: impl Iterator<Item = &'m [u8]>) -> io::Result<usize> {
        let mut headers = MultiHeaders::<()>::preallocate(BATCH, None);
        let slices: Vec<[IoSlice<'_>; 1]> =
            messages.take(BATCH).map(|message| [IoSlice::new(message)]).collect();
        let taken = sendmmsg(
            self.socket.as_raw_fd(),
            &mut headers,
            slices.iter(),
            [None; BATCH],
            [],
            MsgFlags::MSG_DONTWAIT,
        );
        let taken = taken?.count();
        self.has_sent.store(true, Ordering::Relaxed);
        Ok(taken)
    }

    /// How many messages this socket has dropped so far, for lack of room.
    pub fn dropped(&self) -> io::Result<u32> {
        let mut figures = [0; 4 * (MEMINFO_DROPS + 1)];
        let len = self.socket.get_socket_option_bytes(libc::SOL_SOCKET, SO_MEMINFO, &mut figures)?;
        match figures[..len.min(figures.len())].as_chunks().0.get(MEMINFO_DROPS) {
            Some(drops) => Ok(u32::from_ne_bytes(*drops)),
            None => Err(io::ErrorKind::Unsupported.into()),
        }
    }

    /// Whether the controller stamps what it receives, as its driver says.
    pub fn has_hardware_stamps(&self) -> bool {
        self.socket.has_hw_timestamps()
    }
}

impl AsFd for RawSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// Zero stands for none.
fn stamp(time: TimeSpec) -> Option<Duration> {
    let nanoseconds =
        u32::try_from(time.tv_nsec()).ok().filter(|nanoseconds| *nanoseconds < 1_000_000_000)?;
    let duration = Duration::new(u64::try_from(time.tv_sec()).ok()?, nanoseconds);
    (!duration.is_zero()).then_some(duration)
}
