//! The record queue with its two ends in two threads, as interrupts and USB use it.

use std::sync::atomic::{AtomicBool, Ordering};

use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::recorder::Recorder;
use cantap_wire::record::{self, LossStage};
use cantap_wire::{Channel, Event, Frame, Id, Received, Record, Stamp};

const FRAMES: u32 = 300_000;

fn numbered(number: u32) -> Received {
    let id = Id::extended(number).unwrap();
    // Lengths that do not divide the ring's size, so that records meet its end at every offset.
    let data = &number.to_be_bytes()[..number as usize % 5];
    Received {
        channel: Channel::ALL[number as usize % 2],
        frame: Frame::data_frame(id, data).unwrap(),
        stamp: Stamp::Exact,
        data_omitted: false,
    }
}

/// Sets its flag when dropped, even by a panic.
struct Gone<'a>(&'a AtomicBool);

impl Drop for Gone<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

/// Reads everything as USB does and checks it: each frame is either there or counted as lost, in order. Returns
/// the frames read.
fn check(pace: impl Fn(u32)) -> u32 {
    let queue = RecordQueue::<{ 16 * 1024 }>::new();
    let (producer, mut consumer) = queue.split();
    let (done, reader_gone) = (AtomicBool::new(false), AtomicBool::new(false));
    let (mut read, mut lost) = (0, [0u32; 2]);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut recorder = Recorder::new(producer);
            for number in 0..FRAMES {
                recorder.frame(&numbered(number), u64::from(number) * 576);
            }
            while recorder.fill().0 > 0 && !reader_gone.load(Ordering::Acquire) {
                std::thread::yield_now();
            }
            recorder.flush_losses(u64::from(FRAMES) * 576);
            done.store(true, Ordering::Release);
        });
        let _gone = Gone(&reader_gone);
        let mut next = [0, 1];
        let mut time = 0i64;
        loop {
            let ended = done.load(Ordering::Acquire);
            let used = consumer.read(|bytes| {
                let (record, ticks, rest) =
                    record::decode(bytes).expect("only whole records are in the queue");
                time += ticks;
                match record {
                    Record::Received(received) => {
                        let number = &mut next[received.channel.index()];
                        assert_eq!((received, time), (numbered(*number), i64::from(*number) * 576));
                        *number += 2;
                        read += 1;
                    }
                    Record::Event(Event::Lost {
                        channel,
                        stage: LossStage::Queue,
                        count,
                        at_least: false,
                    }) => {
                        next[channel.index()] += 2 * count;
                        lost[channel.index()] += count;
                    }
                    other => panic!("{other:?}"),
                }
                bytes.len() - rest.len()
            });
            pace(read);
            if used == 0 && ended {
                break;
            }
        }
        assert_eq!(next, [FRAMES, FRAMES + 1]);
    });
    assert_eq!(read + lost[0] + lost[1], FRAMES);
    read
}

#[test]
fn a_reader_in_another_thread_sees_every_frame_or_its_loss() {
    assert!(check(|_| {}) > 0);
}

#[test]
fn a_slow_reader_loses_frames_and_every_one_is_counted() {
    let read = check(|read| {
        if read.is_multiple_of(1000) {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    });
    assert!(read < FRAMES, "the queue was meant to overflow");
}
