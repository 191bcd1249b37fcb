//! What has changed against another trace, as findings of the first page.

use cantap_trace::counted;
use cantap_trace::diff::{Changed, Difference, Key, Profile, compare};
use serde_json::{Value, json};

/// Mean periods that differ by more than this part count as changed, as in `cantap diff`.
const TOLERANCE: f64 = 0.1;
/// So many findings of one kind are listed.
const MOST: usize = 50;

/// `Finding` of the page's `api.ts`.
fn finding(severity: &str, text: &str, key: Option<Key>) -> Value {
    json!({
        "severity": severity,
        "text": text,
        "time": null,
        "channel": key.map(|key| key.channel),
        "id": key.map(|key| key.id.raw()),
        "extended": key.is_some_and(|key| key.id.is_extended()),
    })
}

/// What is different in `after`; `name` is that of the file with the trace before.
pub fn findings(before: &Profile, after: &Profile, name: &str) -> Vec<Value> {
    let Difference { only_a, only_b, changed, same } = compare(before, after, TOLERANCE);
    let mut all = Vec::new();
    let text = format!(
        "Against {name}: {} no longer there, {} new, {} changed, {same} the same",
        only_a.len(),
        only_b.len(),
        changed.len()
    );
    all.push(finding("info", &text, None));
    let mut list = |texts: Vec<(Key, String)>| {
        let more = texts.len().saturating_sub(MOST);
        all.extend(texts.into_iter().take(MOST).map(|(key, text)| finding("warning", &text, Some(key))));
        if more > 0 {
            all.push(finding(
                "warning",
                &format!("{more} more such differences against {name}; see cantap diff"),
                None,
            ));
        }
    };
    let gone = |(key, count): &(Key, u64)| {
        (
            *key,
            format!(
                "{} does not come any more; in {name} it came {count}",
                of(*key),
                count = counted(count, "time")
            ),
        )
    };
    list(only_a.iter().map(gone).collect());
    let new = |(key, count): &(Key, u64)| {
        (
            *key,
            format!(
                "{} is new: it came {count}, and not in {name}",
                of(*key),
                count = counted(count, "time")
            ),
        )
    };
    list(only_b.iter().map(new).collect());
    list(changed.iter().filter_map(|changed| Some((changed.key, change(changed, name)?))).collect());
    all
}

/// What is different of one identifier. Data bits that moved in one trace only are no finding: they move as the vehicle does.
fn change(changed: &Changed, name: &str) -> Option<String> {
    let list = |dlcs: &[u8]| dlcs.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let mut parts = Vec::new();
    if let Some((before, after)) = changed.period_ns {
        parts.push(format!("period {:.1} ms instead of {:.1} ms", after / 1e6, before / 1e6));
    }
    if let Some((before, after)) = &changed.dlcs {
        parts.push(format!("DLC {} instead of {}", list(after), list(before)));
    }
    if let Some((before, after)) = &changed.flags {
        parts.push(format!("FD flags {} instead of {}", list(after), list(before)));
    }
    (!parts.is_empty())
        .then(|| format!("{} has changed against {name}: {}", of(changed.key), parts.join("; ")))
}

fn of(key: Key) -> String {
    let kind = match (key.remote, key.fd) {
        (true, _) => " remote",
        (_, true) => " FD",
        _ => "",
    };
    format!("{}{kind} on channel {}", key.id, key.channel)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::{Direction, TraceEvent, TraceRecord};

    fn profile(frames: &[(i64, &str)]) -> Profile {
        let mut profile = Profile::default();
        for (time_ms, frame) in frames {
            let event =
                TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
            profile.add(&TraceRecord { time_ns: time_ms * 1_000_000, device_ns: None, channel: 1, event });
        }
        profile
    }

    #[test]
    fn what_came_went_and_changed_is_said() {
        let before = profile(&[(0, "100#11"), (10, "100#11"), (0, "200#"), (0, "300#11")]);
        let after = profile(&[(0, "100#11"), (30, "100#11"), (0, "300#1122"), (0, "400#")]);
        let texts: Vec<_> = findings(&before, &after, "old.log")
            .iter()
            .map(|one| one["text"].as_str().unwrap().to_owned())
            .collect();
        assert_eq!(
            texts,
            [
                "Against old.log: 1 no longer there, 1 new, 2 changed, 0 the same",
                "200 on channel 1 does not come any more; in old.log it came 1 time",
                "400 on channel 1 is new: it came 1 time, and not in old.log",
                "100 on channel 1 has changed against old.log: period 30.0 ms instead of 10.0 ms",
                "300 on channel 1 has changed against old.log: DLC 2 instead of 1",
            ]
        );
    }
}
