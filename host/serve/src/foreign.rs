//! What a stranger's first bytes are. Before its first valid message, a client is sent nothing and nothing it sends is skipped: a web page can
//! make a browser send a request with any body to any port, and behind its headers the body must not be taken for commands.

/// How many bytes are enough to recognise a protocol.
pub const ENOUGH: usize = 16;

/// The protocol that a connection begins with, if it is one that is met often at a wrong port.
pub fn protocol(first: &[u8]) -> Option<&'static str> {
    const HTTP: [&str; 10] = [
        "GET ",
        "POST ",
        "HEAD ",
        "PUT ",
        "DELETE ",
        "OPTIONS ",
        "CONNECT ",
        "TRACE ",
        "PATCH ",
        "PRI * HTTP/2",
    ];
    const MAIL: [&str; 4] = ["EHLO ", "HELO ", "MAIL FROM:", "RCPT TO:"];
    let begins = |with: &str| first.starts_with(with.as_bytes());
    if HTTP.iter().any(|with| begins(with)) {
        Some("HTTP, as a web browser does")
    } else if first.starts_with(b"SSH-") {
        Some("SSH")
    } else if MAIL.iter().any(|with| begins(with)) {
        Some("SMTP")
    } else if matches!(first, [0x16, 3, ..]) {
        Some("TLS")
    } else if matches!(first, [b'<', ..]) {
        Some("socketcand")
    } else {
        None
    }
}

/// Why a connection that began with these bytes was ended.
pub fn reason(first: &[u8]) -> String {
    match protocol(first) {
        Some(protocol) => format!("it speaks {protocol}"),
        None => "it does not begin with this protocol's greeting".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn protocols_are_recognised_by_their_first_bytes() {
        for (first, name) in [
            (&b"POST / HTTP/1.1"[..], Some("HTTP, as a web browser does")),
            (b"SSH-2.0-OpenSSH", Some("SSH")),
            (b"EHLO localhost", Some("SMTP")),
            (&[0x16, 3, 1, 2, 0], Some("TLS")),
            (b"< open can0 >", Some("socketcand")),
            (b"POSTAGE", None),
            (b"", None),
        ] {
            assert_eq!(protocol(first), name);
        }
    }
}
