//! Where a server that shares a board is: `unix:PATH`, `tcp://HOST:PORT`, `tls://HOST:PORT`, `ssh://[USER@]HOST[/DEVICE]`.

use std::io::{self, ErrorKind};
#[cfg(any(unix, feature = "tls"))]
use std::path::PathBuf;
use std::process::Command;

use cantap::device::Link;
use cantap_serve::{Role, connect};

/// The default port of `cantap serve --tcp`.
pub const PORT: u16 = 29_537;

/// A server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Server {
    /// On this machine, for this user.
    #[cfg(unix)]
    Unix(PathBuf),
    /// At `HOST:PORT`.
    Tcp(String),
    /// At `HOST:PORT`, encrypted, with this client's keys, if the address names them.
    #[cfg(feature = "tls")]
    Tls(String, Option<PathBuf>),
    /// Started for this client on another computer.
    Ssh(Ssh),
}

/// A server that is started through ssh.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ssh {
    /// As ssh takes it, including the user if given.
    host: String,
    /// If `None`, ssh's own.
    port: Option<u16>,
    /// If `None`, the board that is connected there.
    device: Option<String>,
    /// What this client may do.
    allow: Role,
}

/// Why a server cannot be used. Each message says what to do next.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServerError {
    /// Nobody listens there.
    #[error("'{server}': there is no server; start one with `cantap serve` ({source})")]
    Absent {
        /// As addressed.
        server: String,
        /// The system's error.
        source: io::Error,
    },
    /// It belongs to another user.
    #[error("'{server}': it belongs to another user of this computer, who alone can use it ({source})")]
    NotYours {
        /// As addressed.
        server: String,
        /// The system's error.
        source: io::Error,
    },
    /// The connection failed.
    #[error("'{server}': it cannot be reached ({source})")]
    Unreachable {
        /// As addressed.
        server: String,
        /// The system's error.
        source: io::Error,
    },
    /// The program started there through ssh does not answer.
    #[error(
        "'{host}': no server there answers ({source}); try `{program} {host} cantap serve --stdio` by hand"
    )]
    Mute {
        /// The other computer.
        host: String,
        /// ssh, or the program named by `CANTAP_SSH`.
        program: String,
        /// The system's error.
        source: io::Error,
    },
    /// ssh could not be started.
    #[error("'{program}' does not start ({source}); install it, or name another in CANTAP_SSH")]
    NoSsh {
        /// ssh, or the program named by `CANTAP_SSH`.
        program: String,
        /// The system's error.
        source: io::Error,
    },
    /// An encrypted connection needs keys.
    #[cfg(feature = "tls")]
    #[error(
        "no keys are given: name them in CANTAP_KEYS as FOLDER/NAME, or after the address as ?keys=FOLDER/NAME"
    )]
    NoKeys,
    /// These cannot be the names of keys.
    #[cfg(feature = "tls")]
    #[error("'{}' names no keys; write FOLDER/NAME, as for FOLDER/NAME.pem", .0.display())]
    BadKeys(PathBuf),
    /// The encrypted connection could not be established.
    #[cfg(feature = "tls")]
    #[error(
        "'{server}' lets nobody in with these keys, or is not there; they and the server's must be from the same authority"
    )]
    Tls {
        /// As addressed.
        server: String,
        /// The cause.
        source: cantap_serve::tls::TlsError,
    },
}

/// The schemes of server addresses.
const SCHEMES: [&str; 4] = ["unix:", "tcp:", "tls:", "ssh:"];

impl Server {
    /// Whether a text is meant for a server.
    pub fn is_meant(text: &str) -> bool {
        SCHEMES.iter().any(|scheme| text.starts_with(scheme))
    }

    /// Parses such a text. The error says what would be right.
    pub fn parse(text: &str) -> Result<Self, String> {
        if let Some(path) = text.strip_prefix("unix:") {
            #[cfg(unix)]
            return Ok(Self::Unix(match path {
                "" => connect::default_socket(),
                path => PathBuf::from(path),
            }));
            #[cfg(not(unix))]
            return Err(format!("this system has no UNIX sockets for '{path}'; use tcp://127.0.0.1"));
        }
        if let Some(place) = text.strip_prefix("tcp://").filter(|place| !place.is_empty()) {
            return with_port(place).map(Self::Tcp);
        }
        #[cfg(feature = "tls")]
        if let Some(place) = text.strip_prefix("tls://").filter(|place| !place.is_empty()) {
            let (place, keys) = match place.split_once("?keys=") {
                Some((place, keys)) => (place, Some(PathBuf::from(keys))),
                None => (place, None),
            };
            return with_port(place).map(|place| Self::Tls(place, keys));
        }
        #[cfg(not(feature = "tls"))]
        if text.starts_with("tls:") {
            return Err(
                "this was built without TLS, its feature `tls`; use ssh://, or build it with that".to_owned()
            );
        }
        match text.strip_prefix("ssh://") {
            Some(place) if !place.is_empty() => Ssh::parse(place).map(Self::Ssh),
            _ => Err("write it as unix:PATH, tcp://HOST:PORT, tls://HOST:PORT or ssh://[USER@]HOST[/DEVICE]"
                .to_owned()),
        }
    }

