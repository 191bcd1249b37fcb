use super::exchange::{Answerer, Exchange, ResponseTiming};
use super::lss::{FastScan, LssMaster, LssOrder};
use super::node_scan::NodeScan;
use super::sdo::{SdoClient, SdoIds, SdoJob};
use super::station::{Station, StationJob};
use super::testing::{Say, arrives, run};
use super::transfer::TransferSettings;
use super::*;
use crate::iso_tp::Pair;

/// Frames whose first bytes look right, whichever machine asks.
fn nonsense(random: &mut fastrand::Rng, asked: Id, asked_data: &[u8]) -> Frame {
    let id = if asked.is_extended() {
        let pgn = random.choice([0xEC00, 0xEB00, 0xE800, 0xEE00, 0xFECA, 0xEA00]).unwrap();
        let to = random.choice([0x80, 0xFF, 0x81]).unwrap();
        crate::j1939::Header { priority: 6, pgn, source: random.u8(..) & 3, destination: to }.id()
    } else {
        Id::standard_truncated(match asked.raw() {
            0x7E5 => 0x7E4,
            0x7E0 => 0x7E8,
            raw => raw - 0x80,
        })
    };
    let mut bytes = [0; 8];
    random.fill(&mut bytes);
    if random.u8(..) < 160 {
        bytes[0] = random
            .choice([
                0x10, 0x11, 0x21, 0x30, 0x31, 0x32, 0x41, 0x4F, 0x60, 0x80, 0xA0, 0xA2, 0xA4, 0xC1, 0xC6, 16,
                17, 19, 32, 255, 3,
            ])
            .unwrap();
    }
    if random.u8(..) < 160 && asked_data.len() == 8 {
        bytes[1..4].copy_from_slice(&asked_data[1..4]);
        bytes[5..].copy_from_slice(&asked_data[5..]);
    }
    Frame::from_bus(id, false, random.choice([8, 8, 8, 8, 3, 0]).unwrap(), bytes)
}

/// No frame causes a panic, and every machine ends in bounded time, which `run` enforces.
#[test]
fn nonsense_ends_every_machine() {
    let mut random = fastrand::Rng::with_seed(29);
    let pair: Pair = "7E0:7E8".parse().unwrap();
    for round in 0..4000_usize {
        let data = vec![0x2E; random.usize(1..120)];
        let to = random.choice([3, 255]).unwrap();
        let job = if random.bool() { SdoJob::Read } else { SdoJob::Write(data.clone()) };
        let station = match random.u8(0..3) {
            0 => StationJob::Claim,
            1 => StationJob::Request { pgn: 0xFECA, to },
            _ => StationJob::Send { pgn: 0xD000, to, priority: 6, data: data.clone() },
        };
        let answerer = Answerer::One { from: pair.b, flow_to: pair.a };
        let (settings, timing) = (TransferSettings::default(), ResponseTiming::default());
        let mut machine: Box<dyn Machine> = match round % 6 {
            0 => Box::new(Exchange::new(pair.a, answerer, data, settings, timing)),
            1 => Box::new(SdoClient::new(SdoIds::of(5), 0x2000, 1, job, random.bool(), 500_000_000)),
            2 => Box::new(FastScan::new(50_000_000)),
            3 => Box::new(LssMaster::new(LssOrder::SetNode(5), 50_000_000)),
            4 => Box::new(NodeScan::new(1..=9, 50_000_000)),
            _ => Box::new(Station::new(1 << 63 | 5, 0x80, station)),
        };
        let mut said = 0;
        let mut peer = |id: Id, data: &[u8], say: &mut Say| {
            // A peer that answered each answer for ever would never let it end.
            said += 1;
            if said < 400 {
                for _ in 0..random.usize(0..4) {
                    say.push((random.u64(0..300_000_000), nonsense(&mut random, id, data)));
                }
            }
        };
        run(&mut *machine, &mut peer, arrives);
    }
}
