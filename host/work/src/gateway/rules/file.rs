//! TOML into rules. Each fault has the line and the field that it is in.

use std::ops::Range;
use std::time::Duration;

use cantap::Channel;
use cantap::wire::Id;
use cantap::wire::message::{Filter, FrameKind, GatewayRule, Modifier, Pass};
use cantap_trace::clean;
use cantap_trace::counted;
use cantap_trace::filter::{EXTENDED, IdFilter, REMOTE};
use cantap_trace::grammar::{self, IdPattern};
use serde::Deserialize;
use toml::Spanned;

use super::super::text::{bytes, checksum, counter};
use super::rule::{Rule, RulesError};
use crate::channels::channel_number;

/// The longest period and delay. In a device they are ticks of 32 bits.
const LONGEST: Duration = Duration::from_secs(100);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    rule: Vec<Spanned<Entry>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: Option<String>,
    from: Spanned<From>,
    filter: Option<Spanned<String>>,
    remote: Option<bool>,
    #[serde(default)]
    drop: bool,
    and: Option<Spanned<Change>>,
    or: Option<Spanned<Change>>,
    xor: Option<Spanned<Change>>,
    set: Option<Spanned<Change>>,
    counter: Option<Spanned<String>>,
    checksum: Option<Spanned<String>>,
    period: Option<Spanned<String>>,
    delay: Option<Spanned<String>>,
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "expected a channel such as 1 or \"can0\"")]
enum From {
    Number(u64),
    Name(String),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Change {
    id: Option<Spanned<String>>,
    dlc: Option<Spanned<u64>>,
    data: Option<Spanned<String>>,
}

/// Makes errors of what is wrong at a place.
struct Source<'t> {
    file: &'t str,
    text: &'t str,
}

impl Source<'_> {
    fn line(&self, at: usize) -> u32 {
        let before = self.text.as_bytes().get(..at).unwrap_or_default();
        before.split(|byte| *byte == b'\n').count() as u32
    }

    fn fault(&self, span: &Range<usize>, field: &str, text: impl Into<String>) -> RulesError {
        let field = if field.is_empty() { String::new() } else { format!("{field}: ") };
        RulesError::Faulty {
            file: self.file.to_owned(),
            line: self.line(span.start),
            field,
            text: text.into(),
        }
    }

    /// What `parse` makes of a field's text.
    fn value<T, E: ToString>(
        &self,
        field: &str,
        text: &Spanned<String>,
        parse: impl FnOnce(&str) -> Result<T, E>,
    ) -> Result<T, RulesError> {
        parse(text.get_ref()).map_err(|error| self.fault(&text.span(), field, error.to_string()))
    }

    fn time(&self, field: &str, text: Option<&Spanned<String>>) -> Result<Duration, RulesError> {
        let Some(text) = text else { return Ok(Duration::ZERO) };
        let time = self.value(field, text, grammar::positive_duration)?;
        if time > LONGEST {
            return Err(self.fault(&text.span(), field, "at most 100s"));
        }
        Ok(time)
    }
}

/// The rules of a file.
pub fn parse(file: &str, text: &str) -> Result<Vec<Rule>, RulesError> {
    let source = Source { file, text };
    let content: File = toml::from_str(text).map_err(|error| {
        let span = error.span().unwrap_or_default();
        source.fault(&span, "", error.message())
    })?;
    if content.rule.is_empty() {
        return Err(source.fault(
            &(0..0),
            "",
            "there is no rule; a rule begins with [[rule]] (docs/gateway.md)",
        ));
    }
    content.rule.into_iter().map(|entry| rule(&source, &entry.span(), entry.get_ref())).collect()
}

