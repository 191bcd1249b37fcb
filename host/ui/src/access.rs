//! Who gets in: whoever has the token, at an address of this machine, from this server's own page.

use std::net::SocketAddr;

use subtle::ConstantTimeEq as _;

/// Random bytes in a token: nobody guesses 128 bits.
const TOKEN_BYTES: usize = 16;

/// What a browser shows to be let in. It stands in the address that the user opens, and nowhere else: it is compared in constant time, and
/// is neither logged nor passed on.
#[derive(Clone)]
pub struct Token(String);

impl Token {
    /// A new one from the system's random numbers.
    pub fn new() -> Result<Self, getrandom::Error> {
        let mut bytes = [0; TOKEN_BYTES];
        getrandom::fill(&mut bytes)?;
        Ok(Self(format!("{:032x}", u128::from_be_bytes(bytes))))
    }

    /// Its text, for the address that is given to the user.
    pub fn text(&self) -> &str {
        &self.0
    }

    /// Whether a text is this token.
    pub fn is(&self, text: &str) -> bool {
        self.0.as_bytes().ct_eq(text.as_bytes()).into()
    }
}

/// Why a request is not answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// It names another host: a name that somebody lets lead to this machine.
    Host,
    /// A page of another origin asks.
    Origin,
    /// It has no token, or another one.
    Token,
}

impl Refusal {
    /// The status of the answer.
    pub const fn status(self) -> &'static str {
        match self {
            Self::Host => "421 Misdirected Request",
            Self::Origin | Self::Token => "403 Forbidden",
        }
    }

    /// The same for whoever runs the server.
    pub const fn reason(self) -> &'static str {
        match self {
            Self::Host => "it names another host than this server",
            Self::Origin => "a page of somebody else asks",
            Self::Token => "it does not have the token",
        }
    }

    /// What the answer says.
    pub const fn text(self) -> &'static str {
        match self {
            Self::Host => "This server answers at the address that it printed, and at no other name.",
            Self::Origin => "Only cantap's own page may ask this server.",
            Self::Token => {
                "The address lacks its token, or has that of an earlier run. Open the address that the server printed."
            }
        }
    }
}

/// The hosts by which this server may be named: by its address, and as `localhost`.
pub fn is_own_host(host: &str, address: SocketAddr) -> bool {
    let port = address.port();
    host == address.to_string() || host.eq_ignore_ascii_case(&format!("localhost:{port}"))
}

/// Where requests come in.
pub struct Door<'a> {
    /// The scheme of its address: `http` or `https`.
    pub scheme: &'static str,
    /// Whether a host, with its port, is this server.
    pub is_own_host: &'a dyn Fn(&str) -> bool,
    /// What must be shown; none where a certificate has been.
    pub token: Option<&'a Token>,
}

/// Checks a request: its host, its origin if it has one, and its token. `of_page`: an origin is required, as browsers send it with a
/// WebSocket.
pub fn check(
    host: Option<&str>,
    origin: Option<&str>,
    token: Option<&str>,
    of_page: bool,
    door: &Door<'_>,
) -> Result<(), Refusal> {
    let host = host.filter(|host| (door.is_own_host)(host)).ok_or(Refusal::Host)?;
    match origin {
        Some(origin) => {
            let of = origin.strip_prefix(door.scheme).and_then(|rest| rest.strip_prefix("://"));
            if !of.is_some_and(|of| of.eq_ignore_ascii_case(host)) {
                return Err(Refusal::Origin);
            }
        }
        None if of_page => return Err(Refusal::Origin),
        None => {}
    }
    let is_known = door.token.is_none_or(|own| token.is_some_and(|token| own.is(token)));
    if is_known { Ok(()) } else { Err(Refusal::Token) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_own_page_with_the_token_gets_in() {
        let token = Token("0123456789abcdef0123456789abcdef".to_owned());
        let address: SocketAddr = "127.0.0.1:4711".parse().unwrap();
        let door =
            Door { scheme: "http", is_own_host: &|host| is_own_host(host, address), token: Some(&token) };
        let ask = |host, origin, given, of_page| check(host, origin, given, of_page, &door);
        let own = Some("127.0.0.1:4711");
        let given = Some(token.text());
        assert_eq!(ask(own, None, given, false), Ok(()));
        assert_eq!(ask(own, Some("http://127.0.0.1:4711"), given, true), Ok(()));
        assert_eq!(ask(Some("localhost:4711"), Some("http://localhost:4711"), given, true), Ok(()));
        // A rebound name, another port, none.
        for host in [
            "evil.example:4711",
            "127.0.0.1",
            "127.0.0.1:80",
            "127.0.0.1:4711.evil.example",
            "",
            "[::1]:4711",
        ] {
            assert_eq!(ask(Some(host), None, given, false), Err(Refusal::Host), "{host}");
        }
        assert_eq!(ask(None, None, given, false), Err(Refusal::Host));
        // A page of somebody else; one of this machine under its other name; a file; none at a WebSocket.
        for origin in [
            "http://evil.example",
            "https://127.0.0.1:4711",
            "http://localhost:4711",
            "http://127.0.0.1:4712",
            "http://127.0.0.1:4711.evil.example",
            "null",
            "",
        ] {
            assert_eq!(ask(own, Some(origin), given, true), Err(Refusal::Origin), "{origin}");
        }
        assert_eq!(ask(own, None, given, true), Err(Refusal::Origin));
        for other in [
            Some(""),
            None,
            Some("0123456789abcdef0123456789abcdee"),
            Some("0123"),
            Some("0123456789ABCDEF0123456789ABCDEF"),
        ] {
            assert_eq!(ask(own, None, other, false), Err(Refusal::Token), "{other:?}");
        }
    }

    /// A certificate has been shown, so there is no token; whose page asks matters all the more, because browsers show it for every page.
    #[test]
    fn over_tls_only_the_own_page_gets_in() {
        let door = Door { scheme: "https", is_own_host: &|host| host == "vehicle:4711", token: None };
        let ask = |host, origin, of_page| check(Some(host), origin, None, of_page, &door);
        assert_eq!(ask("vehicle:4711", None, false), Ok(()));
        assert_eq!(ask("vehicle:4711", Some("https://vehicle:4711"), true), Ok(()));
        assert_eq!(ask("evil.example:4711", None, false), Err(Refusal::Host));
        assert_eq!(ask("vehicle:4711", None, true), Err(Refusal::Origin));
        for origin in [
            "http://vehicle:4711",
            "https://evil.example",
            "https://vehicle",
            "httpsvehicle:4711",
            "null",
            "",
        ] {
            assert_eq!(ask("vehicle:4711", Some(origin), true), Err(Refusal::Origin), "{origin}");
        }
    }

    #[test]
    fn every_run_has_another_token() {
        let tokens: Vec<_> = (0..100).map(|_| Token::new().unwrap().0).collect();
        let different: std::collections::BTreeSet<_> = tokens.iter().collect();
        assert_eq!((different.len(), tokens[0].len()), (100, 32));
    }
}
