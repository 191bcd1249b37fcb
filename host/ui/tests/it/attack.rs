//! Whoever wants in, wants to lie, or wants to be in the way.

use std::io::{Read, Write};
use std::net::TcpStream;

use serde_json::json;
use tungstenite::Message;

use crate::client::{Running, device};

#[test]
fn the_page_is_for_whoever_has_the_token_by_the_servers_own_name() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=5", folder.path(), false));
    let (host, token) = (server.address.to_string(), server.token.clone());
    let (head, body) = server.get(&format!("/?token={token}"));
    assert!(head.starts_with("HTTP/1.1 200 OK\r\n"), "{head}");
    assert_eq!(String::from_utf8(body).unwrap(), "<html><p>page</p></html>");
    for part in [
        &format!(
            "Content-Security-Policy: default-src 'none'; connect-src http://{host} ws://{host}; frame-ancestors 'none'\r\n"
        )[..],
        "Referrer-Policy: no-referrer\r\n",
        "Cache-Control: no-store\r\n",
        "X-Frame-Options: DENY\r\n",
        "Cross-Origin-Resource-Policy: same-origin\r\n",
    ] {
        assert!(head.contains(part), "{part}: {head}");
    }
    assert!(!head.contains("Access-Control"), "{head}");
    let last = if token.ends_with('0') { '1' } else { '0' };
    let almost = format!("{}{last}", &token[..31]);
    let asked = [
        (format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n"), "403"),
        (format!("GET /?token= HTTP/1.1\r\nHost: {host}\r\n\r\n"), "403"),
        (format!("GET /?token={almost} HTTP/1.1\r\nHost: {host}\r\n\r\n"), "403"),
        (format!("GET /?token={token}0 HTTP/1.1\r\nHost: {host}\r\n\r\n"), "403"),
        (format!("GET /?token={} HTTP/1.1\r\nHost: {host}\r\n\r\n", token.to_uppercase() + "A"), "403"),
        // A name that leads here by somebody else's will.
        (format!("GET /?token={token} HTTP/1.1\r\nHost: evil.example\r\n\r\n"), "421"),
        (
            format!("GET /?token={token} HTTP/1.1\r\nHost: evil.example:{}\r\n\r\n", server.address.port()),
            "421",
        ),
        (
            format!(
                "GET /?token={token} HTTP/1.1\r\nHost: 127.0.0.1.nip.io:{}\r\n\r\n",
                server.address.port()
            ),
            "421",
        ),
        (
            format!("GET /?token={token} HTTP/1.1\r\nHost: localhost.:{}\r\n\r\n", server.address.port()),
            "421",
        ),
        (format!("GET /?token={token} HTTP/1.1\r\nHost: [::1]:{}\r\n\r\n", server.address.port()), "421"),
        (format!("GET /?token={token} HTTP/1.1\r\nHost: user@{host}\r\n\r\n"), "421"),
        (format!("GET /?token={token} HTTP/1.1\r\n\r\n"), "421"),
        (format!("GET /?token={token} HTTP/1.1\r\nHost: {host}\r\nHost: evil.example\r\n\r\n"), "400"),
        (format!("GET http://evil.example/?token={token} HTTP/1.1\r\nHost: evil.example\r\n\r\n"), "421"),
        (
            format!("GET /?token={token} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://evil.example\r\n\r\n"),
            "403",
        ),
        (format!("GET /?token={token} HTTP/1.1\r\nHost: {host}\r\nOrigin: null\r\n\r\n"), "403"),
        (format!("POST /?token={token} HTTP/1.1\r\nHost: {host}\r\nContent-Length: 0\r\n\r\n"), "405"),
        (format!("GET /../../etc/passwd?token={token} HTTP/1.1\r\nHost: {host}\r\n\r\n"), "404"),
        (format!("GET /trace?token={token} HTTP/1.1\r\nHost: {host}\r\n\r\n"), "404"),
        (format!("GET /favicon.ico HTTP/1.1\r\nHost: {host}\r\n\r\n"), "404"),
        (format!("GET /{} HTTP/1.1\r\nHost: {host}\r\n\r\n", "a".repeat(20_000)), "431"),
        ("\x16\x03\x01\x00\x05hello\r\n\r\n".to_owned(), "400"),
    ];
    for (request, status) in asked {
        let (head, body) = server.ask(&request);
        assert!(
            head.starts_with(&format!("HTTP/1.1 {status} ")),
            "{}: {head}",
            &request[..request.len().min(100)]
        );
        let body = String::from_utf8(body).unwrap();
        assert!(!head.contains(&token) && !body.contains(&token) && !body.contains("page</p>"), "{body}");
    }
}