fn rule(source: &Source, span: &Range<usize>, entry: &Entry) -> Result<Rule, RulesError> {
    let from = channel(source, &entry.from)?;
    let filters = filters(source, entry)?;
    let (period, delay) =
        (source.time("period", entry.period.as_ref())?, source.time("delay", entry.delay.as_ref())?);
    let changes = [entry.and.as_ref(), entry.or.as_ref(), entry.xor.as_ref(), entry.set.as_ref()];
    let modifiers = entry.counter.is_some() || entry.checksum.is_some();
    if entry.drop
        && (modifiers || !period.is_zero() || !delay.is_zero() || changes.iter().any(Option::is_some))
    {
        return Err(source.fault(span, "drop", "a rule that drops frames does nothing else to them"));
    }
    for (field, text) in [("counter", &entry.counter), ("period", &entry.period)] {
        if let Some(text) = text.as_ref().filter(|_| filters.len() > 1) {
            let parts = counted(filters.len(), "place");
            return Err(source.fault(
                &text.span(),
                field,
                format!(
                    "it is one for all frames of the rule, whose filter takes {parts} in a device; write a rule for each \
                     identifier, or a filter with a mask or ? (8 digits for 29 bits)"
                ),
            ));
        }
    }
    let parts = filters
        .iter()
        .map(|filter| {
            let pass = (!entry.drop).then(|| pass(source, entry, filter)).transpose()?;
            let rule = GatewayRule { filter: *filter, pass };
            if !rule.has_valid_ids() {
                let at = changes.iter().flatten().filter_map(|change| change.get_ref().id.as_ref()).next_back();
                let text = "an identifier that this rule sends has more than 11 bits; set all its digits, or 8 for one of 29 bits";
                return Err(source.fault(&at.map_or_else(|| span.clone(), Spanned::span), "id", text));
            }
            Ok(rule)
        })
        .collect::<Result<_, _>>()?;
    let filter = entry.filter.as_ref().map_or("all", |filter| filter.get_ref());
    let name = clean::line(entry.name.as_deref().unwrap_or(filter)).into_owned();
    Ok(Rule { name, line: source.line(span.start), from, parts, period, delay })
}

fn channel(source: &Source, from: &Spanned<From>) -> Result<Channel, RulesError> {
    let number = match from.get_ref() {
        From::Number(number) => u8::try_from(*number).ok(),
        From::Name(name) => channel_number(name),
    };
    let found = Channel::ALL.into_iter().find(|channel| Some(channel.number()) == number);
    found.ok_or_else(|| {
        source.fault(
            &from.span(),
            "from",
            "a channel is 1 or 2; \"can0\" is channel 1, \"can1\" is channel 2",
        )
    })
}

/// The wire's filters for a rule's.
fn filters(source: &Source, entry: &Entry) -> Result<Vec<Filter>, RulesError> {
    let ids = match &entry.filter {
        Some(text) => source.value("filter", text, str::parse::<IdPattern>)?.filters().to_vec(),
        None => vec![IdFilter { id: 0, mask: 0, inverse: false }],
    };
    let mut filters = Vec::new();
    for id in ids {
        let mask = id.effective_mask();
        let remote = if mask & REMOTE == 0 { None } else { Some(id.id & REMOTE != 0) };
        let kind = match entry.remote.or(remote) {
            None => FrameKind::Any,
            Some(true) => FrameKind::Remote,
            Some(false) => FrameKind::Data,
        };
        for extended in [false, true] {
            if mask & EXTENDED != 0 && (id.id & EXTENDED != 0) != extended {
                continue;
            }
            let widest = if extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
            let (own, mask) = (id.id & mask & Id::MAX_EXTENDED, mask & Id::MAX_EXTENDED);
            // A bit that an identifier of 11 bits does not have and that must be set: none matches.
            if own & !widest == 0 {
                filters.push(Filter { extended, kind, id: own & widest, mask: mask & widest });
            }
        }
    }
    Ok(filters)
}

/// What becomes of a value: AND, OR, XOR and SET one after the other, as can-gw applies them, are `value & and ^ xor`.
#[derive(Clone, Copy)]
struct Bits<T> {
    and: T,
    xor: T,
}

