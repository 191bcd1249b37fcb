//! What a request gets: the page, or a WebSocket to a session with devices.

use std::io::{self, Write};

use tungstenite::WebSocket;
use tungstenite::handshake::derive_accept_key;
use tungstenite::protocol::Role;

use crate::head::{self, BadHead, Head};
use crate::session::{self, Live, Session};
use crate::shared::Page;
use crate::site::Site;
use crate::stream::Connection;
use crate::visits::{Visit, Visitor, Visits};

/// Reads a request. `None` if there is none; whoever runs the server and the other side have been told why.
pub fn request(stream: &mut Connection, name: &str, visits: &Visits) -> io::Result<Option<Head>> {
    let (reason, status, text) = match Head::read(stream.as_mut()) {
        Ok(head) => return Ok(Some(head)),
        Err(BadHead::Gone) => return Ok(None),
        Err(BadHead::Malformed) => {
            ("it sends no request of a browser", "400 Bad Request", "This is no request of a browser.")
        }
        Err(BadHead::TooLong) => {
            ("its request is too long", "431 Request Header Fields Too Large", "The request is too long.")
        }
    };
    visits(name, Visit::Refused(reason.to_owned()));
    head::sentence(stream, status, text)?;
    Ok(None)
}

/// Answers with the page; `policy` is its header.
pub fn page(stream: &mut Connection, site: &Site, policy: &str) -> io::Result<()> {
    let page = site.page().as_bytes();
    head::answer(stream, "200 OK", "text/html; charset=utf-8", page.len() as u64, policy)?;
    stream.write_all(page)
}

/// Makes the connection a WebSocket. `None` if that is not what was asked for, which has been said.
pub fn upgrade(mut stream: Connection, head: &Head) -> io::Result<Option<WebSocket<Connection>>> {
    let key = head.header("sec-websocket-key").filter(|key| key.len() == 24);
    let is_asked = head.has("connection", "upgrade")
        && head.has("upgrade", "websocket")
        && head.header("sec-websocket-version") == Some("13");
    let Some(key) = key.filter(|_| is_asked) else {
        let text = "Here the page opens its WebSocket.";
        return head::sentence(&mut stream, "426 Upgrade Required", text).map(|()| None);
    };
    write!(
        stream,
        "HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Accept: {}\r\n\r\n",
        derive_accept_key(key.as_bytes())
    )?;
    Ok(Some(WebSocket::from_raw_socket(stream, Role::Server, Some(session::config()))))
}

/// Says that there is no room, and ends the connection.
pub fn no_room(socket: WebSocket<Connection>, name: &str, visits: &Visits, what: &str) {
    visits(name, Visit::Refused(format!("{what} are open already")));
    session::refuse(socket, &format!("{what} are open already; close one of them"));
}

/// Serves a page until it leaves.
pub fn serve(
    socket: WebSocket<Connection>,
    head: &Head,
    live: &Live<'_>,
    page: Page<'_>,
    visitor: Visitor,
) -> io::Result<()> {
    let is_same_run = head.parameter("run") == Some(live.run);
    let from =
        head.parameter("after").and_then(|after| after.parse().ok()).filter(|_| is_same_run).unwrap_or(0);
    let name = visitor.name.clone();
    (live.visits)(&name, Visit::Came(visitor.role));
    let session = Session::new(socket, live, visitor, from);
    let result = session.map(|session| session.run(live.run));
    drop(page);
    (live.visits)(&name, Visit::Left);
    result
}
