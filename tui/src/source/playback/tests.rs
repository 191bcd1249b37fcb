//! A jump in a large file.

use std::io::{BufWriter, Write as _};
use std::sync::Mutex;
use std::sync::mpsc::{Sender, channel};

use cantap_signals::Decoder;

use super::super::super::model::Model;
use super::super::{SessionScripts, Shared, Timed};
use super::*;

const MS: i64 = 1_000_000;
/// A frame each millisecond: 39 MB of a log. Smaller ones have no index.
const FRAMES: i64 = 1_000_000;

/// Follows orders until this holds.
fn wait_for(shared: &Shared, holds: impl Fn(&Model) -> bool) {
    while !holds(&lock(shared)) {
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn playing(model: &Model) -> Playing {
    match model.source {
        SourceState::Playing(playing) => playing,
        _ => Playing::default(),
    }
}

/// What is counted is what the file has from the time that is shown, up to the place.
fn assert_counted_from(shared: &Shared, from_ms: i64, to_ms: i64) {
    wait_for(shared, |model| {
        let playing = playing(model);
        !playing.seeking && playing.position_ns == to_ms * MS && model.seen.now_ns == (to_ms - 1) * MS
    });
    let model = lock(shared);
    assert_eq!((model.first_ns, model.counted_from_ns), (Some(0), Some(from_ms * MS)));
    assert_eq!(model.seen.taken, (to_ms - from_ms) as u64);
}

fn orders(orders: &Sender<Order>, shared: &Shared) {
    let send = |order| orders.send(order).unwrap();
    send(Order::TogglePause);
    wait_for(shared, |model| playing(model).end_ns.is_some());
    assert_eq!(playing(&lock(shared)).end_ns, Some((FRAMES - 1) * MS));
    // Ahead, back, and to the end.
    for to_ms in [700_000, 400_000, FRAMES - 1] {
        send(Order::Seek(to_ms * MS));
        assert_counted_from(shared, to_ms - 2000, to_ms);
    }
    // A little ahead, everything is counted on.
    send(Order::Seek(300_000 * MS));
    assert_counted_from(shared, 298_000, 300_000);
    send(Order::Seek(300_100 * MS));
    assert_counted_from(shared, 298_000, 300_100);
    // Near the beginning, all of it is.
    send(Order::Seek(300 * MS));
    wait_for(shared, |model| model.counted_from_ns.is_none() && model.seen.now_ns == 299 * MS);
    let model = lock(shared);
    assert_eq!((model.seen.taken, model.first_ns), (300, Some(0)));
}

#[test]
fn a_jump_passes_over_what_lies_between_and_says_from_when_on_everything_is_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.log");
    let mut log = BufWriter::new(std::fs::File::create(&path).unwrap());
    for at in 0..FRAMES {
        writeln!(log, "({}.{:03}000) can0 123#{at:016X}", at / 1000, at % 1000).unwrap();
    }
    drop(log);
    let model =
        Model::new(Decoder::new(Vec::new()).into(), cantap_analysis::stats::Options::default(), 1_000_000);
    let shared: Shared = Arc::new(Mutex::new(model.unwrap()));
    let (sender, receiver) = channel();
    let mut source = Source {
        model: &shared,
        orders: &receiver,
        recording: None,
        timed: Timed::default(),
        scripts: SessionScripts::default(),
        asking: None,
        indexes: Some(IndexFolder::new(folder.path().join("indexes"))),
    };
    std::thread::scope(|scope| {
        let shared = &shared;
        // A failure ends the source, too: its orders end.
        scope.spawn(move || orders(&sender, shared));
        source.run_file(&path);
    });
}
