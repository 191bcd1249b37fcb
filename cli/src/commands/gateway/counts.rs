//! What a device's gateway has done, as text and as JSON.

use std::fmt::Write as _;
use std::io::Write;

use cantap::wire::message::{FrameKind, GatewayEnd, GatewayRule, GatewayState, RuleCounts};
use cantap::wire::{CHANNELS, Channel};
use cantap::{Device, DeviceError};
use cantap_work::gateway::Rules;
use serde_json::{Value, json};

/// The rules that the device has, for people: those of a file, or one for each of its places.
pub struct Named {
    rows: Vec<Row>,
    /// For each channel that receives, the rows that the device's places belong to.
    places: [Vec<usize>; CHANNELS],
}

struct Row {
    name: String,
    /// In the file, if there is one.
    line: Option<u32>,
    from: Channel,
    drops: bool,
}

impl Named {
    /// A file's.
    pub fn of_file(rules: &Rules) -> Self {
        let row = |(number, rule): (usize, &cantap_work::gateway::Rule)| Row {
            name: rule.name.clone(),
            line: Some(rule.line),
            from: rule.from,
            drops: rules.drops(number),
        };
        Self {
            rows: rules.rules.iter().enumerate().map(row).collect(),
            places: Channel::ALL.map(|from| rules.places(from).collect()),
        }
    }

    /// Those that a device has.
    pub fn of_device(device: &Device) -> Result<Self, DeviceError> {
        let (mut rows, mut places) = (Vec::new(), [Vec::new(), Vec::new()]);
        for from in Channel::ALL {
            for rule in device.gateway_rules(from)? {
                places[from.index()].push(rows.len());
                rows.push(Row { name: name(&rule), line: None, from, drops: rule.pass.is_none() });
            }
        }
        Ok(Self { rows, places })
    }
}

/// A rule without a name is called by its filter, as identifier and mask.
fn name(rule: &GatewayRule) -> String {
    let filter = &rule.filter;
    let width = if filter.extended { 8 } else { 3 };
    let kind = match filter.kind {
        FrameKind::Data => " data",
        FrameKind::Remote => " remote",
        FrameKind::Any => "",
    };
    format!("{:0width$X}:{:0width$X}{kind}", filter.id, filter.mask)
}

/// Sums of all rules of a direction, or of all parts of a rule. Wider than the device's counters, which wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Sums {
    matched: u64,
    sent: u64,
    dropped: u64,
    replaced: u64,
    lost: u64,
    failed: u64,
}

impl Sums {
    fn add(&mut self, counts: &RuleCounts, drops: bool) {
        self.matched += u64::from(counts.matched);
        self.sent += u64::from(counts.sent);
        self.dropped += if drops { u64::from(counts.matched) } else { 0 };
        self.replaced += u64::from(counts.overtaken);
        self.lost += u64::from(counts.lost);
        self.failed += u64::from(counts.failed);
    }
}

/// One direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Direction {
    sums: Sums,
    unmatched: u64,
    waiting: u16,
}

/// What was counted until one moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Counts {
    /// What the gateway does.
    pub state: GatewayState,
    /// Whether it needs no host.
    pub standalone: bool,
    directions: [Direction; CHANNELS],
    rows: Vec<Sums>,
}

impl Counts {
    /// Asks the device.
    pub fn of(device: &Device, named: &Named) -> Result<Self, DeviceError> {
        let mut counts = Self {
            state: GatewayState::Off,
            standalone: false,
            directions: Default::default(),
            rows: vec![Sums::default(); named.rows.len()],
        };
        for from in Channel::ALL {
            let places = &named.places[from.index()];
            let direction = &mut counts.directions[from.index()];
            let mut first = 0;
            loop {
                let status = device.gateway_status(from, first)?;
                (counts.state, counts.standalone) = (status.state, status.standalone);
                (direction.unmatched, direction.waiting) = (status.unmatched.into(), status.waiting);
                for (place, sums) in places.iter().skip(first.into()).zip(&status.counts) {
                    let drops = named.rows[*place].drops;
                    direction.sums.add(sums, drops);
                    counts.rows[*place].add(sums, drops);
                }
                first = first.saturating_add(status.counts.len() as u8);
                if status.counts.is_empty() || first >= status.rules {
                    break;
                }
            }
        }
        Ok(counts)
    }

