//! Values again and again: asked for one by one, or sent by the ECU itself.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap_protocols::{Event, EventKind, Field, Value};
use cantap_work::calibration::{Master, RunningList};
use cantap_work::interrupt;

use super::rows::{Row, Rows};
use super::targets::Target;
use crate::args;

/// How often to look for what has come, and for Ctrl-C.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Reading again and again.
#[derive(clap::Args)]
pub struct PollArgs {
    /// As for read.
    #[arg(required = true, value_name = "NAME|ADDRESS:LENGTH")]
    pub what: Vec<String>,
    /// From one reading of all to the next; 0 for as often as the ECU answers.
    #[arg(long, value_name = "TIME", default_value = "100ms", value_parser = args::duration)]
    every: Duration,
    /// How many times.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// End after this time. Without this and --count, it continues until Ctrl-C.
    #[arg(long = "for", value_name = "TIME", value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// Print comma-separated values.
    #[arg(long)]
    pub csv: bool,
}

/// A list that the ECU sends.
#[derive(clap::Args)]
pub struct DaqArgs {
    /// As for read.
    #[arg(required = true, value_name = "NAME|ADDRESS:LENGTH")]
    pub what: Vec<String>,
    /// The number of the ECU's event with which it sends; info shows which there are.
    #[arg(long, value_name = "N", default_value = "0")]
    event: u16,
    /// How many samples.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// End after this time. Without this and --count, it continues until Ctrl-C.
    #[arg(long = "for", value_name = "TIME", value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// Print comma-separated values.
    #[arg(long)]
    pub csv: bool,
}

fn columns(targets: &[Target]) -> Vec<String> {
    targets.iter().flat_map(|target| target.columns.clone()).collect()
}

impl PollArgs {
    /// Polls until it ends.
    pub fn run(&self, targets: &[Target], master: &mut Master<'_>, json: bool) -> anyhow::Result<()> {
        let mut rows = Rows::table(columns(targets), json, self.csv, false);
        let started = Instant::now();
        let mut due = Duration::ZERO;
        while !interrupt::requested() {
            let mut row = Row::default();
            master.take_events();
            for target in targets {
                let read = master.read(target.extension, target.address, target.length);
                // Ctrl-C is the usual end, also in the middle of a reading.
                if read.is_err() && interrupt::requested() {
                    return Ok(());
                }
                row.values.extend(target.fields(&read?, master.order()));
            }
            row.time_ns = master.take_events().last().map_or(0, |event| event.time_ns);
            rows.write(&row)?;
            due = (due + self.every).max(started.elapsed());
            let is_over = self.count.is_some_and(|count| rows.written() >= count)
                || self.time.is_some_and(|time| due > time);
            if is_over {
                break;
            }
            master.speaking.listen(due.saturating_sub(started.elapsed()))?;
        }
        Ok(())
    }
}

/// Puts the packets of a list together to rows.
struct Collector {
    columns: Vec<String>,
    daq: i64,
    packets: usize,
    /// The row that is being filled, and its next packet.
    open: Option<(Row, usize)>,
    /// Rows that lack a packet.
    broken: u64,
    /// Packets that are of no list that was set up.
    unknown: u64,
}

impl Collector {
    fn new(columns: Vec<String>, list: &RunningList) -> Self {
        Self { columns, daq: list.daq.into(), packets: list.packets.len(), open: None, broken: 0, unknown: 0 }
    }

    /// Takes a packet; returns the rows that are complete, or will not be.
    fn take(&mut self, event: &Event) -> Vec<Row> {
        let number = |name: &str| event.field(name).and_then(|field| field.value.as_number());
        let (Some(daq), Some(odt)) = (number("daq"), number("odt")) else {
            self.unknown += 1;
            return Vec::new();
        };
        if daq as i64 != self.daq {
            return Vec::new();
        }
        let odt = odt as usize;
        let mut done = Vec::new();
        if odt == 0 || self.open.as_ref().is_none_or(|(_, next)| *next != odt) {
            done.extend(self.give_up());
            let values = vec![None; self.columns.len()];
            let row = Row { time_ns: event.time_ns, stamp_us: number("stamp"), values };
            self.broken += u64::from(odt != 0);
            self.open = Some((row, odt));
        }
        let Some((row, next)) = &mut self.open else { return done };
        for (column, value) in self.columns.iter().zip(&mut row.values) {
            if let Some(field) = event.fields.iter().find(|field| field.name == *column) {
                *value = Some(field.clone());
            }
        }
        *next = odt + 1;
        if *next >= self.packets {
            done.extend(self.open.take().map(|(row, _)| row));
        }
        done
    }

