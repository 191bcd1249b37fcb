//! Requests of browsers, and the heads of answers. A connection has one request.

use std::io::{self, Write};
use std::time::{Duration, Instant};

use crate::stream::{Stream, is_idle};

/// Longest head of a request.
const MOST_BYTES: usize = 16 * 1024;
/// More headers than a browser sends.
const MOST_HEADERS: usize = 64;
/// A request must be whole within this time.
const PATIENCE: Duration = Duration::from_secs(5);
/// What every answer has: nothing is kept, nothing is passed on, nobody frames or embeds it.
const COMMON: &str = "Cache-Control: no-store\r\nReferrer-Policy: no-referrer\r\nX-Content-Type-Options: nosniff\r\n\
                      Cross-Origin-Resource-Policy: same-origin\r\nCross-Origin-Opener-Policy: same-origin\r\n\
                      X-Frame-Options: DENY\r\nConnection: close\r\n";

/// A request's head.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Head {
    /// Such as `GET`.
    pub method: String,
    /// The target up to a question mark.
    pub path: String,
    query: String,
    headers: Vec<(String, String)>,
}

/// Why there is no request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BadHead {
    /// It is none of HTTP, or has headers twice that decide who gets in.
    Malformed,
    /// It is too long.
    TooLong,
    /// It did not come in time, or the connection ended.
    Gone,
}

impl Head {
    /// Reads it. Bytes after it are dropped: who asks has nothing more to say before the answer.
    pub fn read(stream: &mut dyn Stream) -> Result<Self, BadHead> {
        let deadline = Instant::now() + PATIENCE;
        let mut bytes = Vec::new();
        let mut piece = [0; 2048];
        loop {
            if let Some(head) = Self::parse(&bytes)? {
                return Ok(head);
            }
            if bytes.len() >= MOST_BYTES {
                return Err(BadHead::TooLong);
            }
            let left = deadline.checked_duration_since(Instant::now()).filter(|left| !left.is_zero());
            let left = left.ok_or(BadHead::Gone)?;
            stream.set_read_timeout(left).map_err(|_| BadHead::Gone)?;
            match stream.read(&mut piece) {
                Ok(len @ 1..) => bytes.extend_from_slice(&piece[..len]),
                Err(error) if is_idle(&error) => {}
                _ => return Err(BadHead::Gone),
            }
        }
    }

    fn parse(bytes: &[u8]) -> Result<Option<Self>, BadHead> {
        let mut headers = [httparse::EMPTY_HEADER; MOST_HEADERS];
        let mut request = httparse::Request::new(&mut headers);
        match request.parse(bytes) {
            Ok(httparse::Status::Complete(_)) => {}
            Ok(httparse::Status::Partial) => return Ok(None),
            Err(httparse::Error::TooManyHeaders) => return Err(BadHead::TooLong),
            Err(_) => return Err(BadHead::Malformed),
        }
        let target = request.path.unwrap_or_default();
        let (path, query) = target.split_once('?').unwrap_or((target, ""));
        let text = |header: &httparse::Header<'_>| {
            let value = str::from_utf8(header.value).ok()?;
            Some((header.name.to_ascii_lowercase(), value.trim().to_owned()))
        };
        let headers: Option<Vec<_>> = request.headers.iter().map(text).collect();
        let head = Self {
            method: request.method.unwrap_or_default().to_owned(),
            path: path.to_owned(),
            query: query.to_owned(),
            headers: headers.ok_or(BadHead::Malformed)?,
        };
        // Whichever of two counted, somebody could take the other one for it.
        let is_twice = |name: &str| head.headers.iter().filter(|(known, _)| known == name).count() > 1;
        if ["host", "origin", "sec-websocket-key"].into_iter().any(is_twice) {
            return Err(BadHead::Malformed);
        }
        Ok(Some(head))
    }

    /// A header's value; its name in lower case.
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(known, _)| known == name).map(|(_, value)| value.as_str())
    }

    /// Whether a header has this among values separated by commas.
    pub fn has(&self, name: &str, value: &str) -> bool {
        self.header(name)
            .is_some_and(|list| list.split(',').any(|one| one.trim().eq_ignore_ascii_case(value)))
    }

    /// A parameter of the query, as it is written: this server's need no escapes.
    pub fn parameter(&self, name: &str) -> Option<&str> {
        self.query
            .split('&')
            .find_map(|part| part.split_once('=').filter(|(known, _)| *known == name))
            .map(|(_, value)| value)
    }
}

/// Writes an answer's head. `more` are further headers, each with its line's end.
pub fn answer(stream: &mut impl Write, status: &str, kind: &str, length: u64, more: &str) -> io::Result<()> {
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n{COMMON}{more}\r\n"
    );
    stream.write_all(head.as_bytes())
}

/// Answers with a sentence.
pub fn sentence(stream: &mut impl Write, status: &str, text: &str) -> io::Result<()> {
    let text = format!("{text}\n");
    answer(
        stream,
        status,
        "text/plain; charset=utf-8",
        text.len() as u64,
        "Content-Security-Policy: default-src 'none'\r\n",
    )?;
    stream.write_all(text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_browsers_request_is_read() {
        let bytes = b"GET /live?token=ab&after=12 HTTP/1.1\r\nHost: 127.0.0.1:1\r\nConnection: keep-alive, Upgrade\r\n\r\n";
        for len in 0..bytes.len() {
            assert_eq!(Head::parse(&bytes[..len]), Ok(None), "{len}");
        }
        let head = Head::parse(bytes).unwrap().unwrap();
        assert_eq!((head.method.as_str(), head.path.as_str()), ("GET", "/live"));
        assert_eq!(
            (head.parameter("token"), head.parameter("after"), head.parameter("x")),
            (Some("ab"), Some("12"), None)
        );
        assert_eq!(head.header("host"), Some("127.0.0.1:1"));
        assert!(head.has("connection", "upgrade") && !head.has("connection", "grade"));
    }

    #[test]
    fn what_could_be_read_in_two_ways_is_refused() {
        for bytes in [
            &b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n"[..],
            b"GET / HTTP/1.1\r\nHost: a\r\nOrigin: http://a\r\nORIGIN: http://b\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost: \xFF\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost : a\r\n\r\n",
            b"\x16\x03\x01\x02\x00",
        ] {
            assert_eq!(Head::parse(bytes), Err(BadHead::Malformed), "{}", String::from_utf8_lossy(bytes));
        }
        let many = format!("GET / HTTP/1.1\r\n{}\r\n", "A: b\r\n".repeat(MOST_HEADERS + 1));
        assert_eq!(Head::parse(many.as_bytes()), Err(BadHead::TooLong));
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_request_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let _ = Head::parse(&bytes);
        }
    }
}