    /// On one line.
    pub fn line(&self) -> String {
        let direction = |from: Channel| {
            let Direction { sums, unmatched, waiting } = &self.directions[from.index()];
            let mut text = format!(
                "{}>{}: {} received, {} sent",
                from.number(),
                to(from),
                sums.matched + unmatched,
                sums.sent
            );
            for (count, of) in [
                (*unmatched, "unmatched"),
                (sums.dropped, "dropped"),
                (sums.replaced, "replaced"),
                (sums.lost, "LOST"),
                (sums.failed, "FAILED"),
                (u64::from(*waiting), "waiting"),
            ] {
                if count > 0 {
                    let _ = write!(text, ", {count} {of}");
                }
            }
            text
        };
        Channel::ALL.map(direction).join("; ")
    }

    /// One row for each rule, and one for each direction.
    pub fn print(&self, named: &Named, out: &mut impl Write) -> std::io::Result<()> {
        let titles = ["matched", "sent", "dropped", "replaced", "lost", "failed"];
        write!(out, "{:<4} {:<20}", "from", "rule")?;
        titles.iter().try_for_each(|title| write!(out, " {title:>8}"))?;
        writeln!(out)?;
        let mut row = |from: Channel, name: &str, sums: &Sums| {
            let Sums { matched, sent, dropped, replaced, lost, failed } = sums;
            write!(out, "{:<4} {name:<20}", from.number())?;
            [matched, sent, dropped, replaced, lost, failed]
                .iter()
                .try_for_each(|count| write!(out, " {count:>8}"))?;
            writeln!(out)
        };
        for (Row { name, from, .. }, sums) in named.rows.iter().zip(&self.rows) {
            row(*from, name, sums)?;
        }
        Channel::ALL.into_iter().try_for_each(|from| row(from, "all", &self.directions[from.index()].sums))
    }

    /// As JSON. `missed` are the frames that the controllers lost before the gateway saw them.
    pub fn object(&self, named: &Named, missed: [u64; CHANNELS]) -> Value {
        let directions = Channel::ALL.map(|from| {
            let Direction { sums, unmatched, waiting } = &self.directions[from.index()];
            let mut value = sums.object();
            value["from"] = from.number().into();
            value["to"] = to(from).into();
            value["received"] = (sums.matched + unmatched).into();
            value["unmatched"] = (*unmatched).into();
            value["waiting"] = (*waiting).into();
            value["lost_controller"] = missed[from.index()].into();
            value
        });
        let rules = named.rows.iter().zip(&self.rows).map(|(row, sums)| {
            let mut value = sums.object();
            value["rule"] = row.name.clone().into();
            value["line"] = row.line.into();
            value["from"] = row.from.number().into();
            value
        });
        json!({
            "state": state_name(self.state),
            "standalone": self.standalone,
            "directions": directions,
            "rules": rules.collect::<Vec<_>>(),
        })
    }
}

impl Sums {
    fn object(&self) -> Value {
        let Self { matched, sent, dropped, replaced, lost, failed } = self;
        json!({
            "matched": matched,
            "sent": sent,
            "dropped": dropped,
            "replaced": replaced,
            "lost": lost,
            "failed": failed,
        })
    }
}

/// The channel that sends.
const fn to(from: Channel) -> u8 {
    match from {
        Channel::Can1 => Channel::Can2.number(),
        Channel::Can2 => Channel::Can1.number(),
    }
}

const fn state_name(state: GatewayState) -> &'static str {
    match state {
        GatewayState::Off => "off",
        GatewayState::Running => "running",
        GatewayState::Ended(GatewayEnd::Loop) => "loop",
        GatewayState::Ended(GatewayEnd::ChannelClosed) => "channel closed",
    }
}
