//! Which identifiers makers use for diagnostics: rules that are data, with their sources, in `data/diagnostic-pairs.csv`.
//!
//! A rule makes nothing a conversation by itself, unless it was asked for by its maker's name. Where frames look like a request and its
//! answer, one exchange is enough if they follow a rule.

use std::fmt;
use std::str::FromStr;
use std::sync::LazyLock;

use cantap_trace::Id;

use super::pairs::{BadPair, Endpoint, Pair};

const TABLE: &str = include_str!("../../data/diagnostic-pairs.csv");

/// The rules of the table.
static RULES: LazyLock<Vec<Rule>> =
    LazyLock::new(|| TABLE.lines().filter(|line| !line.starts_with('#')).filter_map(Rule::parse).collect());

/// A maker whose rules are in the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Maker(&'static str);

/// Pairs that are known beforehand: one, or all of a maker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KnownPairs {
    /// These two.
    One(Pair),
    /// Whoever follows the maker's rules.
    Of(Maker),
}

/// What the first data byte is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Address {
    /// None: the identifier is enough.
    No,
    /// An address that the answer repeats.
    Same,
    /// The receiver's. Answers are at the base plus the address, and have the low byte of the request's identifier.
    Target,
}

/// One line of the table.
#[derive(Clone, Debug)]
pub(super) struct Rule {
    maker: &'static str,
    first: Id,
    last: Id,
    /// From the request's identifier to the answer's; for [`Address::Target`] the base.
    answers: i32,
    address: Address,
    /// Requests that any server may answer.
    to_all: Vec<Endpoint>,
}

impl Maker {
    /// All of the table, in its order.
    pub fn all() -> Vec<Self> {
        let mut all: Vec<Self> = Vec::new();
        for rule in RULES.iter() {
            if !all.contains(&Self(rule.maker)) {
                all.push(Self(rule.maker));
            }
        }
        all
    }

    /// The names of all, with commas.
    pub fn names() -> String {
        Self::all().iter().map(|maker| maker.name()).collect::<Vec<_>>().join(", ")
    }

    /// Its name, in lower case.
    pub const fn name(self) -> &'static str {
        self.0
    }
}

/// The addresses of one rule.
pub(crate) struct AddressRange {
    /// What is asked, and who answers it.
    pub requests: Vec<(Endpoint, Endpoint)>,
    /// What any server may answer.
    pub to_all: Vec<Endpoint>,
}

impl Maker {
    /// All addresses of its rules.
    pub(crate) fn ranges(self) -> impl Iterator<Item = AddressRange> {
        rules_of(self).map(|rule| {
            let requests = rule.requests().filter_map(|request| Some((request, rule.server(request)?)));
            AddressRange { requests: requests.collect(), to_all: rule.to_all.clone() }
        })
    }
}

/// A text that is neither a pair nor a maker.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}; or a maker, for all of its pairs: {names}", names = Maker::names())]
pub struct BadPairs(#[from] BadPair);

impl FromStr for KnownPairs {
    type Err = BadPairs;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let maker = Maker::all().into_iter().find(|maker| maker.name().eq_ignore_ascii_case(text));
        match maker {
            Some(maker) => Ok(Self::Of(maker)),
            None => Ok(Self::One(text.parse::<Pair>()?)),
        }
    }
}

impl fmt::Display for KnownPairs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::One(pair) => pair.fmt(f),
            Self::Of(maker) => f.write_str(maker.name()),
        }
    }
}

impl From<Pair> for KnownPairs {
    fn from(pair: Pair) -> Self {
        Self::One(pair)
    }
}

/// All rules.
pub(super) fn rules() -> &'static [Rule] {
    &RULES
}

/// Whether a maker has this for requests that any server may answer.
pub(super) fn is_to_all(request: Endpoint) -> bool {
    RULES.iter().any(|rule| rule.is_to_all(request))
}

/// Those of a maker.
pub(super) fn rules_of(maker: Maker) -> impl Iterator<Item = &'static Rule> {
    RULES.iter().filter(move |rule| rule.maker == maker.0)
}

impl Rule {
    fn parse(line: &'static str) -> Option<Self> {
        let mut columns = line.splitn(6, ',');
        let (maker, requests, answers) = (columns.next()?, columns.next()?, columns.next()?);
        let (address, to_all) = (columns.next()?, columns.next()?);
        let (first, last) = requests.split_once('-').unwrap_or((requests, requests));
        Some(Self {
            maker,
            first: first.parse().ok()?,
            last: last.parse().ok()?,
            answers: i32::from_str_radix(answers, 16).ok()?,
            address: match address {
                "no" => Address::No,
                "same" => Address::Same,
                "target" => Address::Target,
                _ => return None,
            },
            to_all: to_all.split_whitespace().map(endpoint).collect::<Option<_>>()?,
        })
    }

