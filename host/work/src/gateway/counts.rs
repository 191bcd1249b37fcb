//! What a device's gateway has done.

use cantap::wire::message::{FrameKind, GatewayEnd, GatewayRule, GatewayState, RuleCounts};
use cantap::wire::{CHANNELS, Channel};
use cantap::{Device, DeviceError};
use serde_json::{Value, json};

use super::{Rule, Rules};

/// The rules that the device has, for people: those of a file, or one for each of its places.
pub struct Named {
    /// In the file's order, or in that of the device's places.
    pub rows: Vec<Row>,
    /// For each channel that receives, the rows that the device's places belong to.
    places: [Vec<usize>; CHANNELS],
}

/// A rule of a gateway.
pub struct Row {
    /// As the file calls it; otherwise its filter.
    pub name: String,
    /// In the file, if there is one.
    pub line: Option<u32>,
    /// The channel that receives.
    pub from: Channel,
    /// Whether it drops what it matches.
    pub drops: bool,
}

impl Named {
    /// A file's.
    pub fn of_file(rules: &Rules) -> Self {
        let row = |(number, rule): (usize, &Rule)| Row {
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
pub struct Sums {
    /// Frames that a rule matched: the sum of the following, apart from those that wait.
    pub matched: u64,
    /// Confirmed by the controller.
    pub sent: u64,
    /// As the rule says.
    pub dropped: u64,
    /// By a newer one within the rule's period.
    pub replaced: u64,
    /// More than the other bus took, or still waiting at the end.
    pub lost: u64,
    /// Given up by the controller, or with the channel.
    pub failed: u64,
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
pub struct Direction {
    /// Of all its rules.
    pub sums: Sums,
    /// Frames that no rule matched.
    pub unmatched: u64,
    /// Frames on their way.
    pub waiting: u16,
}

/// What was counted until one moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Counts {
    /// What the gateway does.
    pub state: GatewayState,
    /// Whether it needs no host.
    pub standalone: bool,
    /// By the channel that receives.
    pub directions: [Direction; CHANNELS],
    /// As in [`Named::rows`].
    pub rows: Vec<Sums>,
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

    /// As JSON. `missed` are the frames that the controllers lost before the gateway saw them.
    pub fn object(&self, named: &Named, missed: [u64; CHANNELS]) -> Value {
        let directions = Channel::ALL.map(|from| {
            let Direction { sums, unmatched, waiting } = &self.directions[from.index()];
            let mut value = sums.object();
            value["from"] = from.number().into();
            value["to"] = other_number(from).into();
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
pub const fn other_number(from: Channel) -> u8 {
    match from {
        Channel::Can1 => Channel::Can2.number(),
        Channel::Can2 => Channel::Can1.number(),
    }
}

/// Its name in text and JSON.
pub const fn state_name(state: GatewayState) -> &'static str {
    match state {
        GatewayState::Off => "off",
        GatewayState::Running => "running",
        GatewayState::Ended(GatewayEnd::Loop) => "loop",
        GatewayState::Ended(GatewayEnd::ChannelClosed) => "channel closed",
    }
}
