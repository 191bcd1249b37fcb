//! Finds who answers whom.

use std::collections::{BTreeMap, BTreeSet};

use cantap_can::{Frame, Id};

use super::learner::{Key, Seen};
use super::role::Role;
use super::timing::Period;

/// An answer follows its request within this time.
const WITHIN_NS: u64 = 1_000_000_000;
/// The fewest frames of one that asks, and of one that answers.
const FEWEST: usize = 3;
/// The share of an answer's frames that follow a request, and of requests that are answered.
const ALWAYS: f64 = 0.9;
const OFTEN: f64 = 0.5;
/// An answer follows in a small part of the time between two requests; otherwise it follows by chance.
const AT_ONCE: f64 = 0.2;
/// Other identifiers that may lie between a request and its answer.
const BETWEEN: usize = 4;
/// The most identifiers of a channel that are looked at: those of diagnostics, then the most frequent.
const MAX_MEMBERS: usize = 256;
/// The most different requests, answers to one request, and frames of all answers of a script.
const MAX_REQUESTS: usize = 500;
const MAX_VARIANTS: usize = 32;
const MAX_FRAMES: usize = 20_000;

/// An answer: each frame with its time since the one before, the first since the request, in nanoseconds.
pub type Answer = Vec<(u64, Frame)>;

/// Some identifiers ask, others answer.
#[derive(Clone, Debug, Default)]
pub struct Exchange {
    /// From 1.
    pub channel: u8,
    /// Who asks.
    pub requests: Vec<Id>,
    /// Who answers.
    pub answers: Vec<Id>,
    /// The answers to each request, in the order of the trace; a key of two requests is for the second after the first.
    pub table: BTreeMap<(Option<FrameText>, FrameText), Vec<Answer>>,
    /// Each request with its time since the one before, the first since the trace began, in nanoseconds.
    pub asked: Vec<(u64, Frame)>,
}

/// A frame by its text, which is what scripts compare.
pub type FrameText = String;

/// Why each identifier sends.
pub struct Roles {
    /// For each.
    pub of: Vec<Role>,
    /// For each, the group of requests and answers that it belongs to.
    group: Vec<Option<usize>>,
}

/// What was counted for one that asks and one that answers.
#[derive(Clone, Default)]
struct Follows {
    answers: usize,
    requests: usize,
    latencies_ns: Vec<u64>,
}

