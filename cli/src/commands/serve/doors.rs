//! The ways into a server, where they are, and what clients may do who come by them.

use std::net::{Ipv4Addr, SocketAddr};
#[cfg(unix)]
use std::path::{Path, PathBuf};

use cantap_address::server::role;
use cantap_serve::Role;

use crate::usage_error::usage;

/// A way in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Door {
    Unix,
    Tcp,
    Socketcand,
    Stdio,
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
        _ => return Err("a listener is unix, tcp or socketcand".to_owned()),
    };
    Ok(Allowed { door: Some(door), role: role(text)? })
}

/// The maximum role at a door; the last one given applies. Whoever reaches socketcand's port is not asked who it is, so what is allowed
/// everywhere is not allowed there.
pub fn allow(all: &[Allowed], door: Door) -> Role {
    let of = |door: Option<Door>| {
        all.iter().rev().find(|allowed| allowed.door == door).map(|allowed| allowed.role)
    };
    let everywhere = if door == Door::Socketcand { None } else { of(None) };
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
    fn what_is_allowed_everywhere_is_not_allowed_to_socketcand() {
        let roles = |texts: &[&str]| {
            let all: Vec<Allowed> = texts.iter().map(|text| allowed(text).unwrap()).collect();
            [Door::Unix, Door::Tcp, Door::Socketcand, Door::Stdio].map(|door| allow(&all, door))
        };
        let (listen, send) = (Role::Listen, Role::Send);
        assert_eq!(roles(&[]), [listen; 4]);
        assert_eq!(roles(&["send"]), [send, send, listen, send]);
        assert_eq!(roles(&["socketcand:send"]), [listen, listen, send, listen]);
        assert_eq!(roles(&["send", "tcp:configure"]), [send, Role::Configure, listen, send]);
        for text in ["all", "udp:send", "unix:", ":send"] {
            assert!(allowed(text).is_err(), "{text}");
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
