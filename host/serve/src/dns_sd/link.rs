//! Sockets for multicast DNS on one link, and who is on it.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV6, UdpSocket};
use std::time::Duration;

use if_addrs::{IfAddr, Interface};
use socket2::{Domain, Protocol, Socket, Type};

use super::Network;
use super::message::Message;

const GROUP_V4: Ipv4Addr = Ipv4Addr::new(224, 0, 0, 251);
const GROUP_V6: Ipv6Addr = Ipv6Addr::new(0xFF02, 0, 0, 0, 0, 0, 0, 0xFB);
/// What no router has passed on (RFC 6762 §11).
const HOPS: u32 = 255;

/// An address of this computer, on a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Link {
    interface: Interface,
    index: u32,
}

impl Link {
    /// All of this computer.
    pub fn all() -> io::Result<Vec<Self>> {
        let all = if_addrs::get_if_addrs()?.into_iter();
        Ok(all.map(|interface| Self { index: interface.index.unwrap_or(0), interface }).collect())
    }

    /// That of an address.
    pub fn of(address: SocketAddr) -> io::Result<Self> {
        let zone = match address {
            SocketAddr::V6(address) => address.scope_id(),
            SocketAddr::V4(_) => 0,
        };
        let is_it = |link: &Self| link.ip() == address.ip() && (zone == 0 || link.index == zone);
        let none = || io::Error::new(io::ErrorKind::AddrNotAvailable, "no interface has this address");
        Self::all()?.into_iter().find(is_it).ok_or_else(none)
    }

    pub const fn ip(&self) -> IpAddr {
        self.interface.ip()
    }

    /// Whether an address is one of this link: what comes from elsewhere is neither answered nor believed (RFC 6762 §11).
    pub fn has(&self, address: IpAddr) -> bool {
        let same = |one: u128, other: u128, mask: u128| one & mask == other & mask;
        match (&self.interface.addr, address.to_canonical()) {
            (IfAddr::V4(own), IpAddr::V4(other)) => {
                let [own, other, mask] = [own.ip, other, own.netmask].map(|ip| u128::from(ip.to_bits()));
                same(own, other, mask)
            }
            (IfAddr::V6(own), IpAddr::V6(other)) => {
                other.is_unicast_link_local()
                    || same(own.ip.to_bits(), other.to_bits(), own.netmask.to_bits())
            }
            _ => false,
        }
    }

    /// Where everybody on the link listens.
    fn group(&self, port: u16) -> SocketAddr {
        match self.ip() {
            IpAddr::V4(_) => (GROUP_V4, port).into(),
            IpAddr::V6(_) => SocketAddrV6::new(GROUP_V6, port, 0, self.index).into(),
        }
    }

    /// A socket from which one question can be asked, whose answers come to it alone.
    pub fn asking(&self, network: Network) -> io::Result<Speaker> {
        let any: SocketAddr = match self.ip() {
            IpAddr::V4(ip) => (ip, 0).into(),
            IpAddr::V6(ip) => SocketAddrV6::new(ip, 0, 0, self.index).into(),
        };
        self.speaker(network, any, false)
    }

    /// A socket at the port of multicast DNS, which it shares with others of this computer.
    pub fn listening(&self, network: Network) -> io::Result<Speaker> {
        let port = network.port;
        // On Linux, so that nothing comes that was sent to this computer alone: from another link, or for another program at this port.
        let here = if cfg!(any(target_os = "linux", target_os = "android")) {
            self.group(port)
        } else if self.ip().is_ipv4() {
            (Ipv4Addr::UNSPECIFIED, port).into()
        } else {
            (Ipv6Addr::UNSPECIFIED, port).into()
        };
        self.speaker(network, here, true)
    }