#[test]
fn no_other_page_opens_a_websocket() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=5", folder.path(), true));
    let (host, port) = (server.address.to_string(), server.address.port());
    let own = format!("http://{host}");
    let right = format!("token={}", server.token);
    for (query, host, origin) in [
        (right.as_str(), host.as_str(), Some("http://evil.example")),
        (&right, &host, Some("null")),
        (&right, &host, Some("https://127.0.0.1")),
        (&right, &host, None),
        (&right, &format!("evil.example:{port}"), Some(&format!("http://evil.example:{port}")[..])),
        ("", &host, Some(&own)),
        ("token=00000000000000000000000000000000", &host, Some(&own)),
    ] {
        let error = server.socket(query, host, origin).err().unwrap();
        assert!(error.contains("403") || error.contains("421"), "{query} {host} {origin:?}: {error}");
    }
    // By its other name, as the user may have typed it.
    let other = format!("localhost:{port}");
    assert!(server.socket(&right, &other, Some(&format!("http://{other}"))).is_ok());
}

#[test]
fn messages_that_are_too_long_or_senseless_end_one_connection_at_most() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=20", folder.path(), true));
    let mut watching = server.page();
    let mut page = server.page();
    for text in ["", "null", "{\"number\":1}", "[[[[", "{\"received\":-1}", &"[".repeat(60_000)] {
        page.socket.send(Message::text(text)).unwrap();
    }
    page.until(|page| {
        page.notices.iter().filter(|notice| notice.contains("did not understand")).count() == 6
    });
    // It may claim to have received what does not exist yet.
    page.say(&json!({ "received": u64::MAX }));
    let so_far = page.records.len();
    page.until(|page| page.records.len() > so_far + 100);
    let ends = |message: Message| {
        let mut page = server.page();
        page.acknowledges = false;
        // The connection may end before all of it is taken.
        let _ = page.socket.send(message);
        while page.step().is_ok() {}
    };
    ends(Message::text("x".repeat(100_000)));
    ends(Message::binary(vec![0; 10]));
    // A frame that claims to be of exabytes; one without a mask.
    for head in [&[0x81, 0xFF, 0x7F, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 1, 2, 3, 4][..], b"\x81\x02{}"]
    {
        let mut page = server.page();
        page.acknowledges = false;
        let _ = page.socket.get_mut().write_all(head);
        while page.step().is_ok() {}
    }
    // One that is cut: half of its head, half of its content, fragments without a last one.
    for cut in [&[0x81][..], &[0x81, 0x8A, 1, 2, 3, 4, b'x'], &[0x01, 0x81, 1, 2, 3, 4, b'x']] {
        let mut page = server.page();
        page.acknowledges = false;
        page.socket.get_mut().write_all(cut).unwrap();
        page.socket.get_ref().shutdown(std::net::Shutdown::Write).unwrap();
        while page.step().is_ok() {}
    }
    let mut page = server.page();
    page.acknowledges = false;
    let fragment = [&[0x01, 0xFE, 0x10, 0x00, 0, 0, 0, 0][..], &[b'x'; 0x1000]].concat();
    let next = [&[0x00, 0xFE, 0x10, 0x00, 0, 0, 0, 0][..], &[b'x'; 0x1000]].concat();
    let _ = page.socket.get_mut().write_all(&fragment);
    for _ in 0..20 {
        let _ = page.socket.get_mut().write_all(&next);
    }
    while page.step().is_ok() {}
    let so_far = watching.records.len();
    watching.until(|page| page.records.len() > so_far + 100);
    watching.until(|page| page.state["pages"] == 2);
}