/// Finds requests and answers among identifiers.
pub fn roles(streams: &[(&Key, &Vec<Seen>)], periods: &[Option<Period>]) -> Roles {
    let mut roles = Roles { of: vec![Role::Sender; streams.len()], group: vec![None; streams.len()] };
    let mut found: Vec<(f64, usize, usize)> = Vec::new();
    for channel in [1, 2] {
        let mut ours: Vec<usize> = (0..streams.len())
            .filter(|at| streams[*at].0.channel == channel && streams[*at].1.len() >= FEWEST)
            .filter(|at| periods[*at].is_none() || is_diagnostic(streams[*at].0.id))
            .collect();
        ours.sort_by_key(|at| (!is_diagnostic(streams[*at].0.id), std::cmp::Reverse(streams[*at].1.len())));
        ours.truncate(MAX_MEMBERS);
        let follows = count(streams, &ours);
        for (&(request, answer), counted) in &follows {
            let (asked, answered) = (streams[request].1, streams[answer].1);
            let by_convention = is_pair(streams[request].0.id, streams[answer].0.id);
            let is_periodic = periods[request].is_some() || periods[answer].is_some();
            if !by_convention && (is_periodic || is_same_node(streams[request].0.id, streams[answer].0.id)) {
                continue;
            }
            let share = counted.answers as f64 / answered.len() as f64;
            let often = counted.requests as f64 / asked.len() as f64;
            if share >= ALWAYS && often >= OFTEN && (is_at_once(counted, asked) || by_convention) {
                let back = follows.get(&(answer, request));
                let opposite = back.map_or(0.0, |back| back.answers as f64 / asked.len() as f64);
                let is_first = asked[0].order < answered[0].order;
                if share > opposite || is_first {
                    found.push((share + f64::from(u8::from(by_convention)), request, answer));
                }
            }
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    for (_, request, answer) in found {
        if roles.of[request] == Role::Answer || roles.of[answer] == Role::Request {
            continue;
        }
        (roles.of[request], roles.of[answer]) = (Role::Request, Role::Answer);
        let group = roles.group[request].or(roles.group[answer]).unwrap_or(request);
        // Two groups with something in common are one.
        let merged = roles.group[answer].unwrap_or(group);
        roles.group.iter_mut().filter(|each| **each == Some(merged)).for_each(|each| *each = Some(group));
        (roles.group[request], roles.group[answer]) = (Some(group), Some(group));
    }
    roles
}

/// Whether answers come in a small part of the time between requests.
fn is_at_once(counted: &Follows, asked: &[Seen]) -> bool {
    let median = |mut values: Vec<u64>| {
        values.sort_unstable();
        values.get(values.len() / 2).copied().unwrap_or_default()
    };
    let between = median(asked.windows(2).map(|pair| pair[1].at_ns - pair[0].at_ns).collect());
    let latency = median(counted.latencies_ns.clone());
    latency as f64 <= AT_ONCE * between as f64
}

/// How often frames of one identifier follow those of another.
fn count(streams: &[(&Key, &Vec<Seen>)], ours: &[usize]) -> BTreeMap<(usize, usize), Follows> {
    let mut events: Vec<(u32, u64, u32, usize)> = ours
        .iter()
        .flat_map(|at| streams[*at].1.iter().map(|seen| (seen.order, seen.at_ns, seen.stretch, *at)))
        .collect();
    events.sort_unstable();
    let mut follows: BTreeMap<(usize, usize), Follows> = BTreeMap::new();
    // The last frame of each identifier, the newest first, and who followed it.
    let mut last: Vec<(usize, u64, u32, BTreeSet<usize>)> = Vec::new();
    for (_, at_ns, stretch, this) in events {
        for (other, since_ns, other_stretch, followed) in
            last.iter_mut().filter(|(other, ..)| *other != this).take(BETWEEN)
        {
            if *other_stretch != stretch || at_ns - *since_ns > WITHIN_NS {
                continue;
            }
            let counted = follows.entry((*other, this)).or_default();
            counted.answers += 1;
            if followed.insert(this) {
                counted.requests += 1;
                counted.latencies_ns.push(at_ns - *since_ns);
            }
        }
        last.retain(|(other, ..)| *other != this);
        last.insert(0, (this, at_ns, stretch, BTreeSet::new()));
        last.truncate(2 * BETWEEN);
    }
    follows
}

/// Whether two identifiers have the same source address, as far as 29 bits are J1939's: a node does not answer itself.
fn is_same_node(a: Id, b: Id) -> bool {
    a.is_extended() && b.is_extended() && a.raw() & 0xFF == b.raw() & 0xFF
}

/// Whether standards give an identifier to diagnostics, which may be asked for periodically.
fn is_diagnostic(id: Id) -> bool {
    match (id.is_extended(), id.raw()) {
        (false, raw) => (0x7DF..=0x7EF).contains(&raw) || (0x581..=0x67F).contains(&raw),
        (true, raw) => matches!(raw >> 16 & 0xFF, 0xDA | 0xDB) && raw >> 26 == 6,
    }
}

/// Whether standards let one identifier answer the other: OBD and UDS as ISO 15765-4 has them, CANopen's SDO.
fn is_pair(request: Id, answer: Id) -> bool {
    let (asks, answers) = (request.raw(), answer.raw());
    match (request.is_extended(), answer.is_extended()) {
        (false, false) => match asks {
            0x7DF => (0x7E8..=0x7EF).contains(&answers),
            0x7E0..=0x7E7 => answers == asks + 8,
            0x601..=0x67F => answers + 0x80 == asks,
            _ => false,
        },
        (true, true) if asks >> 16 == 0x18DA => {
            answers == 0x18DA_0000 | (asks & 0xFF) << 8 | asks >> 8 & 0xFF
        }
        (true, true) if asks >> 16 == 0x18DB => answers >> 16 == 0x18DA && answers >> 8 & 0xFF == asks & 0xFF,
        _ => false,
    }
}

/// Learns the answers, and returns how many of their frames were left out.
pub fn learn(streams: &[(&Key, &Vec<Seen>)], roles: &Roles) -> (Vec<Exchange>, usize) {
    let groups: BTreeSet<usize> = roles.group.iter().copied().flatten().collect();
    let mut room = MAX_FRAMES;
    let mut omitted = 0;
    let exchanges = groups.into_iter().map(|group| {
        let members: Vec<usize> = (0..streams.len()).filter(|at| roles.group[*at] == Some(group)).collect();
        // An identifier's data frames and remote frames may both ask.
        let ids = |role: Role| -> Vec<Id> {
            let with = members.iter().filter(|at| roles.of[**at] == role).map(|at| streams[*at].0.id);
            with.collect::<BTreeSet<_>>().into_iter().collect()
        };
        let mut exchange = Exchange {
            channel: streams[members[0]].0.channel,
            requests: ids(Role::Request),
            answers: ids(Role::Answer),
            ..Exchange::default()
        };
        let mut events: Vec<(Seen, Role)> =
            members.iter().flat_map(|at| streams[*at].1.iter().map(|seen| (*seen, roles.of[*at]))).collect();
        events.sort_unstable_by_key(|(seen, _)| seen.order);
        omitted += exchange.take(&events, &mut room);
        exchange
    });
    let exchanges = exchanges.collect();
    (exchanges, omitted)
}

impl Exchange {
    /// Takes the frames of requests and answers; returns how many were too many.
    fn take(&mut self, events: &[(Seen, Role)], room: &mut usize) -> usize {
        let mut omitted = 0;
        let mut before: Option<String> = None;
        let mut asked_ns = 0;
        let mut under_way: Option<(Seen, u64, Answer)> = None;
        let mut all: Vec<(Option<String>, String, Answer)> = Vec::new();
        for (seen, role) in events {
            if *role == Role::Request {
                if let Some((request, _, answer)) = under_way.take() {
                    let text = request.frame.to_string();
                    all.push((before.replace(text.clone()), text, answer));
                }
                if *room > 0 {
                    *room -= 1;
                    self.asked.push((seen.at_ns - std::mem::replace(&mut asked_ns, seen.at_ns), seen.frame));
                } else {
                    omitted += 1;
                }
                under_way = Some((*seen, seen.at_ns, Vec::new()));
            } else {
                match &mut under_way {
                    Some((request, last_ns, answer))
                        if request.stretch == seen.stretch
                            && seen.at_ns - *last_ns <= WITHIN_NS
                            && *room > 0 =>
                    {
                        *room -= 1;
                        answer.push((seen.at_ns - std::mem::replace(last_ns, seen.at_ns), seen.frame));
                    }
                    // Nobody asked, or nobody knows who did.
                    _ => omitted += 1,
                }
            }
        }
        if let Some((request, _, answer)) = under_way {
            all.push((before, request.frame.to_string(), answer));
        }
        omitted + self.arrange(all)
    }

    /// A request that has the same answers whatever was before it needs no more than itself.
    fn arrange(&mut self, all: Vec<(Option<String>, String, Answer)>) -> usize {
        let mut omitted = 0;
        let mut by_request: BTreeMap<String, Vec<(Option<String>, Answer)>> = BTreeMap::new();
        for (before, request, answer) in all {
            by_request.entry(request).or_default().push((before, answer));
        }
        for (request, answers) in by_request {
            let mut contexts: BTreeMap<Option<String>, Vec<Answer>> = BTreeMap::new();
            for (before, answer) in &answers {
                let variants = contexts.entry(before.clone()).or_default();
                // The same again says nothing new.
                if !variants.iter().any(|variant| frames(variant) == frames(answer)) {
                    variants.push(answer.clone());
                }
            }
            let distinct = |variants: &Vec<Answer>| variants.iter().map(frames).collect::<BTreeSet<_>>();
            let first = contexts.values().next().map(distinct).unwrap_or_default();
            let is_same = contexts.values().all(|variants| distinct(variants) == first);
            if !is_same {
                let contexts =
                    contexts.into_iter().filter_map(|(before, variants)| Some((before?, variants)));
                for (before, variants) in contexts {
                    omitted += self.put((Some(before), request.clone()), variants);
                }
            }
            // In turn, as they were.
            let mut variants: Vec<Answer> = Vec::new();
            for (_, answer) in answers {
                if variants.last().is_none_or(|last| frames(last) != frames(&answer)) {
                    variants.push(answer);
                }
            }
            omitted += self.put((None, request), variants);
        }
        omitted
    }

    fn put(&mut self, key: (Option<String>, String), mut variants: Vec<Answer>) -> usize {
        let mut rest = variants.split_off(variants.len().min(MAX_VARIANTS));
        if variants.iter().all(Vec::is_empty) {
            return 0;
        }
        if self.table.len() < MAX_REQUESTS {
            self.table.insert(key, variants);
        } else {
            rest.append(&mut variants);
        }
        rest.iter().map(Vec::len).sum()
    }
}

/// What an answer says, whenever.
fn frames(answer: &Answer) -> Vec<String> {
    answer.iter().map(|(_, frame)| frame.to_string()).collect()
}
