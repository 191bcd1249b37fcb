//! Finds which moments of two traces really are the same: those whose times agree with their neighbours'.

use super::sketch::Pair;

/// Two clocks differ in speed by less than this: crystals by 0.01 %, an operating system that slews its clock
/// by 0.05 %.
pub(super) const MOST_DRIFT: f64 = 1e-3;
/// Fewer moments agreeing with each other may be chance.
pub(super) const FEWEST: usize = 8;
/// How many chains are followed at a time.
const MOST_OPEN: usize = 64;

/// Moments in order of time, each consistent with the one before.
#[derive(Clone, Debug)]
pub(super) struct Chain {
    pub pairs: Vec<Pair>,
}

impl Chain {
    /// Whether the pair can follow: the change in the clocks' difference is no more than drift and the stamps' own
    /// error explain.
    fn takes(&self, pair: &Pair, slack_ns: i64) -> bool {
        let Some(last) = self.pairs.last() else { return true };
        let (a, b) = (pair.a_ns - last.a_ns, pair.b_ns - last.b_ns);
        let allowed = slack_ns as f64 + a as f64 * MOST_DRIFT;
        ((b - a) as f64).abs() <= allowed
    }

    fn overlaps(&self, other: &Self) -> bool {
        let apart = |of: fn(&Pair) -> i64| {
            let (mine, its) = (self.span(of), other.span(of));
            mine.1 <= its.0 || its.1 <= mine.0
        };
        !(apart(|pair| pair.a_ns) && apart(|pair| pair.b_ns))
    }

    fn span(&self, of: fn(&Pair) -> i64) -> (i64, i64) {
        (self.pairs.first().map_or(0, of), self.pairs.last().map_or(0, of))
    }
}

/// Why no chain can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unclear {
    /// Too few moments are consistent with each other.
    TooFew,
    /// More than one answer is possible.
    Ambiguous,
}

/// The chains that cover the common time of both traces: one, or more if a clock was set meanwhile.
pub(super) fn chains(pairs: &[Pair], slack_ns: i64) -> Result<Vec<Chain>, Unclear> {
    let mut open: Vec<Chain> = Vec::new();
    let mut closed: Vec<Chain> = Vec::new();
    for pair in pairs {
        let fitting = open.iter_mut().filter(|chain| chain.takes(pair, slack_ns));
        if let Some(chain) = fitting.max_by_key(|chain| chain.pairs.len()) {
            chain.pairs.push(*pair);
            continue;
        }
        if open.len() == MOST_OPEN
            && let Some(shortest) = (0..open.len()).min_by_key(|&chain| open[chain].pairs.len())
        {
            closed.push(open.swap_remove(shortest));
        }
        open.push(Chain { pairs: vec![*pair] });
    }
    closed.append(&mut open);
    closed.retain(|chain| chain.pairs.len() >= FEWEST);
    closed.sort_by_key(|chain| std::cmp::Reverse(chain.pairs.len()));
    let mut chosen: Vec<Chain> = Vec::new();
    for chain in closed {
        match chosen.iter().find(|better| better.overlaps(&chain)) {
            None => chosen.push(chain),
            // Nearly as good, and not at the same time: it is impossible to tell which is right.
            Some(better) if chain.pairs.len() * 2 > better.pairs.len() => return Err(Unclear::Ambiguous),
            Some(_) => {}
        }
    }
    if chosen.is_empty() {
        return Err(Unclear::TooFew);
    }
    chosen.sort_by_key(|chain| chain.pairs[0].b_ns);
    Ok(chosen)
}
