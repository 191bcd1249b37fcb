//! The ways into a server, where they are, and what clients may do who come by them.

use std::net::{Ipv4Addr, SocketAddr};
#[cfg(unix)]
use std::path::{Path, PathBuf};

use cantap_address::server::role;
use cantap_serve::{Role, cannelloni};

use crate::usage_error::usage;

/// A way in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Door {
    Unix,
    Tcp,
    Socketcand,
    Gvret,
    Cannelloni,
    Web,
    /// The page for browsers that show certificates: `web`, too.
    Https,
    Stdio,
}

impl Door {
    /// Whoever comes this way is not asked who it is; at the page, whoever has its address.
    const fn is_open_to_all(self) -> bool {
        matches!(self, Self::Socketcand | Self::Gvret | Self::Cannelloni | Self::Web)
    }
}

/// What `--allow` allows, everywhere or at one door.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Allowed {
    door: Option<Door>,
    role: Role,
}

pub fn allowed(text: &str) -> Result<Allowed, String> {
    let Some((door, text)) = text.split_once(':') else {
        return Ok(Allowed { door: None, role: role(text)? });
    };
    let door = match door {
        "unix" => Door::Unix,
        "tcp" => Door::Tcp,
        "socketcand" => Door::Socketcand,
        "gvret" => Door::Gvret,
        "cannelloni" => Door::Cannelloni,
        "web" => Door::Web,
        _ => return Err("a listener is unix, tcp, socketcand, gvret, cannelloni or web".to_owned()),
    };
    Ok(Allowed { door: Some(door), role: role(text)? })
}

/// The maximum role at a door; the last one given applies. Whoever reaches the port of a foreign protocol is not asked who it is, so what is
/// allowed everywhere is not allowed there.
pub fn allow(all: &[Allowed], door: Door) -> Role {
    let of = |door: Option<Door>| {
        all.iter().rev().find(|allowed| allowed.door == door).map(|allowed| allowed.role)
    };
    let everywhere = if door.is_open_to_all() { None } else { of(None) };
    let door = if door == Door::Https { Door::Web } else { door };
    of(Some(door)).or(everywhere).unwrap_or(Role::Listen)
}

/// An address, a port of this computer, or both.
pub fn address(text: &str, port: u16) -> anyhow::Result<SocketAddr> {
    let not_one = || usage(format!("'{text}' is not an address to listen at; write it as 127.0.0.1:{port}"));
    let address: SocketAddr = match text.parse() {
        Ok(address) => address,
        Err(_) => match (text.parse(), text.parse()) {
            (Ok(ip), _) => SocketAddr::new(ip, port),
            (_, Ok(port)) => SocketAddr::from((Ipv4Addr::LOCALHOST, port)),
            _ => return Err(not_one()),
        },
    };
    if address.ip().is_unspecified() {
        return Err(usage(format!(
            "at {address} everybody on every network could use the device; name one address of this computer"
        )));
    }
    Ok(address)
}

/// Where a tunnel begins and ends, and whose it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TunnelArg {
    /// The channel's number.
    pub number: u8,
    /// The address here.
    pub local: SocketAddr,
    /// The peer's.
    pub peer: SocketAddr,
}

/// Parses `[CHANNEL:]ADDR:PORT,PEER:PORT`; an address may be left out for a port of this computer.
pub fn tunnel(text: &str) -> Result<TunnelArg, String> {
    const FORM: &str = "write it as CHANNEL:ADDR:PORT,PEER:PORT, as 1:127.0.0.1:20000,127.0.0.1:20001";
    let (local, peer) = text.split_once(',').ok_or(FORM)?;
    let (number, local) = channel_before(local, FORM)?;
    let (local, peer) = (cannelloni_address(local)?, cannelloni_address(peer)?);
    if local.is_ipv4() != peer.is_ipv4() {
        return Err("both addresses must be of one kind, IPv4 or IPv6".to_owned());
    }
    if local == peer {
        return Err("a tunnel to itself would send every frame again; name the peer's port".to_owned());
    }
    Ok(TunnelArg { number, local, peer })
}

/// A channel whose tunnels over TCP begin at an address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TcpTunnelArg {
    /// The channel's number.
    pub number: u8,
    /// Where clients connect.
    pub address: SocketAddr,
}

/// Parses `[CHANNEL:]ADDR:PORT`; an address or a port may be left out.
pub fn tcp_tunnel(text: &str) -> Result<TcpTunnelArg, String> {
    let (number, address) = channel_before(text, "write it as CHANNEL:ADDR:PORT, as 1:127.0.0.1:20000")?;
    Ok(TcpTunnelArg { number, address: cannelloni_address(address)? })
}

/// A channel's number, 1 if there is none, and what stands behind it.
fn channel_before<'t>(text: &'t str, form: &str) -> Result<(u8, &'t str), String> {
    match text.split_once(':') {
        Some((number, rest)) if !number.is_empty() && number.bytes().all(|digit| digit.is_ascii_digit()) => {
            match number.parse().map_err(|_| form)? {
                0 => Err("channels are numbered from 1".to_owned()),
                number => Ok((number, rest)),
            }
        }
        _ => Ok((1, text)),
    }
}

