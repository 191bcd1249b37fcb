//! Any sequence of commands, valid or not, on both channels, at any load: the device keeps answering, every
//! request is answered once, and every frame is delivered or counted; also each that a gateway was to pass on.

use crate::arbitrary;
use crate::fakes;

use arbitrary::{channel, command, gateway};
use cantap_firmware::bus::queue::RecordQueue;
use cantap_wire::message::GatewayState;
use cantap_wire::record::{BusErrorKind, ErrorState, LossStage};
use cantap_wire::{CHANNELS, Channel, Command, Event, Reply, Request};
use fakes::{Bench, encode, numbered};
use proptest::prelude::*;

/// Small enough for a short burst to overflow it.
const QUEUE: usize = 8 * 1024 + 512;

#[derive(Clone, Debug)]
enum Action {
    Ask(Box<Command>),
    /// A gateway is started, or saved.
    Gateway(Vec<Command>),
    /// Frames arrive, this many before the interrupt is served each time.
    Arrive {
        channel: Channel,
        frames: u16,
        at_once: u8,
    },
    /// The bus takes what is waiting in the mailboxes.
    Take {
        channel: Channel,
        frames: u8,
    },
    Error {
        channel: Channel,
        kind: BusErrorKind,
        state: ErrorState,
    },
    Stuck {
        channel: Channel,
        stuck: bool,
    },
    Pass {
        ms: u8,
    },
    /// The host reads this many packets more, or all.
    Read {
        packets: Option<u8>,
    },
    Garbage(Vec<u8>),
}

fn action() -> impl Strategy<Value = Action> {
    let kind =
        prop::sample::select(vec![BusErrorKind::Stuff, BusErrorKind::Acknowledgment, BusErrorKind::Crc]);
    let state = prop::sample::select(vec![
        ErrorState::Active,
        ErrorState::Warning,
        ErrorState::Passive,
        ErrorState::BusOff,
    ]);
    prop_oneof![
        8 => command().prop_map(|command| Action::Ask(Box::new(command))),
        2 => gateway().prop_map(Action::Gateway),
        3 => (channel(), 1..1500_u16, 1..6_u8)
            .prop_map(|(channel, frames, at_once)| Action::Arrive { channel, frames, at_once }),
        2 => (channel(), 1..20_u8).prop_map(|(channel, frames)| Action::Take { channel, frames }),
        1 => (channel(), kind, state)
            .prop_map(|(channel, kind, state)| Action::Error { channel, kind, state }),
        1 => (channel(), any::<bool>()).prop_map(|(channel, stuck)| Action::Stuck { channel, stuck }),
        2 => (0..20_u8).prop_map(|ms| Action::Pass { ms }),
        2 => prop::option::of(0..30_u8).prop_map(|packets| Action::Read { packets }),
        1 => prop::collection::vec(any::<u8>(), 0..100).prop_map(Action::Garbage),
    ]
}

struct Run<'q> {
    bench: Bench<'q, QUEUE>,
    asked: Vec<u16>,
    /// Frames that the controllers' FIFOs accepted.
    taken: [u32; CHANNELS],
}

