//! The figures as text and as JSON.

use std::io::Write;

use cantap_analysis::delay::{DelayOptions, Delays, Figures, Outcome, STEPS_NS};
use cantap_trace::counted;
use cantap_work::missing::Missing;
use serde_json::{Value, json};

/// What was found.
pub struct Output {
    pub options: DelayOptions,
    pub outcome: Outcome,
}

/// Columns of the longest bar.
const BAR: usize = 40;
/// Percentiles shown, by their names.
const PERCENTILES: [(&str, f64); 4] = [("p50", 50.0), ("p90", 90.0), ("p99", 99.0), ("p999", 99.9)];

/// In milliseconds.
fn ms(ns: f64) -> f64 {
    ns / 1e6
}

impl Output {
    /// As text.
    pub fn print(&self, out: &mut impl Write) -> std::io::Result<()> {
        let DelayOptions { from, to, within_ns } = self.options;
        writeln!(
            out,
            "channel {from} to channel {to}, within {} ms; delays in ms, from end of frame to end of frame{}\n",
            ms(within_ns as f64),
            self.clock()
        )?;
        writeln!(
            out,
            "{:<8} {:>8} {:>8} {:>8} {:>9} {:>9} {:>9} {:>9} {:>9}",
            "id", "matched", "missing", "extra", "min", "mean", "p50", "p99", "max"
        )?;
        for (id, figures) in &self.outcome.ids {
            row(&id.to_string(), figures, out)?;
        }
        row("all", &self.outcome.total, out)?;
        histogram(&self.outcome.total.delays, out)?;
        let notes = self.notes();
        if !notes.is_empty() {
            writeln!(out)?;
        }
        notes.iter().try_for_each(|note| writeln!(out, "{note}"))
    }

    /// Whose clock measured the delays, if there are two.
    fn clock(&self) -> &'static str {
        let Figures { delays, by_device, .. } = &self.outcome.total;
        match *by_device {
            0 => "",
            all if all == delays.count() => ", by the device's clock",
            _ => ", by the device's clock where it stamped both frames",
        }
    }

    /// What limits the figures, one sentence each.
    fn notes(&self) -> Vec<String> {
        let Outcome { total, not_expected, beyond, step_ns, uncounted, breaks, .. } = &self.outcome;
        let DelayOptions { from, to, .. } = self.options;
        let undecided = &total.undecided;
        let shortest_ms = total.shortest_repeat_ns.map_or(0.0, |ns| ms(ns as f64));
        let limits = [
            (total.replaced, format!("replaced on channel {to} by a newer one within the rule's period")),
            (
                undecided.start,
                format!("on channel {to} too soon after the beginning to know whether they are extra"),
            ),
            (
                undecided.end,
                format!("on channel {from} too soon before the end to know whether they are missing"),
            ),
            (undecided.loss, "where the trace has lost frames, so neither missing nor extra".to_owned()),
            (
                total.ambiguous,
                "matched, but equal to others that waited at the same time: their delays are unknown"
                    .to_owned(),
            ),
            (total.late, "matched with a stamp that is only an upper bound".to_owned()),
            (
                total.repeated,
                format!(
                    "matched, with an equal one shortly before: their delays hold if none is longer than {shortest_ms} ms, \
                     the least between two"
                ),
            ),
            (*not_expected, format!("on channel {from} that are not expected on channel {to}")),
            (*beyond, "of identifiers beyond those listed".to_owned()),
        ];
        let by_utc = total.delays.count() - total.by_device;
        let mut notes: Vec<_> = limits
            .into_iter()
            .filter(|(count, _)| *count > 0)
            .map(|(count, text)| format!("{} {text}", counted(count, "frame")))
            .collect();
        if total.by_device > 0 && by_utc > 0 {
            notes
                .push(format!("{} by UTC, because the device's time is not known", counted(by_utc, "delay")));
        }
        if let Some(step) = step_ns {
            let step = ms(*step as f64);
            notes.push(format!(
                "stamps are in steps of {step} ms: each delay may be {step} ms longer or shorter"
            ));
        }
        if *uncounted {
            notes.push(
                "the recorder does not count its losses: what is missing or extra may be missing in the trace alone"
                    .to_owned(),
            );
        }
        if *breaks > 0 {
            let times = counted(breaks, "time");
            notes.push(format!("the clock was set back {times}: nothing was matched across that"));
        }
        notes
    }

    /// As JSON.
    pub fn object(&self, missing: &Missing) -> Value {
        let Outcome { total, ids, not_expected, beyond, step_ns, uncounted, breaks } = &self.outcome;
        let ids = ids.iter().map(|(id, figures)| {
            let mut row = object(figures);
            row["id"] = id.to_string().into();
            row
        });
        let steps = total.delays.steps();
        let histogram = steps.iter().enumerate().filter(|(_, count)| **count > 0).map(|(step, count)| {
            json!({
                "from_ms": if step == 0 { 0.0 } else { ms(STEPS_NS[step] as f64) },
                "to_ms": STEPS_NS.get(step + 1).map(|to| ms(*to as f64)),
                "count": count,
            })
        });
        let mut value = json!({
            "from": self.options.from,
            "to": self.options.to,
            "within_ms": ms(self.options.within_ns as f64),
            "total": object(total),
            "ids": ids.collect::<Vec<_>>(),
            "histogram": histogram.collect::<Vec<_>>(),
            "not_expected": not_expected,
            "beyond": beyond,
            "step_ms": step_ns.map(|step| ms(step as f64)),
            "uncounted": uncounted,
            "clock_breaks": breaks,
        });
        missing.put_into(&mut value);
        value
    }
}

