//! The driver, and a whole session, against a stand-in that answers as `canalystii` expects it.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use cantap::device::Device;
use cantap::{DeviceError, TraceEvent, TraceRecord};
use cantap_wire::message::TxFrame;

use super::*;
use crate::testing::{frames, until};

#[derive(Default)]
struct State {
    /// Commands to each channel, without questions.
    told: [Vec<u32>; 2],
    registers: [(u32, u32); 2],
    asked: [bool; 2],
    answers: u32,
    received: [VecDeque<Vec<u8>>; 2],
    sent: Vec<(usize, [u8; PACKET])>,
    /// Frames that wait to be sent, as it says.
    unsent: u32,
    /// It says that so many wait, whatever is there.
    lies: Option<u32>,
    answers_garbage: bool,
    is_unplugged: bool,
    /// It takes no transfer any more: each ends after a while.
    is_stalled: bool,
    /// It vanishes once so many transfers were made.
    vanishes_after: Option<u32>,
}

#[derive(Clone, Default)]
struct StandIn(Arc<Mutex<State>>);

impl StandIn {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A packet with these frames, each 100 µs after the last.
    fn receive(&self, channel: usize, stamp: u32, texts: &[&str]) {
        let mut packet = vec![texts.len() as u8];
        for (text, stamp) in texts.iter().zip(stamp..) {
            let one = wire::frame(&text.parse().unwrap());
            packet.extend_from_slice(&one[1..5]);
            packet.extend_from_slice(&stamp.to_le_bytes());
            packet.push(1);
            packet.extend_from_slice(&one[10..22]);
        }
        packet.resize(PACKET, 0);
        self.lock().received[channel].push_back(packet);
    }

    /// Waits until it has answered anew.
    fn is_asked_again(&self) {
        let before = self.lock().answers;
        while self.lock().answers < before + 3 {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn transfer(&self) -> Result<MutexGuard<'_, State>, String> {
        let mut state = self.lock();
        if let Some(left) = &mut state.vanishes_after {
            *left = left.saturating_sub(1);
            if *left == 0 {
                state.is_unplugged = true;
            }
        }
        if state.is_stalled {
            drop(state);
            std::thread::sleep(Duration::from_millis(20));
            return Err("the transfer took too long".to_owned());
        }
        if state.is_unplugged { Err("it was unplugged".to_owned()) } else { Ok(state) }
    }
}

impl Usb for StandIn {
    fn command(&mut self, channel: usize, packet: [u8; PACKET]) -> Result<(), String> {
        let mut state = self.transfer()?;
        let word = |at: usize| u32::from_le_bytes(packet[at..at + 4].try_into().unwrap());
        match word(0) {
            0x0A => state.asked[channel] = true,
            command => state.told[channel].push(command),
        }
        if word(0) == 1 {
            state.registers[channel] = (word(24), word(28));
        }
        Ok(())
    }

    fn answer(&mut self, channel: usize) -> Result<Vec<u8>, String> {
        let mut state = self.transfer()?;
        assert!(std::mem::take(&mut state.asked[channel]), "it has not been asked");
        state.answers += 1;
        if state.answers_garbage {
            return Ok(vec![1; 3]);
        }
        let there = state.received[channel].iter().map(|packet| u32::from(packet[0].min(3))).sum();
        let mut answer = vec![0; PACKET];
        answer[4..8].copy_from_slice(&state.lies.unwrap_or(there).to_le_bytes());
        answer[8..12].copy_from_slice(&state.unsent.to_le_bytes());
        Ok(answer)
    }

    fn read(&mut self, channel: usize, len: usize) -> Result<Vec<u8>, String> {
        assert!((1..=MOST_PACKETS).contains(&(len / PACKET)) && len.is_multiple_of(PACKET), "{len}");
        let mut state = self.transfer()?;
        let mut bytes = Vec::new();
        while bytes.len() + PACKET <= len
            && let Some(packet) = state.received[channel].pop_front()
        {
            bytes.extend(packet);
        }
        // Packets without messages, where it has none.
        bytes.resize(len, 0);
        Ok(bytes)
    }

