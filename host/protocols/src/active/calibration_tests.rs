//! Commands to slaves that answer, do not, or answer what they should not.

use super::Machine as _;
use super::calibration::{CalibrationCommand, CommandError, CommandRequest, Dialect};
use super::testing::{Peer, arrives, disturbed, run};
use crate::serving::xcp::{Memory, XcpServer};
use crate::xcp::codec::{command, error};
use cantap_can::{Frame, Id};

const XCP: Dialect = Dialect::Xcp { is_padded: false };

fn request(dialect: Dialect, command: &[u8], data: usize) -> CommandRequest {
    CommandRequest {
        parties: "7F0:7F1".parse().unwrap(),
        dialect,
        command: command.to_vec(),
        data,
        skipped: 0,
        is_repeatable: true,
        timeout_ns: 100_000_000,
        patience_ns: 2_000_000_000,
    }
}

/// Answers each frame with the next of these, or with none.
struct Scripted(Vec<Vec<&'static [u8]>>);

impl Peer for Scripted {
    fn hear(&mut self, id: Id, _data: &[u8], said: &mut Vec<(u64, Frame)>) {
        assert_eq!(id.raw(), 0x7F0);
        if self.0.is_empty() {
            return;
        }
        let frames = self.0.remove(0).into_iter().enumerate();
        said.extend(frames.map(|(at, data)| {
            (1_000_000 * (at as u64 + 1), Frame::data_frame(Id::standard_truncated(0x7F1), data).unwrap())
        }));
    }
}

fn outcome(
    request: CommandRequest,
    answers: Vec<Vec<&'static [u8]>>,
) -> (Result<Vec<u8>, CommandError>, Vec<Vec<u8>>) {
    let mut machine = CalibrationCommand::new(request);
    let (_, sent) = run(&mut machine, &mut Scripted(answers), arrives);
    (machine.finish(), sent.iter().map(|frame| frame.data().to_vec()).collect())
}

#[test]
fn a_response_is_what_follows_its_first_byte() {
    let (answer, sent) = outcome(request(XCP, &[0xFD], 0), vec![vec![&[0xFF, 0, 5, 0, 0, 0]]]);
    assert_eq!((answer, sent), (Ok(vec![0, 5, 0, 0, 0]), vec![vec![0xFD]]));
    let (answer, _) = outcome(request(XCP, &[0xFD], 0), vec![vec![&[0xFE, 0x20]]]);
    assert_eq!(answer, Err(CommandError::Refused { code: 0x20 }));
}

/// Data packets go on all the while.
#[test]
fn a_block_of_responses_is_one_answer() {
    let frames: Vec<&[u8]> = vec![&[0xFF, 1, 2, 3, 4, 5, 6, 7], &[0x00, 9, 9], &[0xFF, 8, 9, 10, 0, 0, 0, 0]];
    let (answer, _) = outcome(request(XCP, &[0xF5, 10], 10), vec![frames]);
    assert_eq!(answer, Ok((1..=10).collect::<Vec<u8>>()));
    let (answer, _) = outcome(request(XCP, &[0xF5, 10], 10), vec![vec![&[0xFF, 1, 2, 3]]]);
    assert_eq!(answer, Err(CommandError::TooShort { expected: 10, got: 3 }));
}

#[test]
fn silence_is_answered_with_synch_and_one_more_try() {
    let (answer, sent) = outcome(request(XCP, &[0xFD], 0), vec![vec![], vec![&[0xFE, 0]], vec![&[0xFF, 1]]]);
    assert_eq!((answer, sent), (Ok(vec![1]), vec![vec![0xFD], vec![0xFC], vec![0xFD]]));
    let (answer, sent) = outcome(request(XCP, &[0xFD], 0), Vec::new());
    assert_eq!(answer, Err(CommandError::NoAnswer { after_ms: 100, repeats: 0 }));
    assert_eq!(sent, [[0xFD], [0xFC], [0xFC], [0xFC]]);
    let once = CommandRequest { is_repeatable: false, ..request(XCP, &[0xF0, 1, 2], 0) };
    let (answer, sent) = outcome(once, vec![vec![], vec![&[0xFE, 0]]]);
    assert_eq!((answer, sent.len()), (Err(CommandError::Lost { after_ms: 100 }), 2));
    let (answer, sent) = outcome(request(XCP, &[0xFF, 0], 0), Vec::new());
    assert_eq!((answer, sent.len()), (Err(CommandError::NoAnswer { after_ms: 100, repeats: 2 }), 3));
}

#[test]
fn busy_and_pending_slaves_are_waited_for_and_not_for_ever() {
    let busy: &[u8] = &[0xFE, error::CMD_BUSY];
    let (answer, sent) = outcome(request(XCP, &[0xFD], 0), vec![vec![busy], vec![busy], vec![&[0xFF]]]);
    assert_eq!((answer, sent.len()), (Ok(Vec::new()), 3));
    let (answer, _) = outcome(request(XCP, &[0xFD], 0), vec![vec![busy]; 1000]);
    assert_eq!(answer, Err(CommandError::Busy { after_ms: 2000 }));
    let pending: &[u8] = &[0xFD, 5];
    let mut frames = vec![pending; 500];
    frames.push(&[0xFF, 7]);
    let (answer, sent) = outcome(request(XCP, &[0xF3], 0), vec![frames]);
    assert_eq!((answer, sent.len()), (Ok(vec![7]), 1));
    let (answer, _) = outcome(request(XCP, &[0xF3], 0), vec![vec![pending; 5000]]);
    assert_eq!(answer, Err(CommandError::Busy { after_ms: 2000 }));
}

#[test]
fn a_command_that_is_no_frame_ends_at_once() {
    let (answer, sent) = outcome(request(XCP, &[0; 9], 0), Vec::new());
    assert_eq!((answer, sent.len()), (Err(CommandError::TooLong), 0));
}

#[test]
fn another_master_is_noticed() {
    let mut machine = CalibrationCommand::new(request(XCP, &[0xFD], 0));
    assert!(machine.next(0).is_some());
    machine.sent(1);
    machine.hear(2, Id::standard_truncated(0x7F0), &[0xFF, 0]);
    assert_eq!(machine.finish(), Err(CommandError::OtherMaster));
}

#[test]
fn an_answer_of_ccp_has_the_counter_of_its_command() {
    let dialect = Dialect::Ccp { counter: 7 };
    let answers: Vec<&[u8]> = vec![&[0xFF, 0, 6, 1, 1, 1, 1, 1], &[0xFF, 0, 7, 2, 3, 0, 0, 0]];
    let (answer, sent) = outcome(request(dialect, &[0x0F, 2, 0, 0x20, 0, 0, 0], 2), vec![answers]);
    assert_eq!(answer, Ok(vec![2, 3, 0, 0, 0]));
    assert_eq!(sent, [[0x0F, 7, 2, 0, 0x20, 0, 0, 0]]);
    let (answer, _) = outcome(request(dialect, &[0x1B], 0), vec![vec![&[0xFF, 0x33, 7, 0, 0, 0, 0, 0]]]);
    assert_eq!(answer, Err(CommandError::Refused { code: 0x33 }));
}

/// So many bytes from address 0 on.
struct Bytes(Vec<u8>);

impl Memory for Bytes {
    fn read(&self, _extension: u8, address: u32, length: usize) -> Option<Vec<u8>> {
        self.0.get(address as usize..address as usize + length).map(<[u8]>::to_vec)
    }

    fn write(&mut self, _extension: u8, address: u32, bytes: &[u8]) -> bool {
        self.0
            .get_mut(address as usize..address as usize + bytes.len())
            .map(|to| to.copy_from_slice(bytes))
            .is_some()
    }
}

impl Peer for (XcpServer, Bytes) {
    fn hear(&mut self, _id: Id, data: &[u8], said: &mut Vec<(u64, Frame)>) {
        let answers = self.0.hear(data, &mut self.1, 0);
        let frame = |data: Vec<u8>| Frame::data_frame(Id::standard_truncated(0x7F1), &data).unwrap();
        said.extend(answers.into_iter().map(|data| (300_000, frame(data))));
    }
}

fn served(peer: &mut (XcpServer, Bytes), command: &[u8], data: usize) -> Result<Vec<u8>, CommandError> {
    let mut machine = CalibrationCommand::new(request(XCP, command, data));
    run(&mut machine, peer, arrives);
    machine.finish()
}

#[test]
fn a_slave_asks_for_a_key_and_ends_the_session_on_a_wrong_one() {
    let mut peer = (XcpServer::new("ecu", Vec::new(), 1), Bytes(vec![0; 16]));
    served(&mut peer, &[command::CONNECT, 0], 0).unwrap();
    served(&mut peer, &[command::SET_MTA, 0, 0, 0, 4, 0, 0, 0], 0).unwrap();
    let download = [command::DOWNLOAD, 2, 0xAA, 0xBB];
    let locked = Err(CommandError::Refused { code: error::ACCESS_LOCKED });
    assert_eq!(served(&mut peer, &download, 0), locked);
    let seed = served(&mut peer, &[command::GET_SEED, 0, 1], 0).unwrap();
    let key = XcpServer::key(&seed[1..]);
    let unlock = [&[command::UNLOCK, 4][..], &key].concat();
    assert_eq!(served(&mut peer, &unlock, 0), Ok(vec![0]));
    assert_eq!(served(&mut peer, &download, 0), Ok(Vec::new()));
    assert_eq!(served(&mut peer, &[command::SHORT_UPLOAD, 3, 0, 0, 3, 0, 0, 0], 3), Ok(vec![0, 0xAA, 0xBB]));
    assert_eq!(peer.1.0[4..6], [0xAA, 0xBB]);
    let mut peer = (XcpServer::new("ecu", Vec::new(), 1), Bytes(vec![0; 16]));
    served(&mut peer, &[command::CONNECT, 0], 0).unwrap();
    served(&mut peer, &[command::GET_SEED, 0, 1], 0).unwrap();
    assert_eq!(served(&mut peer, &[command::UNLOCK, 1, 9], 0), locked);
    assert!(served(&mut peer, &[command::GET_STATUS], 0).is_err(), "it is not connected any more");
}

/// Whatever frames the bus loses, doubles and delays, what is read is right or an error.
#[test]
fn a_disturbed_bus_never_gives_a_wrong_value() {
    let mut random = fastrand::Rng::with_seed(25);
    let (mut right, mut wrong) = (0, 0);
    for round in 0..500_u32 {
        let mut peer = (XcpServer::new("ecu", Vec::new(), 0), Bytes((0..=255).collect()));
        served(&mut peer, &[command::CONNECT, 0], 0).unwrap();
        let address = (round % 200) as u8;
        let read = [command::SHORT_UPLOAD, 4, 0, 0, address, 0, 0, 0];
        let mut machine = CalibrationCommand::new(request(XCP, &read, 4));
        run(&mut machine, &mut peer, disturbed(&mut random, 6));
        match machine.finish() {
            Ok(bytes) => {
                assert_eq!(bytes, (address..address + 4).collect::<Vec<_>>());
                right += 1;
            }
            Err(_) => wrong += 1,
        }
    }
    assert!(right > 400 && right + wrong == 500, "{right} of 500");
}