macro_rules! bits {
    ($($kind:ty),*) => { $(impl Bits<$kind> {
        const SAME: Self = Self { and: <$kind>::MAX, xor: 0 };

        /// `step` counts from AND to SET; `given` are the bits that the file names, `value` what they are.
        fn then(self, step: usize, given: $kind, value: $kind) -> Self {
            match step {
                0 => { let keep = value | !given; Self { and: self.and & keep, xor: self.xor & keep } }
                1 => Self { and: self.and & !value, xor: self.xor & !value | value },
                2 => Self { and: self.and, xor: self.xor ^ value },
                _ => Self { and: self.and & !given, xor: self.xor & !given | value },
            }
        }
    })* };
}
bits!(u8, u32);

/// The changes of a rule.
fn pass(source: &Source, entry: &Entry, filter: &Filter) -> Result<Pass, RulesError> {
    let mut pass = Pass::unchanged(filter.extended);
    let (mut id, mut dlc, mut data) = (Bits::<u32>::SAME, Bits::<u8>::SAME, [Bits::<u8>::SAME; 8]);
    let changes = [("and", &entry.and), ("or", &entry.or), ("xor", &entry.xor), ("set", &entry.set)];
    for (step, (name, change)) in changes.into_iter().enumerate() {
        let Some(change) = change.as_ref().map(Spanned::get_ref) else { continue };
        if let Some(text) = &change.id {
            let field = format!("{name}.id");
            let pattern = source.value(&field, text, str::parse::<IdPattern>)?;
            let [one] = pattern.filters() else {
                return Err(source.fault(
                    &text.span(),
                    &field,
                    "write one identifier, with ? for a digit that stays",
                ));
            };
            if one.mask & EXTENDED == 0 || one.inverse || text.get_ref().contains(['-', 'p', 'P']) {
                return Err(source.fault(
                    &text.span(),
                    &field,
                    "write one identifier, with ? for a digit that stays",
                ));
            }
            let mut given = one.mask & Id::MAX_EXTENDED;
            if step == 3 {
                pass.extended = one.id & EXTENDED != 0;
                // An identifier of 11 bits has no others.
                given |= if pass.extended { 0 } else { Id::MAX_EXTENDED & !Id::MAX_STANDARD };
            }
            id = id.then(step, given, one.id & Id::MAX_EXTENDED);
        }
        if let Some(value) = &change.dlc {
            let code = u8::try_from(*value.get_ref()).ok().filter(|code| *code <= 15);
            let code =
                code.ok_or_else(|| source.fault(&value.span(), &format!("{name}.dlc"), "a DLC is 0 to 15"))?;
            dlc = dlc.then(step, 15, code);
        }
        if let Some(text) = &change.data {
            let (given, values) = source.value(&format!("{name}.data"), text, bytes)?;
            for (at, byte) in data.iter_mut().enumerate() {
                *byte = byte.then(step, given[at], values[at]);
            }
        }
    }
    let modifiers = [
        entry.counter.as_ref().map(|text| (text, "counter", source.value("counter", text, counter))),
        entry.checksum.as_ref().map(|text| (text, "checksum", source.value("checksum", text, checksum))),
    ];
    for (text, field, modifier) in modifiers.into_iter().flatten() {
        let modifier = modifier?;
        if !modifier.fits(8) {
            return Err(source.fault(
                &text.span(),
                field,
                "a frame has bytes 0 to 7, and a byte bits 0 to 7",
            ));
        }
        // It counts from zero: without this, from what is received.
        if let Modifier::Counter { byte, low_bit, bits } = modifier {
            let mask = ((1_u16 << bits) - 1) as u8;
            let byte = &mut data[usize::from(byte)];
            *byte = byte.then(3, mask << low_bit, 0);
        }
        // Cannot fail: there are two.
        let _ = pass.modifiers.push(modifier);
    }
    (pass.id_and, pass.id_xor) = (id.and, id.xor);
    (pass.dlc_and, pass.dlc_xor) = (dlc.and & 15, dlc.xor & 15);
    (pass.data_and, pass.data_xor) = (data.map(|byte| byte.and), data.map(|byte| byte.xor));
    Ok(pass)
}