impl Run<'_> {
    fn act(&mut self, action: Action) {
        let bench = &mut self.bench;
        match action {
            Action::Ask(command) => {
                let id = 1000 + self.asked.len() as u16;
                self.asked.push(id);
                bench.say(&encode(&Request { id, command: *command }));
            }
            Action::Gateway(commands) => {
                for command in commands {
                    self.act(Action::Ask(Box::new(command)));
                    self.bench.millisecond();
                }
            }
            Action::Arrive { channel, frames, at_once } => {
                let index = channel.index();
                for number in 0..u32::from(frames) {
                    if !bench.board.control[index].running {
                        return;
                    }
                    self.taken[index] += u32::from(bench.board.traffic[index].fifo.len() < 3);
                    bench.board.traffic[index].arrive(numbered(number));
                    bench.pass(600);
                    if number % u32::from(at_once) == 0 {
                        bench.interrupt(channel);
                    }
                }
                bench.interrupt(channel);
            }
            Action::Take { channel, frames } => {
                for _ in 0..frames {
                    bench.pass(1300);
                    bench.send_one(channel);
                    bench.alarm();
                }
            }
            Action::Error { channel, kind, state } => {
                let traffic = &mut bench.board.traffic[channel.index()];
                traffic.error = Some(kind);
                traffic.state = Some(state);
            }
            Action::Stuck { channel, stuck } => bench.board.control[channel.index()].stuck = stuck,
            Action::Pass { ms } => {
                for _ in 0..ms {
                    bench.millisecond();
                    bench.alarm();
                }
            }
            Action::Read { packets } => bench.port.takes = packets.map_or(usize::MAX, usize::from),
            Action::Garbage(bytes) => {
                bench.say(&bytes);
                bench.say(&[0]);
            }
        }
    }

    /// The host reads again, both channels are closed, and the counts of both sides are compared.
    fn settle(mut self) -> Result<(), TestCaseError> {
        let bench = &mut self.bench;
        bench.port.takes = usize::MAX;
        for control in &mut bench.board.control {
            control.stuck = false;
        }
        for _ in 0..400 {
            bench.millisecond();
        }
        let mut answered: Vec<u16> = bench.responses.drain(..).map(|response| response.id).collect();
        answered.sort_unstable();
        for channel in Channel::ALL {
            prop_assert_eq!(bench.ask(Command::Close { channel }), Ok(Reply::Done));
        }
        let Ok(Reply::Status(status)) = bench.ask(Command::Status) else {
            return Err(TestCaseError::fail("no status"));
        };
        bench.millisecond();
        let unanswered = self.asked.iter().filter(|id| answered.binary_search(id).is_err()).count();
        prop_assert!(answered.windows(2).all(|pair| pair[0] != pair[1]), "answered twice: {answered:?}");
        // Only requests that found no room in the device's input, which are counted, may stay unanswered.
        prop_assert!(unanswered <= status.bad_requests as usize, "{unanswered} of {status:?}");
        prop_assert!(bench.complaints.is_empty(), "{:?}", bench.complaints);
        for channel in Channel::ALL {
            let counted = &status.channels[channel.index()];
            let lost: u32 = bench
                .events()
                .iter()
                .filter_map(|event| match event {
                    Event::Lost { channel: at, stage: LossStage::Queue, count, .. } if *at == channel => {
                        Some(*count)
                    }
                    _ => None,
                })
                .sum();
            let told = bench
                .events()
                .into_iter()
                .filter(|event| matches!(event, Event::Transmitted { channel: at, .. } if *at == channel));
            // Confirmations of a gateway's that found no room are lost frames of this channel.
            let untold = counted.transmitted - told.count() as u32;
            prop_assert_eq!(counted.frames, self.taken[channel.index()] + untold, "taken from {:?}", channel);
            prop_assert_eq!(bench.frames(channel).len() as u32 + lost, counted.frames, "delivered and lost");
            prop_assert_eq!(lost, counted.lost_queue);
            prop_assert_eq!((counted.tx_pending, counted.open), (0, None));
            passed(bench, channel)?;
        }
        for (traffic, control) in bench.board.traffic.iter().zip(&bench.board.control) {
            prop_assert!(!control.running && traffic.order.is_empty());
        }
        Ok(())
    }
}

/// What became of each frame that a gateway's rules matched.
fn passed(bench: &mut Bench<'_, QUEUE>, from: Channel) -> Result<(), TestCaseError> {
    let mut first = 0;
    loop {
        let Ok(Reply::Gateway(found)) = bench.ask(Command::GatewayStatus { from, first }) else {
            return Err(TestCaseError::fail("no status of the gateway"));
        };
        prop_assert!(found.waiting == 0 && found.state != GatewayState::Running, "{found:?}");
        for (slot, counts) in (first..).zip(&found.counts) {
            let Ok(Reply::GatewayRule(rule)) = bench.ask(Command::GatewayRule { from, slot }) else {
                return Err(TestCaseError::fail("no rule"));
            };
            let ended = counts.sent + counts.overtaken + counts.lost + counts.failed;
            prop_assert_eq!(ended, if rule.pass.is_some() { counts.matched } else { 0 }, "{:?}", found);
        }
        first += found.counts.len() as u8;
        if first >= found.rules {
            return Ok(());
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 10_000, max_shrink_iters: 2000, ..ProptestConfig::default() })]
    #[test]
    fn any_sequence_leaves_the_device_answering_and_its_books_true(
        actions in prop::collection::vec(action(), 1..20)
    ) {
        let queue = RecordQueue::<QUEUE>::new();
        let mut bench = Bench::new(&queue);
        bench.greet();
        bench.records.clear();
        let mut run = Run { bench, asked: Vec::new(), taken: [0; CHANNELS] };
        for action in actions {
            run.act(action);
        }
        run.settle()?;
    }
}