    fn write(&mut self, channel: usize, packet: [u8; PACKET]) -> Result<(), String> {
        self.transfer()?.sent.push((channel, packet));
        Ok(())
    }
}

fn session(stand_in: &StandIn) -> Device {
    let driver = CanalystIi::over(Box::new(stand_in.clone()), "A1".to_owned(), "canalyst-ii:").unwrap();
    Device::over(crate::engine::start(Box::new(driver)).unwrap(), "canalyst-ii:").unwrap()
}

#[test]
fn it_is_off_until_it_may_acknowledge_and_both_channels_are_heard() {
    let stand_in = StandIn::default();
    let device = session(&stand_in);
    assert_eq!(stand_in.lock().told, [vec![3], vec![3]]);
    assert_eq!((device.hello().board.as_str(), device.hello().channels), ("canalyst-ii", 2));
    let refused = device.listen(Channel::Can1, 500_000).unwrap_err();
    assert!(matches!(refused, DeviceError::AlwaysAcknowledges { .. }), "{refused}");
    assert_eq!(stand_in.lock().told, [vec![3], vec![3]]);
    device.join(Channel::Can1, 500_000).unwrap();
    device.join(Channel::Can2, 250_000).unwrap();
    assert_eq!(stand_in.lock().told, [vec![3, 1, 5, 2], vec![3, 1, 5, 2]]);
    assert_eq!(stand_in.lock().registers, [(0, 0x1C), (1, 0x1C)]);
    stand_in.receive(0, 100, &["123#DEAD", "1ABCDEF0#", "456#R3"]);
    until(&device, "456#R3");
    stand_in.receive(1, 200, &["7FF#0102030405060708"]);
    assert_eq!(frames(&until(&device, "7FF#0102030405060708")), [(2, "7FF#0102030405060708".to_owned())]);
    device.stop().unwrap();
    assert_eq!(stand_in.lock().told.each_ref().map(|told| told.last().copied()), [Some(3), Some(3)]);
}

#[test]
fn frames_are_handed_over_no_faster_than_it_sends_them() {
    let stand_in = StandIn::default();
    let device = session(&stand_in);
    device.join(Channel::Can1, 500_000).unwrap();
    stand_in.lock().unsent = MOST_UNSENT;
    stand_in.is_asked_again();
    let ends = device.transmissions();
    let frame = |text: &str| TxFrame { tag: 1, frame: text.parse().unwrap(), at_ticks: None };
    device.send(Channel::Can1, &[frame("1ABCDEF0#11")]).unwrap();
    stand_in.is_asked_again();
    assert!(stand_in.lock().sent.is_empty());
    stand_in.lock().unsent = 0;
    assert_eq!(ends.recv().unwrap().result.unwrap().to_string(), "1ABCDEF0#11");
    assert_eq!(stand_in.lock().sent, [(0, wire::frame(&"1ABCDEF0#11".parse().unwrap()))]);
}

#[test]
fn counts_and_lengths_that_lie_are_losses_and_cost_no_memory() {
    let stand_in = StandIn::default();
    let device = session(&stand_in);
    device.join(Channel::Can1, 500_000).unwrap();
    stand_in.lock().lies = Some(u32::MAX);
    stand_in.receive(0, 1, &["100#"]);
    let mut bad = wire::frame(&"101#".parse().unwrap()).to_vec();
    bad[0] = 200;
    stand_in.lock().received[0].push_back(bad);
    stand_in.receive(0, 2, &["102#"]);
    let records = until(&device, "102#");
    assert_eq!(frames(&records), [(1, "100#".to_owned()), (1, "102#".to_owned())]);
    let lost = |record: &&TraceRecord| {
        matches!(record.event, TraceEvent::Lost { stage: Some(LossStage::Link), count: 1, at_least: true })
    };
    assert_eq!(records.iter().filter(lost).count(), 1);
    assert!(device.failures().unwrap().last.contains("messages that cannot be read"));
    // Its losses are not counted by anybody.
    assert_eq!(records[0].event, TraceEvent::UNCOUNTED);
}

#[test]
fn one_that_vanishes_at_any_moment_is_an_error_and_no_hang() {
    for transfers in 1..40 {
        let stand_in = StandIn::default();
        stand_in.lock().vanishes_after = Some(transfers);
        stand_in.receive(0, 1, &["100#"]);
        let Ok(driver) = CanalystIi::over(Box::new(stand_in.clone()), String::new(), "canalyst-ii:") else {
            continue;
        };
        let Ok(device) = Device::over(crate::engine::start(Box::new(driver)).unwrap(), "canalyst-ii:") else {
            continue;
        };
        if device.join(Channel::Can1, 500_000).is_ok() {
            let end = device.records().find_map(Result::err).unwrap();
            assert!(end.to_string().contains("it was unplugged"), "{end}");
        }
    }
}

#[test]
fn one_that_answers_no_more_ends_with_a_reason_and_nothing_captured_is_lost() {
    let stand_in = StandIn::default();
    let device = session(&stand_in);
    device.join(Channel::Can1, 500_000).unwrap();
    stand_in.receive(0, 1, &["100#", "101#"]);
    until(&device, "101#");
    stand_in.lock().is_stalled = true;
    let end = device.records().find_map(Result::err).unwrap();
    assert!(end.to_string().contains("took too long"), "{end}");
    assert_eq!(device.counters().channels[0].received, 2);
}

#[test]
fn what_does_not_answer_as_one_is_not_taken_for_one() {
    let stand_in = StandIn::default();
    stand_in.lock().answers_garbage = true;
    let error = CanalystIi::over(Box::new(stand_in), String::new(), "canalyst-ii:").err().unwrap();
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
}