#[test]
fn requests_without_end_are_answered_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=5", folder.path(), false));
    let mut page = server.page();
    for number in 1000..1200 {
        page.say(
            &json!({ "number": number, "request": "send", "parameters": { "channel": 1, "frame": "123#" } }),
        );
    }
    assert!(page.ask("send", &json!({ "channel": 1, "frame": "123#" })).is_err());
    // Meanwhile the capture goes on for everybody.
    let mut watching = server.page();
    for round in 0..20_u64 {
        for number in 0..50 {
            page.say(
                &json!({ "number": 2000 + 50 * round + number, "request": "recover", "parameters": {} }),
            );
        }
        let so_far = watching.frames();
        watching.until(|page| page.frames() > so_far);
    }
}

#[test]
fn more_pages_than_there_are_places_for_are_told_so() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=5", folder.path(), false));
    let pages: Vec<_> = (0..8).map(|_| server.page()).collect();
    let host = server.address.to_string();
    let query = format!("token={}", server.token);
    let mut socket = server.socket(&query, &host, Some(&format!("http://{host}"))).unwrap();
    let Message::Close(Some(reason)) = socket.read().unwrap() else { panic!() };
    assert!(reason.reason.contains("8 pages are open already"), "{reason}");
    drop(pages);
}

#[test]
fn strangers_who_only_connect_keep_nobody_out() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=5", folder.path(), false));
    let mut page = server.page();
    let crowd: Vec<_> = (0..300).map(|_| TcpStream::connect(server.address).unwrap()).collect();
    let mut second = server.page();
    second.until(|page| page.frames() > 50);
    let so_far = page.frames();
    page.until(|page| page.frames() > so_far + 50);
    // The first ones were let go.
    let mut first = &crowd[0];
    assert!(matches!(first.read(&mut [0; 1]), Ok(0) | Err(_)));
}

#[test]
fn a_connection_has_one_request_and_nothing_behind_it_is_taken_for_another() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=5", folder.path(), true));
    let (host, token) = (server.address.to_string(), server.token.clone());
    let second = format!("GET /?token={token} HTTP/1.1\r\nHost: {host}\r\n\r\n");
    let len = second.len();
    for lengths in [
        format!("Content-Length: {len}\r\nContent-Length: 0\r\n"),
        "Content-Length: 0\r\nTransfer-Encoding: chunked\r\n".to_owned(),
        "Transfer-Encoding: chunked\r\n".to_owned(),
        "Connection: keep-alive\r\n".to_owned(),
    ] {
        let first = format!("GET /?token=guessed HTTP/1.1\r\nHost: {host}\r\n{lengths}\r\n");
        let (head, body) = server.ask(&format!("{first}{second}"));
        assert!(
            head.starts_with("HTTP/1.1 403 ") && head.contains("Connection: close\r\n"),
            "{lengths}: {head}"
        );
        assert!(!String::from_utf8(body).unwrap().contains("HTTP/1.1"), "{lengths}");
    }
}

#[test]
fn a_page_that_speaks_something_else_or_pings_without_end_is_alone_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=20", folder.path(), true));
    let mut watching = server.page();
    // An upgrade within the WebSocket is no frame.
    let mut page = server.page();
    page.acknowledges = false;
    let again = format!("GET /live?token={} HTTP/1.1\r\nHost: {}\r\n\r\n", server.token, server.address);
    page.socket.get_mut().write_all(again.as_bytes()).unwrap();
    while page.step().is_ok() {}
    let mut pinging = server.page();
    for _ in 0..20_000 {
        if pinging.socket.send(Message::Ping(vec![0; 100].into())).is_err() {
            break;
        }
    }
    let so_far = watching.frames();
    watching.until(|page| page.frames() > so_far + 500);
    let more = pinging.frames();
    pinging.until(|page| page.frames() > more + 100);
}

#[test]
fn a_request_that_never_ends_is_ended() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=5", folder.path(), false));
    let slow: Vec<_> = (0..40)
        .map(|_| {
            let mut stream = TcpStream::connect(server.address).unwrap();
            stream.write_all(b"GET /?token=").unwrap();
            stream
        })
        .collect();
    let mut page = server.page();
    page.until(|page| page.frames() > 50);
    for mut stream in slow {
        // Bytes that trickle in are no reason to wait longer.
        while stream.write_all(b"0").is_ok() && !matches!(stream.read(&mut [0; 1]), Ok(0)) {}
    }
}