    /// Connects to it.
    pub fn link(&self) -> Result<Link, ServerError> {
        let (server, linked) = match self {
            #[cfg(unix)]
            Self::Unix(path) => (path.display().to_string(), connect::unix(path)),
            Self::Tcp(address) => (address.clone(), connect::tcp(address)),
            #[cfg(feature = "tls")]
            Self::Tls(address, keys) => {
                let linked = cantap_serve::tls::connect(address, &files(keys.as_deref())?);
                return linked.map_err(|source| ServerError::Tls { server: address.clone(), source });
            }
            Self::Ssh(ssh) => {
                let mut command = ssh.command();
                let program = command.get_program().to_string_lossy().into_owned();
                return connect::program(&mut command).map_err(|source| match source.kind() {
                    ErrorKind::TimedOut => ServerError::Mute { host: ssh.host.clone(), program, source },
                    _ => ServerError::NoSsh { program, source },
                });
            }
        };
        linked.map_err(|source| match source.kind() {
            ErrorKind::NotFound | ErrorKind::ConnectionRefused => ServerError::Absent { server, source },
            ErrorKind::PermissionDenied => ServerError::NotYours { server, source },
            _ => ServerError::Unreachable { server, source },
        })
    }
}

/// This client's keys: those that the address names, else those of `CANTAP_KEYS`.
#[cfg(feature = "tls")]
fn files(keys: Option<&std::path::Path>) -> Result<cantap_serve::tls::Files, ServerError> {
    let of_environment =
        || std::env::var_os("CANTAP_KEYS").filter(|keys| !keys.is_empty()).map(PathBuf::from);
    let keys = keys.map(PathBuf::from).or_else(of_environment).ok_or(ServerError::NoKeys)?;
    match (keys.parent(), keys.file_name().and_then(|name| name.to_str())) {
        (Some(folder), Some(name)) => Ok(cantap_serve::tls::Keys::files(folder, name)),
        _ => Err(ServerError::BadKeys(keys)),
    }
}

/// Adds the default port if there is none.
fn with_port(place: &str) -> Result<String, String> {
    let has_port = |rest: &str| rest.rsplit_once(':').is_some_and(|(_, port)| port.parse::<u16>().is_ok());
    let host_only = match place.strip_prefix('[') {
        Some(rest) => match rest.split_once(']') {
            Some((_, "")) => true,
            Some((_, rest)) if has_port(rest) => false,
            _ => return Err(format!("'{place}' is not an address; write it as [::1]:{PORT}")),
        },
        None if place.matches(':').count() > 1 => {
            return Err(format!(
                "'{place}' is not an address; an IPv6 address needs brackets, as [::1]:{PORT}"
            ));
        }
        None if place.contains(':') && !has_port(place) => {
            return Err(format!("'{place}' has no port number behind its colon; write it as HOST:{PORT}"));
        }
        None => !place.contains(':'),
    };
    Ok(if host_only { format!("{place}:{PORT}") } else { place.to_owned() })
}

impl Ssh {
    fn parse(place: &str) -> Result<Self, String> {
        let (place, allow) = match place.rsplit_once("?allow=") {
            Some((place, allow)) => (place, role(allow)?),
            // Nobody else uses the board meanwhile.
            None => (place, Role::Configure),
        };
        let (host, device) = match place.split_once('/') {
            Some((host, "")) => (host, None),
            // A port of that computer, whether or not its first slash was doubled.
            Some((host, device)) if device.starts_with("dev/") => (host, Some(format!("/{device}"))),
            Some((host, device)) => (host, Some(device.to_owned())),
            None => (place, None),
        };
        let (host, port) = ssh_port(host)?;
        let name = host.rsplit_once('@').map_or(host.as_str(), |(_, name)| name);
        // ssh would take anything that begins with a dash as an option.
        if name.is_empty() || name.starts_with('-') || host.starts_with(['-', '@']) {
            return Err(format!(
                "'{host}' is not the name of a computer; write it as ssh://[USER@]HOST[:PORT][/DEVICE]"
            ));
        }
        Ok(Self { host, port, device, allow })
    }

    /// ssh, or the program named by `CANTAP_SSH`.
    fn command(&self) -> Command {
        let program = std::env::var_os("CANTAP_SSH").unwrap_or_else(|| "ssh".into());
        let mut command = Command::new(program);
        // ssh is kept out of the terminal's foreground, so that Ctrl-C does not end it before the capture; it therefore cannot ask
        // for anything.
        command.args(["-T", "-oBatchMode=yes"]);
        if let Some(port) = self.port {
            command.arg(format!("-p{port}"));
        }
        command.args(["--", &self.host]);
        command.args(["cantap", "serve", "--stdio", "--allow", self.allow.name()]);
        if let Some(device) = &self.device {
            command.args(["-d", &quoted(device)]);
        }
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        command
    }
}