fn row(name: &str, figures: &Figures, out: &mut impl Write) -> std::io::Result<()> {
    let delays = &figures.delays;
    let values = [
        delays.min_ns().map(|ns| ns as f64),
        delays.mean_ns(),
        delays.percentile_ns(50.0).map(|ns| ns as f64),
        delays.percentile_ns(99.0).map(|ns| ns as f64),
        delays.max_ns().map(|ns| ns as f64),
    ];
    let values = values.map(|ns| ns.map_or_else(|| "-".to_owned(), |ns| format!("{:.3}", ms(ns))));
    write!(out, "{name:<8} {:>8} {:>8} {:>8}", figures.matched, figures.missing, figures.extra)?;
    values.iter().try_for_each(|value| write!(out, " {value:>9}"))?;
    writeln!(out)
}

/// A bar for each step from the first to the last that has any.
fn histogram(delays: &Delays, out: &mut impl Write) -> std::io::Result<()> {
    let steps = delays.steps();
    let Some(first) = steps.iter().position(|count| *count > 0) else { return Ok(()) };
    let last = steps.iter().rposition(|count| *count > 0).unwrap_or(first);
    let most = steps.iter().copied().max().unwrap_or(1);
    writeln!(out)?;
    for (from, count) in STEPS_NS.iter().zip(steps).take(last + 1).skip(first) {
        let bar = (*count * BAR as u64).div_ceil(most);
        let bar = "#".repeat(usize::try_from(bar).unwrap_or(BAR));
        writeln!(out, "{:>9} ms  {bar:<BAR$} {count}", ms(*from as f64))?;
    }
    Ok(())
}

fn object(figures: &Figures) -> Value {
    let Figures {
        matched, missing, extra, replaced, undecided, ambiguous, late, repeated, by_device, ..
    } = figures;
    let delays = &figures.delays;
    let delay = delays.min_ns().map(|min| {
        let mut delay = json!({
            "min": ms(min as f64),
            "mean": delays.mean_ns().map(ms),
            "max": delays.max_ns().map(|ns| ms(ns as f64)),
        });
        for (name, percent) in PERCENTILES {
            delay[name] = delays.percentile_ns(percent).map(|ns| ms(ns as f64)).into();
        }
        delay
    });
    json!({
        "matched": matched,
        "missing": missing,
        "extra": extra,
        "replaced": replaced,
        "undecided": { "start": undecided.start, "end": undecided.end, "loss": undecided.loss },
        "ambiguous": ambiguous,
        "late": late,
        "repeated": repeated,
        "shortest_repeat_ms": figures.shortest_repeat_ns.map(|ns| ms(ns as f64)),
        "delay_ms": delay,
        "by_device": by_device,
    })
}
