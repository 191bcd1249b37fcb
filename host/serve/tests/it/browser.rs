//! A web page in a real browser tries to make the bus speak: with a request that asks for no permission, a form, and a WebSocket. What the
//! bytes of such requests do is shown without a browser in `strangers`.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::process::{Command, Stdio};
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

use cantap::{Channel, Direction, TraceEvent};
use cantap_serve::{Role, Settings, listen, socketcand};
use cantap_testing::peers;

use crate::strangers::{BITRATE_BPS, any_port, board_at, client, speaks};

/// Posts to both ports, in every way in which a page can do so without being asked, and says when it is done.
fn page(native: SocketAddr, text: SocketAddr) -> String {
    let body: Vec<String> = speaks().iter().map(u8::to_string).collect();
    format!(
        r#"<!doctype html><title>harmless</title>
<iframe name="frame"></iframe>
<form id="form" target="frame" method="post" enctype="text/plain" action="http://{text}/">
<textarea name="< open can0 >< send 6A5 2 BE EF >">x</textarea></form>
<script>
const body = new Uint8Array([{body}]);
const commands = "< open can0 >< send 6A5 2 BE EF >";
const post = (at, body) => fetch("http://" + at + "/", {{method: "POST", mode: "no-cors", body}}).catch(() => {{}});
const socket = at => new Promise(done => {{
    const socket = new WebSocket("ws://" + at + "/" + encodeURIComponent(commands));
    socket.onopen = () => socket.send(body);
    socket.onerror = socket.onclose = done;
}});
(async () => {{
    for (const [at, what] of [["{native}", body], ["{text}", commands]]) {{
        await post(at, what);
        await socket(at);
        new Image().src = "http://" + at + "/";
        navigator.sendBeacon("http://" + at + "/", what);
    }}
    document.getElementById("form").submit();
    setTimeout(() => fetch("/done"), 500);
}})();
</script>"#,
        body = body.join(",")
    )
}

/// Serves the page, and reports what is asked for.
fn serve(listener: &TcpListener, page: &str, asked: &Sender<String>) {
    for mut stream in listener.incoming().map_while(Result::ok) {
        let mut request = Vec::new();
        let mut bytes = [0; 4096];
        while !request.windows(4).any(|end| end == b"\r\n\r\n") {
            match stream.read(&mut bytes) {
                Ok(len @ 1..) => request.extend(&bytes[..len]),
                _ => break,
            }
        }
        let request = String::from_utf8_lossy(&request).into_owned();
        let path = request.split(' ').nth(1).unwrap_or_default().to_owned();
        let _ = write!(
            stream,
            "HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nConnection: close\r\nContent-Length: {}\r\n\r\n{page}",
            page.len()
        );
        if asked.send(path).is_err() {
            return;
        }
    }
}

#[test]
fn a_web_page_makes_no_bus_speak() {
    let Some(chromium) = peers::chromium() else { return };
    let (board, told) = board_at(Settings::at(BITRATE_BPS));
    let listener = client(&board, "listener", Role::Listen);
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    let native = listen::tcp(&board, any_port(), Role::Send).unwrap();
    let text = socketcand::listen(std::slice::from_ref(&board), any_port(), Role::Send).unwrap();
    let server = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = server.local_addr().unwrap();
    let page = page(native.address().unwrap(), text.address().unwrap());
    let (asked, paths) = channel();
    std::thread::spawn(move || serve(&server, &page, &asked));
    let profile = tempfile::tempdir().unwrap();
    let mut browser = Command::new(chromium)
        .args([
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
        ])
        .arg(format!("--user-data-dir={}", profile.path().display()))
        .arg(format!("http://{at}/"))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut is_done = false;
    while let Ok(path) = paths.recv_timeout(Duration::from_secs(90)) {
        if path == "/done" {
            is_done = true;
            break;
        }
    }
    let _ = browser.kill();
    let _ = browser.wait();
    assert!(is_done, "the page was not run");
    listener.stop().unwrap();
    let sent: Vec<_> = listener
        .records()
        .map(Result::unwrap)
        .filter(|record| {
            matches!(
                record.event,
                TraceEvent::Frame { direction: Direction::Tx, .. } | TraceEvent::Lost { .. }
            )
        })
        .collect();
    assert!(sent.is_empty(), "{sent:?}");
    // It did try, at both.
    let said: Vec<String> = told.try_iter().map(|news| news.to_string()).collect();
    for name in ["client 127.", "socketcand client 127."] {
        let tries =
            said.iter().filter(|line| line.starts_with(name) && line.contains("it speaks HTTP")).count();
        assert!(tries >= 2, "{name}: {said:#?}");
    }
}