    fn speaker(&self, network: Network, here: SocketAddr, is_shared: bool) -> io::Result<Speaker> {
        let socket = Socket::new(Domain::for_address(here), Type::DGRAM, Some(Protocol::UDP))?;
        if is_shared {
            socket.set_reuse_address(true)?;
            #[cfg(all(unix, not(any(target_os = "linux", target_os = "android"))))]
            socket.set_reuse_port(true)?;
        }
        if here.is_ipv6() {
            socket.set_only_v6(true)?;
        }
        socket.bind(&here.into())?;
        match self.ip() {
            IpAddr::V4(ip) => {
                socket.set_multicast_if_v4(&ip)?;
                socket.set_multicast_ttl_v4(HOPS)?;
                socket.set_multicast_loop_v4(true)?;
                if is_shared {
                    #[cfg(target_os = "linux")]
                    socket.set_multicast_all_v4(false)?;
                    socket.join_multicast_v4(&GROUP_V4, &ip)?;
                }
            }
            IpAddr::V6(_) => {
                socket.set_multicast_if_v6(self.index)?;
                socket.set_multicast_hops_v6(HOPS)?;
                socket.set_multicast_loop_v6(true)?;
                if is_shared {
                    socket.join_multicast_v6(&GROUP_V6, self.index)?;
                }
            }
        }
        let socket = UdpSocket::from(socket);
        socket.set_nonblocking(!is_shared)?;
        Ok(Speaker { link: self.clone(), socket, to: self.group(network.port) })
    }
}

/// Speaks on a link.
pub struct Speaker {
    pub link: Link,
    socket: UdpSocket,
    to: SocketAddr,
}

impl Speaker {
    /// To everybody. Nobody may be there.
    pub fn tell_all(&self, message: &Message) {
        let _ = self.socket.send_to(&message.bytes(), self.to);
    }

    pub fn tell(&self, peer: SocketAddr, message: &Message) {
        self.tell_bytes(peer, &message.bytes());
    }

    pub fn tell_bytes(&self, peer: SocketAddr, bytes: &[u8]) {
        let _ = self.socket.send_to(bytes, peer);
    }

    /// The next datagram, if it is one of this link's; `None` if it is not, or if none has come for a while (a socket that only asks does not
    /// wait).
    pub fn hear(&self, bytes: &mut [u8]) -> io::Result<Option<(usize, SocketAddr)>> {
        match self.socket.recv_from(bytes) {
            Ok((len, from)) => Ok(Some((len, from)).filter(|(_, from)| self.link.has(from.ip()))),
            Err(error) if cantap::device::is_idle(&error) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The same, waiting at most this long.
    pub fn hear_within(
        &self,
        bytes: &mut [u8],
        timeout: Duration,
    ) -> io::Result<Option<(usize, SocketAddr)>> {
        // Zero would be for ever.
        self.socket.set_read_timeout(Some(timeout.max(Duration::from_millis(1))))?;
        self.hear(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_addresses_of_the_link_s_network_are_on_it() {
        let link = |ip: &str, mask: &str| {
            let (ip, mask): (IpAddr, IpAddr) = (ip.parse().unwrap(), mask.parse().unwrap());
            let addr = match (ip, mask) {
                (IpAddr::V4(ip), IpAddr::V4(netmask)) => {
                    IfAddr::V4(if_addrs::Ifv4Addr { ip, netmask, prefixlen: 0, broadcast: None })
                }
                (IpAddr::V6(ip), IpAddr::V6(netmask)) => {
                    IfAddr::V6(if_addrs::Ifv6Addr { ip, netmask, prefixlen: 0, broadcast: None })
                }
                _ => unreachable!(),
            };
            let interface = Interface {
                name: "x".to_owned(),
                addr,
                index: Some(3),
                oper_status: if_addrs::IfOperStatus::Up,
                is_p2p: false,
                #[cfg(windows)]
                adapter_name: String::new(),
            };
            Link { interface, index: 3 }
        };
        let (four, six) = (link("192.0.2.7", "255.255.255.0"), link("2001:db8::7", "ffff:ffff:ffff:ffff::"));
        let has = |link: &Link, ip: &str| link.has(ip.parse().unwrap());
        assert!(has(&four, "192.0.2.200") && has(&four, "::ffff:192.0.2.9"));
        assert!(has(&six, "2001:db8::8") && has(&six, "fe80::1"));
        for other in ["192.0.3.1", "203.0.113.1", "127.0.0.1", "fe80::1"] {
            assert!(!has(&four, other), "{other}");
        }
        for other in ["2001:db8:1::8", "::1", "192.0.2.7"] {
            assert!(!has(&six, other), "{other}");
        }
    }
}