fn cannelloni_address(text: &str) -> Result<SocketAddr, String> {
    address(text, cannelloni::PORT).map_err(|error| error.to_string())
}

/// An address that can only be reached from this computer.
pub fn loopback(text: &str, port: u16) -> anyhow::Result<SocketAddr> {
    let address = address(text, port)?;
    if !address.ip().is_loopback() {
        return Err(usage(format!(
            "at {address} everybody on the network could use the device; let clients come by ssh (-d ssh://HOST/…), or \
             give --tls and --clients (`cantap serve keygen` makes the keys)"
        )));
    }
    Ok(address)
}

/// The path for a further device.
#[cfg(unix)]
pub fn numbered(path: &Path, number: usize) -> PathBuf {
    if number == 0 {
        return path.to_owned();
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let suffix = path.extension().map_or_else(String::new, |suffix| format!(".{}", suffix.to_string_lossy()));
    path.with_file_name(format!("{stem}-{}{suffix}", number + 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_address::server::PORT;

    #[test]
    fn only_addresses_of_this_computer_are_listened_at() {
        let at = |text: &str| loopback(text, PORT).map(|address| address.to_string());
        assert_eq!(at("127.0.0.1").unwrap(), format!("127.0.0.1:{PORT}"));
        assert_eq!(at("5000").unwrap(), "127.0.0.1:5000");
        assert_eq!(at("[::1]:5000").unwrap(), "[::1]:5000");
        for wrong in ["0.0.0.0", "192.168.0.1:5000", "[::]:1", "car", ""] {
            assert!(loopback(wrong, PORT).is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_is_allowed_everywhere_is_not_allowed_to_foreign_protocols() {
        let roles = |texts: &[&str]| {
            let all: Vec<Allowed> = texts.iter().map(|text| allowed(text).unwrap()).collect();
            [Door::Unix, Door::Tcp, Door::Socketcand, Door::Gvret, Door::Cannelloni, Door::Web, Door::Stdio]
                .map(|door| allow(&all, door))
        };
        let (listen, send) = (Role::Listen, Role::Send);
        assert_eq!(roles(&[]), [listen; 7]);
        assert_eq!(roles(&["send"]), [send, send, listen, listen, listen, listen, send]);
        assert_eq!(roles(&["socketcand:send"]), [listen, listen, send, listen, listen, listen, listen]);
        assert_eq!(
            roles(&["gvret:send", "cannelloni:send"]),
            [listen, listen, listen, send, send, listen, listen]
        );
        assert_eq!(roles(&["web:send"]), [listen, listen, listen, listen, listen, send, listen]);
        assert_eq!(
            roles(&["send", "tcp:configure"]),
            [send, Role::Configure, listen, listen, listen, listen, send]
        );
        for text in ["all", "udp:send", "unix:", ":send"] {
            assert!(allowed(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_tunnel_names_both_of_its_ends() {
        let parts = |text: &str| {
            tunnel(text)
                .map(|TunnelArg { number, local, peer }| (number, local.to_string(), peer.to_string()))
        };
        let (near, far) = ("127.0.0.1:20000".to_owned(), "127.0.0.1:20001".to_owned());
        assert_eq!(parts("127.0.0.1:20000,127.0.0.1:20001").unwrap(), (1, near.clone(), far.clone()));
        assert_eq!(parts("20000,20001").unwrap(), (1, near.clone(), far.clone()));
        assert_eq!(parts("2:20000,20001").unwrap(), (2, near, far));
        assert_eq!(parts("2:[::1]:5,[::1]:6").unwrap(), (2, "[::1]:5".to_owned(), "[::1]:6".to_owned()));
        assert_eq!(parts("[::1]:5,[::1]:6").unwrap().0, 1);
        for wrong in [
            "",
            "20000",
            "20000,",
            "0:20000,20001",
            "256:20000,20001",
            "x:20000,20001",
            "20000,20000",
            "0.0.0.0:1,127.0.0.1:2",
            "127.0.0.1:1,[::1]:2",
            "1:2:3,4",
            "20000,20001,20002",
        ] {
            assert!(tunnel(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_tunnel_over_tcp_names_a_channel_and_its_beginning() {
        let parts = |text: &str| tcp_tunnel(text).map(|arg| (arg.number, arg.address.to_string()));
        let usual = "127.0.0.1:20000".to_owned();
        assert_eq!(parts("127.0.0.1").unwrap(), (1, usual.clone()));
        assert_eq!(parts("20000").unwrap(), (1, usual.clone()));
        assert_eq!(parts("2:127.0.0.1:20000").unwrap(), (2, usual));
        assert_eq!(parts("2:[::1]:5").unwrap(), (2, "[::1]:5".to_owned()));
        for wrong in ["", "0:20000", "256:20000", "0.0.0.0:1", "x:20000", "20000,20001"] {
            assert!(tcp_tunnel(wrong).is_err(), "{wrong}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_further_device_has_a_number_in_its_path() {
        assert_eq!(numbered(Path::new("/run/cantap.sock"), 0), Path::new("/run/cantap.sock"));
        assert_eq!(numbered(Path::new("/run/cantap.sock"), 1), Path::new("/run/cantap-2.sock"));
        assert_eq!(numbered(Path::new("x"), 2), Path::new("x-3"));
    }
}