    /// The row that nothing more comes to.
    fn give_up(&mut self) -> Option<Row> {
        let (row, _) = self.open.take()?;
        self.broken += 1;
        Some(row)
    }
}

impl DaqArgs {
    /// Has the ECU send until it ends.
    pub fn run(&self, targets: &[Target], master: &mut Master<'_>, json: bool) -> anyhow::Result<()> {
        let values: Vec<_> = targets.iter().flat_map(Target::sampled).collect();
        let list = master.start_list(&values, self.event)?;
        // What is in a map that may have fewer points, a listener does not know.
        let by_address: HashMap<_, _> = targets.iter().flat_map(Target::by_address).collect();
        let order = master.order();
        let mut rows = Rows::table(columns(targets), json, self.csv, !master.is_ccp());
        let mut collector = Collector::new(columns(targets), &list);
        let started = Instant::now();
        let mut is_over = false;
        while !is_over && !interrupt::requested() {
            let left = self.time.map(|time| time.saturating_sub(started.elapsed()));
            is_over = left.is_some_and(|left| left.is_zero());
            master.speaking.listen(left.unwrap_or(LOOK_EVERY).min(LOOK_EVERY))?;
            for mut event in master.take_events() {
                for field in &mut event.fields {
                    if let Value::Bytes(bytes) = &field.value
                        && let Some((target, at)) = by_address.get(&*field.name)
                        && let Some(named) = target.field(*at, bytes, order)
                    {
                        *field = named;
                    }
                }
                if event.kind == EventKind::Notification {
                    eprintln!("cantap: the ECU reports {}{}", event.title, details(&event.fields));
                    // Nothing more comes.
                    is_over |= event.title == "EV_SESSION_TERMINATED";
                }
                if event.kind != EventKind::Periodic {
                    continue;
                }
                for row in collector.take(&event) {
                    if self.count.is_none_or(|count| rows.written() < count) {
                        rows.write(&row)?;
                    }
                }
                is_over |= self.count.is_some_and(|count| rows.written() >= count);
            }
        }
        let seconds = started.elapsed().as_secs_f64();
        if rows.written() == 0 {
            bail!(
                "the ECU sent nothing of its list in {seconds:.1} s; perhaps event {} does not occur: `info` shows the events",
                self.event
            );
        }
        let Collector { broken, unknown, .. } = collector;
        eprintln!("cantap: {} samples in {seconds:.1} s", rows.written());
        if broken + unknown > 0 {
            bail!("{broken} of them lack values, and {unknown} packets were not of this list");
        }
        Ok(())
    }
}

/// The fields of a report after its number.
fn details(fields: &[Field]) -> String {
    let rest = fields.iter().skip(1).map(ToString::to_string).collect::<Vec<_>>();
    if rest.is_empty() { String::new() } else { format!(": {}", rest.join(", ")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::Id;
    use cantap_protocols::{Party, Protocol};

    fn packet(odt: i64, field: Field) -> Event {
        let frame = "7F1#00".parse().unwrap();
        let event = cantap::TraceEvent::Frame { frame, direction: cantap_trace::Direction::Rx, late: false };
        let record = cantap::TraceRecord { time_ns: odt, device_ns: None, channel: 1, event };
        let mut event = Event::new(Protocol::Xcp, &record, EventKind::Periodic, "DAQ");
        event.from = Party::Id(Id::standard_truncated(0x7F1));
        event.fields = vec![Field::number("daq", 0), Field::number("odt", odt), field];
        event
    }

    #[test]
    fn a_sample_that_lacks_a_packet_is_a_row_with_a_hole() {
        let list = RunningList { daq: 0, packets: vec![vec![0], vec![1]] };
        let mut collector = Collector::new(vec!["A".to_owned(), "B".to_owned()], &list);
        let (a, b) = (|| packet(0, Field::number("A", 1)), || packet(1, Field::number("B", 2)));
        let mut rows = Vec::new();
        for event in [a(), b(), a(), a(), b(), b()] {
            rows.extend(
                collector
                    .take(&event)
                    .into_iter()
                    .map(|row| row.values.iter().map(Option::is_some).collect::<Vec<_>>()),
            );
        }
        assert_eq!(rows, [vec![true, true], vec![true, false], vec![true, true], vec![false, true]]);
        assert_eq!((collector.broken, collector.unknown), (2, 0));
    }
}
