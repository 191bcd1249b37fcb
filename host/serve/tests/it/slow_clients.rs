//! Clients of foreign protocols that do not read: what they lose is in the board's totals, and whoever runs the server learns that they were not told.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use cantap::wire::message::Role;
use cantap_serve::listen::Listening;
use cantap_serve::{Board, News, Settings, gvret, lines, metrics, socketcand};
use cantap_testing::process::wait_until;

use crate::metrics::{figure, scrape};
use crate::sharing::board_at;
use crate::strangers::any_port;

/// So many frames are more than the system holds for a client.
const MANY: u64 = 20_000;

/// Frames lost in front of clients so far.
fn lost(figures: &Listening) -> u64 {
    let of = |channel: u8| {
        format!("cantap_frames_lost_total{{board=\"board\",channel=\"{channel}\",stage=\"host\"}}")
    };
    let text = scrape(figures);
    figure(&text, &of(1)) + figure(&text, &of(2))
}

/// The number of lost frames in a report, if it is one.
fn not_told(news: &News) -> Option<u64> {
    let News::LeftOut { what, .. } = news else { return None };
    let number = what.split(", ").find(|part| part.contains("lost frames"))?;
    number.split(' ').next()?.parse().ok()
}

/// A client says `greeting`, reads the answer, and no more.
fn loses(listen: impl Fn(&Arc<Board>) -> Listening, greeting: &[(&[u8], &str)]) {
    let _turn = cantap_testing::process::turn();
    let settings = Settings { most_records: 500, ..Settings::at(1_000_000) };
    let (board, told) = board_at("load=100", settings);
    let board = Arc::new(board);
    let figures = metrics::listen(std::slice::from_ref(&board), any_port()).unwrap();
    let server = listen(&board);
    let mut client = TcpStream::connect(server.address().unwrap()).unwrap();
    client.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    for (text, answer) in greeting {
        client.write_all(text).unwrap();
        let mut bytes = vec![0; answer.len()];
        client.read_exact(&mut bytes).unwrap();
        assert_eq!(&bytes, answer.as_bytes());
    }
    // On a busy computer some are lost even while there is still room to write, of which it is told.
    wait_until("a client that does not read loses nothing", || lost(&figures) > MANY);
    drop(client);
    wait_until("the client is still there", || board.clients() == 0);
    let not_told = loop {
        let news = told.recv_timeout(Duration::from_secs(20)).expect("nobody says what it was not told of");
        if let Some(number) = not_told(&news) {
            break number;
        }
    };
    let lost = lost(&figures);
    assert!(not_told > MANY / 2 && not_told <= lost, "{not_told} of {lost}");
}

#[test]
fn the_losses_of_a_socketcand_client_that_does_not_read_are_counted() {
    let listen = |board: &Arc<Board>| {
        socketcand::listen(std::slice::from_ref(board), any_port(), Role::Listen).unwrap()
    };
    loses(listen, &[(b"", "< hi >"), (b"< open can0 >", "< ok >"), (b"< rawmode >", "< ok >")]);
}

#[test]
fn the_losses_of_a_gvret_client_that_does_not_read_are_counted() {
    let listen =
        |board: &Arc<Board>| gvret::listen(std::slice::from_ref(board), any_port(), Role::Listen).unwrap();
    // Keep-alive.
    loses(listen, &[(&[0xF1, 9], "")]);
}

#[test]
fn the_losses_of_a_reader_of_lines_that_does_not_read_are_counted() {
    loses(|board: &Arc<Board>| lines::listen(std::slice::from_ref(board), any_port()).unwrap(), &[]);
}
