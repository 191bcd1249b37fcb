//! How far the run of a twin is from the trace that it was learnt from.

use std::collections::BTreeSet;

use cantap_can::Frame;

use super::content::Content;
use super::learner::{Key, Observed, Seen};
use super::model::{Model, Stream};
use super::role::Role;
use super::timing;

/// Of a trace and of a run over the same time.
#[derive(Clone, Debug, PartialEq)]
pub struct Distance {
    /// How long both are, in nanoseconds.
    pub duration_ns: u64,
    /// Frames in the trace and in the run.
    pub frames: [usize; 2],
    /// The load of each channel with frames, in per cent: its number, the trace's, the run's.
    pub load_pct: Vec<(u8, [f64; 2])>,
    /// Frames that one has more than the other, summed over identifiers, in per cent of the trace's.
    pub apart_pct: f64,
    /// Each identifier of the trace or the run.
    pub streams: Vec<StreamDistance>,
}

/// The same for one identifier.
#[derive(Clone, Debug, PartialEq)]
pub struct StreamDistance {
    /// Which one.
    pub key: Key,
    /// Why it sends; `None` if it is in no script.
    pub role: Option<Role>,
    /// Frames in the trace and in the run.
    pub frames: [usize; 2],
    /// The mean period of both in nanoseconds, if they have one.
    pub period_ns: [Option<f64>; 2],
    /// The standard deviation of the intervals of both in nanoseconds.
    pub jitter_ns: [Option<f64>; 2],
    /// Of the run's frames, those whose data are in the trace, in per cent.
    pub known_pct: Option<f64>,
    /// The same apart from counters and checksums: one that was recorded with another counter is not known as a whole.
    pub known_rest_pct: Option<f64>,
    /// Pairs of frames between which the counters count, in trace and run, in per cent, if there are counters.
    pub counters_right_pct: [Option<f64>; 2],
    /// Frames with the right checksum in trace and run, in per cent, if there is one.
    pub checksums_right_pct: [Option<f64>; 2],
}

/// Compares the first `duration_ns` of a trace with a run; the bit rates of both channels are in bit/s.
pub fn compare(
    model: &Model,
    trace: &Observed,
    run: &Observed,
    duration_ns: u64,
    bitrates_bps: [u32; 2],
) -> Distance {
    let keys: BTreeSet<&Key> = trace.streams.keys().chain(run.streams.keys()).collect();
    let within = |observed: &Observed, key: &Key| -> Vec<Seen> {
        let all = observed.streams.get(key).map(Vec::as_slice).unwrap_or_default();
        all[..all.partition_point(|seen| seen.at_ns < duration_ns)].to_vec()
    };
    let mut bits = [[0_u64; 2]; 2];
    let mut streams = Vec::new();
    for key in keys {
        let stream = model.streams.iter().find(|stream| stream.key == *key);
        let both = [trace, run].map(|observed| within(observed, key));
        for (place, seen) in both.iter().enumerate() {
            bits[usize::from(key.channel == 2)][place] +=
                seen.iter().map(|seen| u64::from(cantap_can::bits_on_bus(&seen.frame))).sum::<u64>();
        }
        streams.push(one(*key, stream, &both));
    }
    let frames = [0, 1].map(|place| streams.iter().map(|stream| stream.frames[place]).sum::<usize>());
    let apart: usize = streams.iter().map(|stream| stream.frames[0].abs_diff(stream.frames[1])).sum();
    let seconds = duration_ns.max(1) as f64 / 1e9;
    let load = |channel: usize| {
        let bits_per_s = f64::from(bitrates_bps[channel].max(1));
        (channel as u8 + 1, bits[channel].map(|bits| bits as f64 / bits_per_s / seconds * 100.0))
    };
    let load_pct = [0, 1].into_iter().filter(|channel| bits[*channel] != [0; 2]).map(load).collect();
    Distance {
        duration_ns,
        frames,
        load_pct,
        apart_pct: percent(apart, frames[0]).unwrap_or_default(),
        streams,
    }
}

fn one(key: Key, stream: Option<&Stream>, both: &[Vec<Seen>; 2]) -> StreamDistance {
    let periods = [0, 1].map(|place| timing::period(&both[place]));
    let run = &both[1];
    let known = |is_known: fn(&Content, &Frame) -> bool| {
        let content = &stream?.content;
        percent(run.iter().filter(|seen| is_known(content, &seen.frame)).count(), run.len())
    };
    let counters_right = |seen: &[Seen]| {
        let counters = &stream.filter(|stream| !stream.content.counters.is_empty())?.content.counters;
        let pairs: Vec<_> = seen.windows(2).filter(|pair| pair[0].stretch == pair[1].stretch).collect();
        let data = |seen: &Seen| seen.frame.padded_data();
        let is_right = |pair: &&[Seen]| {
            counters.iter().all(|counter| {
                counter.after(counter.field.get(data(&pair[0]))) == counter.field.get(data(&pair[1]))
            })
        };
        percent(pairs.iter().filter(|pair| is_right(pair)).count(), pairs.len())
    };
    let checksums_right = |seen: &[Seen]| {
        let content = &stream?.content;
        let checksum = content.checksum.as_ref()?;
        let is_right = |seen: &&Seen| {
            checksum.is_right(seen.frame.padded_data(), seen.frame.data_len(), content.counters.first())
        };
        percent(seen.iter().filter(is_right).count(), seen.len())
    };
    StreamDistance {
        key,
        role: stream.map(|stream| stream.role),
        frames: [both[0].len(), run.len()],
        period_ns: periods.map(|period| Some(period?.mean_ns)),
        jitter_ns: periods.map(|period| Some(period?.jitter_ns)),
        known_pct: known(Content::has),
        known_rest_pct: known(Content::has_rest),
        counters_right_pct: [counters_right(&both[0]), counters_right(run)],
        checksums_right_pct: [checksums_right(&both[0]), checksums_right(run)],
    }
}

fn percent(part: usize, whole: usize) -> Option<f64> {
    (whole > 0).then(|| part as f64 / whole as f64 * 100.0)
}
