//! How far a twin is from its trace, as text and as JSON.

use std::fmt::Write as _;

use cantap_scripts::twin::{Distance, Model, Names, Observed, Role, StreamDistance, Timing};
use cantap_trace::clean;
use cantap_trace::counted;
use cantap_work::missing::Missing;
use cantap_work::rounded;
use serde_json::{Value, json};

/// The text.
pub fn text(model: &Model, trace: &Observed, distance: &Distance, names: Names<'_>) -> String {
    let mut out = String::new();
    let seconds = distance.duration_ns as f64 / 1e9;
    let periodic = model.streams.iter().filter(|stream| is_periodic(&stream.timing)).count();
    let _ = writeln!(
        out,
        "{}: {periodic} periodic, {} with counters, {} with checksums; {} exchanges of requests and answers",
        counted(model.streams.len(), "identifier"),
        model.streams.iter().filter(|stream| !stream.content.counters.is_empty()).count(),
        model.streams.iter().filter(|stream| stream.content.checksum.is_some()).count(),
        model.exchanges.len()
    );
    for (what, count) in left_out(model, trace) {
        let _ = writeln!(out, "left out: {what} ({count})");
    }
    let _ = writeln!(
        out,
        "\ntrace and twin, the first {seconds:.3} s: {} and {}",
        distance.frames[0],
        counted(distance.frames[1], "frame")
    );
    for (channel, [of_trace, of_run]) in &distance.load_pct {
        let _ = writeln!(out, "channel {channel}: load {of_trace:.2} % and {of_run:.2} %");
    }
    let _ = writeln!(out, "frames that one of them has more, by identifier: {:.2} %\n", distance.apart_pct);
    let _ = writeln!(
        out,
        "Ch  ID        Role     Frames         Period/ms              Jitter/ms            Known/%  Rest/%   Counter/%  Checksum/%"
    );
    for stream in &distance.streams {
        row(&mut out, stream, names);
    }
    out
}

fn row(out: &mut String, stream: &StreamDistance, names: Names<'_>) {
    let key = stream.key;
    let figure = |value: Option<f64>, decimals: usize| {
        value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
    };
    let ms = |both: [Option<f64>; 2]| both.map(|ns| figure(ns.map(|ns| ns / 1e6), 3)).join(" ");
    let id = if key.remote { format!("{} R", key.id) } else { key.id.to_string() };
    let name = names(key.channel, key.id).map(|name| clean::line(&name).into_owned()).unwrap_or_default();
    let line = format!(
        "{:<3} {id:<9} {:<8} {:<14} {:<22} {:<20} {:<8} {:<8} {:<10} {:<10}  {name}",
        key.channel,
        stream.role.map_or("-", Role::name),
        stream.frames.map(|frames| frames.to_string()).join(" "),
        ms(stream.period_ns),
        ms(stream.jitter_ns),
        figure(stream.known_pct, 1),
        figure(stream.known_rest_pct, 1),
        figure(stream.counters_right_pct[1], 1),
        figure(stream.checksums_right_pct[1], 1),
    );
    let _ = writeln!(out, "{}", line.trim_end());
}

const fn is_periodic(timing: &Timing) -> bool {
    matches!(timing, Timing::Periodic { .. })
}

/// What of the trace is in no script, by kind.
fn left_out(model: &Model, trace: &Observed) -> Vec<(&'static str, u64)> {
    let mut all: Vec<(&'static str, u64)> =
        trace.left_out.iter().map(|(what, count)| (*what, *count)).collect();
    all.push(("frames of identifiers that are too many", model.omitted.1 as u64));
    all.push(("frames of exchanges that are too many or answer nothing", model.omitted_answers as u64));
    all.retain(|(_, count)| *count > 0);
    all
}

/// The object.
pub fn object(model: &Model, trace: &Observed, distance: &Distance, missing: &Missing) -> Value {
    let figure =
        |value: Option<f64>, scale: f64, decimals: i32| value.map(|value| rounded(value / scale, decimals));
    // Of the trace and of the twin.
    let both = |values: [Option<f64>; 2], scale: f64, decimals: i32| {
        json!(values.map(|value| figure(value, scale, decimals)))
    };
    let identifier = |stream: &StreamDistance| {
        let learnt = model.streams.iter().find(|learnt| learnt.key == stream.key);
        json!({
            "channel": stream.key.channel,
            "id": stream.key.id.to_string(),
            "remote": stream.key.remote,
            "role": stream.role.map(Role::name),
            "periodic": learnt.map(|learnt| is_periodic(&learnt.timing)),
            "counters": learnt.map_or(0, |learnt| learnt.content.counters.len()),
            "checksum": learnt.is_some_and(|learnt| learnt.content.checksum.is_some()),
            "frames": stream.frames,
            "period_ms": both(stream.period_ns, 1e6, 6),
            "jitter_ms": both(stream.jitter_ns, 1e6, 6),
            "known_pct": figure(stream.known_pct, 1.0, 3),
            "known_rest_pct": figure(stream.known_rest_pct, 1.0, 3),
            "counters_right_pct": both(stream.counters_right_pct, 1.0, 3),
            "checksums_right_pct": both(stream.checksums_right_pct, 1.0, 3),
        })
    };
    let load = |(channel, load): &(u8, [f64; 2])| json!({ "channel": channel, "load_pct": both(load.map(Some), 1.0, 3) });
    let mut all: serde_json::Map<String, Value> = serde_json::Map::new();
    for (what, count) in left_out(model, trace) {
        all.insert(what.to_owned(), count.into());
    }
    let mut object = json!({
        "seconds": rounded(distance.duration_ns as f64 / 1e9, 9),
        "frames": distance.frames,
        "apart_pct": rounded(distance.apart_pct, 3),
        "exchanges": model.exchanges.len(),
        "lost": trace.lost,
        "jumps": trace.jumps,
        "too_close": trace.too_close,
        "channels": distance.load_pct.iter().map(load).collect::<Vec<_>>(),
        "identifiers": distance.streams.iter().map(identifier).collect::<Vec<_>>(),
        "not_learnt": all,
    });
    missing.put_into(&mut object);
    object
}