    fn has_request(&self, id: Id) -> bool {
        id.is_extended() == self.first.is_extended()
            && (self.first.raw()..=self.last.raw()).contains(&id.raw())
    }

    /// All requests of the range, to all among them.
    fn requests(&self) -> impl Iterator<Item = Endpoint> {
        let is_extended = self.first.is_extended();
        let id = move |raw| if is_extended { Id::extended(raw) } else { Id::standard(raw) };
        let ids = (self.first.raw()..=self.last.raw()).filter_map(id);
        let has_addresses = self.address != Address::No;
        ids.flat_map(move |id| {
            let addresses = if has_addresses { 0..=0xFF } else { 0..=0 };
            addresses.map(move |address| Endpoint { id, address: has_addresses.then_some(address) })
        })
    }

    /// Whether any server may answer this.
    pub fn is_to_all(&self, request: Endpoint) -> bool {
        self.to_all.contains(&request)
    }

    /// Who answers a request.
    pub fn server(&self, request: Endpoint) -> Option<Endpoint> {
        if !self.has_request(request.id) || self.is_to_all(request) {
            return None;
        }
        let (from, address) = match (self.address, request.address) {
            (Address::No, None) => (request.id.raw(), None),
            (Address::Same, Some(address)) => (request.id.raw(), Some(address)),
            (Address::Target, Some(address)) => (address.into(), Some(request.id.raw() as u8)),
            _ => return None,
        };
        let id = from.checked_add_signed(self.answers)?;
        let id = if self.first.is_extended() { Id::extended(id) } else { Id::standard(id) };
        Some(Endpoint { id: id?, address })
    }

    /// Whose request this may answer.
    pub fn client(&self, answer: Endpoint) -> Option<Endpoint> {
        let request = match (self.address, answer.address) {
            (Address::No | Address::Same, address) => {
                let id = answer.id.raw().checked_add_signed(-self.answers)?;
                let id = if self.first.is_extended() { Id::extended(id) } else { Id::standard(id) };
                Endpoint { id: id?, address }
            }
            // There is one tester.
            (Address::Target, Some(_)) => {
                let own = answer.id.raw().checked_add_signed(-self.answers)?;
                Endpoint { id: self.first, address: Some(u8::try_from(own).ok()?) }
            }
            (Address::Target, None) => return None,
        };
        Some(request).filter(|request| self.server(*request) == Some(answer))
    }
}

/// `None` for what is none, of which the table has nothing: a test reads every line.
fn endpoint(text: &str) -> Option<Endpoint> {
    let (id, address) = text.split_once('/').map_or((text, None), |(id, address)| (id, Some(address)));
    let address = match address {
        Some(address) => Some(u8::from_str_radix(address, 16).ok()?),
        None => None,
    };
    Some(Endpoint { id: id.parse().ok()?, address })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_of_the_table_is_a_rule() {
        let lines = TABLE.lines().filter(|line| !line.starts_with('#'));
        for line in lines {
            assert!(Rule::parse(line).is_some(), "{line}");
            let source = line.splitn(6, ',').nth(5);
            assert!(source.is_some_and(|source| source.len() > 10), "{line} has no source");
        }
        assert_eq!(Maker::all().first().map(|maker| maker.name()), Some("vag"));
    }

    #[test]
    fn both_directions_of_a_rule_agree() {
        for (maker, pair) in [
            ("vag", "713:77D"),
            ("vag", "17FC007B:17FE007B"),
            ("toyota", "750/6D:758/6D"),
            ("toyota", "7B0:7B8"),
            ("renault", "743:763"),
            ("nissan", "79B:7BB"),
            ("psa", "6B6:696"),
            ("psa", "752:652"),
            ("gm", "241:641"),
            ("bmw", "6F1/12:612/F1"),
            ("bmw", "6F1/00:600/F1"),
        ] {
            let pair: Pair = pair.parse().unwrap();
            let KnownPairs::Of(maker) = maker.to_uppercase().parse().unwrap() else { panic!("{maker}") };
            let fits =
                |rule: &Rule| rule.server(pair.a) == Some(pair.b) && rule.client(pair.b) == Some(pair.a);
            assert_eq!(rules_of(maker).filter(|rule| fits(rule)).count(), 1, "{pair}");
        }
        let all: Pair = "6F1/EF:6EF/F1".parse().unwrap();
        assert!(rules().iter().any(|rule| rule.is_to_all(all.a)));
        assert!(rules().iter().all(|rule| rule.server(all.a) != Some(all.b)));
        let error = "opel-or-so".parse::<KnownPairs>().unwrap_err().to_string();
        assert!(error.starts_with("'opel-or-so' is not a pair") && error.contains("vag, toyota"), "{error}");
    }
}