/// Takes the port off `[USER@]HOST[:PORT]`, where an IPv6 address with a port is in brackets.
fn ssh_port(place: &str) -> Result<(String, Option<u16>), String> {
    let bad = || {
        format!(
            "'{place}' has no port number behind its colon; write it as ssh://[USER@]HOST[:PORT][/DEVICE]"
        )
    };
    let (user, name) =
        place.rsplit_once('@').map_or(("", place), |(user, name)| (&place[..=user.len()], name));
    let (name, port) = match name.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((name, "")) => (name, None),
        Some((name, rest)) => (name, Some(rest.strip_prefix(':').ok_or_else(bad)?)),
        // Without brackets, several colons are an address.
        None if name.matches(':').count() > 1 => (name, None),
        None => name.split_once(':').map_or((name, None), |(name, port)| (name, Some(port))),
    };
    let port = port.map(|port| port.parse().map_err(|_| bad())).transpose()?;
    Ok((format!("{user}{name}"), port))
}

/// Quotes text for the other computer's shell, to which ssh passes everything.
fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', r"'\''"))
}

/// Parses a role as typed.
pub fn role(text: &str) -> Result<Role, String> {
    let found = Role::ALL.into_iter().find(|role| role.name() == text);
    found.ok_or_else(|| "clients may listen, configure or send".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_servers_name_a_socket_a_port_or_a_computer() {
        let parse = |text: &str| Server::parse(text);
        assert_eq!(parse("tcp://car"), Ok(Server::Tcp(format!("car:{PORT}"))));
        assert_eq!(parse("tcp://car:5"), Ok(Server::Tcp("car:5".to_owned())));
        assert_eq!(parse("tcp://[::1]"), Ok(Server::Tcp(format!("[::1]:{PORT}"))));
        assert_eq!(parse("tcp://[::1]:5"), Ok(Server::Tcp("[::1]:5".to_owned())));
        #[cfg(unix)]
        assert_eq!(parse("unix:/run/a"), Ok(Server::Unix("/run/a".into())));
        #[cfg(feature = "tls")]
        assert_eq!(parse("tls://car?keys=k/me"), Ok(Server::Tls(format!("car:{PORT}"), Some("k/me".into()))));
        #[cfg(not(feature = "tls"))]
        assert!(parse("tls://car").unwrap_err().contains("without TLS"));
        for wrong in [
            "tls:car",
            "tls://",
            "tcp:car",
            "tcp://",
            "tcp://::1",
            "tcp://car:x",
            "ssh:car",
            "ssh://",
            "ssh://-oProxyCommand=x",
        ] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }

    /// The other computer's shell gets it as one word, whatever it contains.
    #[test]
    fn ssh_is_given_the_device_as_one_word_and_no_option() {
        let command = |text: &str| {
            let Ok(Server::Ssh(ssh)) = Server::parse(text) else { panic!("{text}") };
            ssh.command().get_args().skip(3).map(|arg| arg.to_string_lossy().into_owned()).collect::<Vec<_>>()
        };
        let start = |host: &str, allow: &str| {
            [host, "cantap", "serve", "--stdio", "--allow", allow].map(str::to_owned).to_vec()
        };
        assert_eq!(command("ssh://me@car"), start("me@car", "configure"));
        for (text, port, host) in [
            ("ssh://car:2222/x", "-p2222", "car"),
            ("ssh://me@car:2222", "-p2222", "me@car"),
            ("ssh://me@[::1]:2222/x", "-p2222", "me@::1"),
        ] {
            let Ok(Server::Ssh(ssh)) = Server::parse(text) else { panic!("{text}") };
            let arguments: Vec<_> =
                ssh.command().get_args().map(|arg| arg.to_string_lossy().into_owned()).collect();
            assert_eq!(arguments[2..5], [port, "--", host], "{text}");
        }
        assert_eq!(command("ssh://fe80::1/x")[0], "fe80::1");
        for device in ["ssh://car/dev/ttyACM0", "ssh://car//dev/ttyACM0"] {
            assert_eq!(command(device)[6..], ["-d", "'/dev/ttyACM0'"]);
        }
        assert_eq!(command("ssh://car/virtual:car?allow=send")[..6], start("car", "send"));
        assert_eq!(command("ssh://car/x'; reboot '")[7], r"'x'\''; reboot '\'''");
        for wrong in [
            "ssh://-l/x",
            "ssh://a@-l",
            "ssh://@b",
            "ssh:///x",
            "ssh://a?allow=all",
            "ssh://car:x",
            "ssh://car:",
            "ssh://car:70000/x",
            "ssh://[::1]x",
            "ssh://[-oX]:22",
            "ssh://:22/x",
        ] {
            assert!(Server::parse(wrong).is_err(), "{wrong}");
        }
    }
}
