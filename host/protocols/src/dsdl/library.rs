//! All definitions of one language, found by name and by number.

use std::cell::RefCell;

use rustc_hash::FxHashMap;

use super::expression::evaluate;
use super::meaning;
use super::model::{Definition, Generation, Kind, Member, Section, Size, bits_for};
use super::parse::{DsdlSource, Raw, RawField, parse};
use super::signature::Signature;
use super::unit;

/// The fields with these names are text if they are arrays of bytes.
const TEXTS: [&str; 19] = [
    "text",
    "name",
    "path",
    "source",
    "key",
    "string_value",
    "parameter",
    "parameter_name",
    "reason_text",
    "optional_error_message",
    "model_name",
    "input",
    "output",
    "error",
    "description",
    "uas_id",
    "operator_id",
    "serial_number",
    "manufacture_date",
];

/// How many elements an array may have: a definition is somebody's text.
const MOST_ELEMENTS: u32 = 1 << 20;
/// How far constants of other types may lead, and how deep types may be nested.
const MOST_DEPTH: u8 = 16;

/// Definitions.
#[derive(Clone, Debug)]
pub(crate) struct Library {
    pub generation: Generation,
    definitions: Vec<Definition>,
    names: FxHashMap<String, usize>,
    messages: FxHashMap<u16, Vec<usize>>,
    services: FxHashMap<u16, Vec<usize>>,
}

/// While it is made.
struct Building<'a> {
    generation: Generation,
    raws: &'a [Raw],
    names: &'a FxHashMap<String, usize>,
    /// The names and expressions of constants, by the definition that they are in and their name.
    constants: FxHashMap<(usize, &'a str), (&'a str, &'a str)>,
    /// The values of those that were needed: a constant that names two others twice, and they others, is a short text and many ways.
    values: RefCell<FxHashMap<(usize, &'a str), i128>>,
}

impl Library {
    /// Of these sources, of which the first with a name counts. Appends what is not understood.
    pub fn of(generation: Generation, sources: &[DsdlSource], problems: &mut Vec<String>) -> Self {
        let (mut raws, mut names) = (Vec::<Raw>::new(), FxHashMap::<String, usize>::default());
        for source in sources {
            match parse(source, generation) {
                Ok(raw) if names.contains_key(&raw.name.full) => {}
                Ok(raw) => {
                    names.insert(raw.name.full.clone(), raws.len());
                    raws.push(raw);
                }
                Err(problem) => problems.push(problem),
            }
        }
        let mut constants = FxHashMap::default();
        for (at, raw) in raws.iter().enumerate() {
            for (name, expression) in raw.sections.iter().flat_map(|section| &section.constants) {
                constants.entry((at, name.as_str())).or_insert((name.as_str(), expression.as_str()));
            }
        }
        let building =
            Building { generation, raws: &raws, names: &names, constants, values: RefCell::default() };
        let mut definitions: Vec<Option<Definition>> = raws.iter().map(|_| None).collect();
        for at in 0..raws.len() {
            if let Err(problem) = building.define(at, &mut definitions, 0) {
                problems.push(problem);
            }
        }
        let is_whole: Vec<bool> = definitions.iter().map(Option::is_some).collect();
        let definitions: Vec<_> = definitions.into_iter().map(Option::unwrap_or_default).collect();
        names.retain(|_, at| is_whole[*at]);
        let mut this = Self {
            generation,
            definitions,
            names,
            messages: FxHashMap::default(),
            services: FxHashMap::default(),
        };
        this.number();
        this
    }

    /// Finds them by their numbers: the user's own before those that are built in, and the newest version first.
    fn number(&mut self) {
        for (at, definition) in self.definitions.iter().enumerate() {
            let Some(port) = definition.port else { continue };
            let ports = if definition.response.is_some() { &mut self.services } else { &mut self.messages };
            ports.entry(port).or_default().push(at);
        }
        for ports in [&mut self.messages, &mut self.services] {
            for all in ports.values_mut() {
                all.sort_by_key(|at| std::cmp::Reverse(self.definitions[*at].version));
            }
        }
    }

    /// The messages with this number, the one to be preferred first.
    pub fn messages(&self, port: u16) -> impl Iterator<Item = &Definition> {
        self.messages.get(&port).into_iter().flatten().map(|at| &self.definitions[*at])
    }

    /// The services with this number.
    pub fn services(&self, port: u16) -> impl Iterator<Item = &Definition> {
        self.services.get(&port).into_iter().flatten().map(|at| &self.definitions[*at])
    }

    /// The type with this full name.
    pub fn named(&self, name: &str) -> Option<&Definition> {
        self.names.get(name).map(|at| &self.definitions[*at])
    }

    /// Prefers the message with this name for a number; false if there is none.
    pub fn name_message(&mut self, port: u16, name: &str) -> bool {
        let found = self.names.get(name).copied().filter(|at| self.definitions[*at].response.is_none());
        let Some(at) = found else { return false };
        self.messages.entry(port).or_default().insert(0, at);
        true
    }

    /// The one with this number of [`Kind::Nested`].
    pub fn nested(&self, at: usize) -> &Definition {
        &self.definitions[at]
    }

    #[cfg(test)]
    pub fn all(&self) -> &[Definition] {
        &self.definitions
    }
}

impl Building<'_> {
    /// Makes a definition, after those that it contains.
    fn define(&self, at: usize, done: &mut Vec<Option<Definition>>, depth: u8) -> Result<(), String> {
        if done[at].is_some() {
            return Ok(());
        }
        let raw = &self.raws[at];
        let name = &raw.name;
        if depth > MOST_DEPTH {
            return Err(format!("{}: its types contain each other", name.full));
        }
        let mut sections = Vec::new();
        let mut normalized = name.full.clone();
        let mut nested_signatures = Vec::new();
        for (number, raw_section) in raw.sections.iter().enumerate() {
            let mut section = Section {
                is_union: raw_section.is_union,
                is_sealed: raw_section.is_sealed,
                ..Section::default()
            };
            normalized.push_str(if number > 0 { "\n---" } else { "" });
            normalized.push_str(if section.is_union { "\n@union" } else { "" });
            for field in &raw_section.fields {
                let wrong = |what: &str| format!("{}: line {}: {what}", name.full, field.line);
                let (kind, text) = self.kind(at, field, done, depth).map_err(|what| wrong(&what))?;
                if let Kind::Nested(of) = innermost(&kind) {
                    nested_signatures.extend(done[*of].as_ref().map(|of| of.signature));
                }
                normalized.push('\n');
                normalized.push_str(&text);
                section.members.push(Member {
                    unit: unit::of_field(&name.full, &field.name, &field.comment),
                    name: field.name.clone(),
                    kind,
                    meanings: Vec::new(),
                    is_flags: false,
                });
            }
            let constants = raw_section.constants.iter().filter_map(|(constant, expression)| {
                let value = self.evaluate(at, expression, 0)?;
                Some((constant.clone(), i64::try_from(value).ok()?))
            });
            meaning::assign(&mut section.members, &constants.collect::<Vec<_>>());
            section.least_bits = least_bits(&section, done);
            sections.push(section);
        }
        let mut sections = sections.into_iter();
        done[at] = Some(Definition {
            name: name.full.clone(),
            port: name.port,
            version: name.version,
            request: sections.next().unwrap_or_default(),
            response: sections.next(),
            signature: signature(&normalized, raw.signature, &nested_signatures),
        });
        Ok(())
    }

    /// How a field is read, and as the text that signatures are made of.
    fn kind(
        &self,
        at: usize,
        field: &RawField,
        done: &mut Vec<Option<Definition>>,
        depth: u8,
    ) -> Result<(Kind, String), String> {
        let (element, mut text) = if let Some(primitive) = primitive(&field.kind) {
            let cast = if field.is_truncated { "truncated " } else { "saturated " };
            let cast = if matches!(primitive, Kind::Void(_)) { "" } else { cast };
            (primitive, format!("{cast}{}", field.kind))
        } else {
            let full = self.full_name(at, &field.kind);
            let of = *self.names.get(&full).ok_or_else(|| format!("there is no type {full}"))?;
            self.define(of, done, depth + 1)?;
            let is_service = done[of].as_ref().is_some_and(|of| of.response.is_some());
            if is_service {
                return Err(format!("{full} is a service"));
            }
            (Kind::Nested(of), full)
        };
        let mut kind = element;
        if let Some(array) = &field.array {
            let capacity = self.evaluate(at, &array.capacity, 0);
            let capacity = capacity.map(|capacity| capacity - i128::from(array.is_below));
            let count = capacity.and_then(|count| u32::try_from(count).ok());
            let count = count.filter(|count| (1..=MOST_ELEMENTS).contains(count));
            let count = count.ok_or_else(|| format!("an array of {} elements", array.capacity))?;
            let size = if array.is_variable { Size::UpTo(count) } else { Size::Fixed(count) };
            let sign = if array.is_variable { "<=" } else { "" };
            text = format!("{text}[{sign}{count}]");
            let is_text = field.kind == "utf8"
                || kind == Kind::Unsigned(8)
                    && array.is_variable
                    && (TEXTS.contains(&field.name.as_str())
                        || self.raws[at].name.full.starts_with("uavcan.primitive.String."));
            kind = if is_text { Kind::Text(size) } else { Kind::Array(Box::new(kind), size) };
        }
        let name = if field.name.is_empty() { String::new() } else { format!(" {}", field.name) };
        Ok((kind, text + &name))
    }

    /// The name with its namespace, if it stands without.
    fn full_name(&self, at: usize, name: &str) -> String {
        let dots = name.matches('.').count();
        let own = match self.generation {
            Generation::DroneCan => 0,
            // The version.
            Generation::Cyphal => 2,
        };
        if dots > own { name.to_owned() } else { format!("{}.{name}", self.raws[at].name.namespace) }
    }

    /// The value of an expression in a definition, with its constants and those of others.
    fn evaluate(&self, at: usize, expression: &str, depth: u8) -> Option<i128> {
        if depth > MOST_DEPTH {
            return None;
        }
        evaluate(expression, &|name| {
            let (of, constant) = match name.rsplit_once('.') {
                Some((of, constant)) => (*self.names.get(&self.full_name(at, of))?, constant),
                None => (at, name),
            };
            let (name, expression) = *self.constants.get(&(of, constant))?;
            if let Some(known) = self.values.borrow().get(&(of, name)) {
                return Some(*known);
            }
            // What has no value ends everything that it is part of.
            let value = self.evaluate(of, expression, depth + 1)?;
            self.values.borrow_mut().insert((of, name), value);
            Some(value)
        })
    }
}

/// The kind of an array's elements, or of what is none.
fn innermost(kind: &Kind) -> &Kind {
    match kind {
        Kind::Array(element, _) => element,
        kind => kind,
    }
}

/// A type of the language itself.
fn primitive(name: &str) -> Option<Kind> {
    let at = name.find(|letter: char| letter.is_ascii_digit()).unwrap_or(name.len());
    let (word, digits) = name.split_at(at);
    let bits = digits.parse::<u8>().ok().filter(|bits| (1..=64).contains(bits));
    Some(match (word, bits) {
        ("bool", None) if digits.is_empty() => Kind::Bool,
        ("byte" | "utf8", None) if digits.is_empty() => Kind::Unsigned(8),
        ("utf", Some(8)) => Kind::Unsigned(8),
        ("uint", Some(bits)) => Kind::Unsigned(bits),
        ("int", Some(bits)) => Kind::Signed(bits),
        ("float", Some(bits @ (16 | 32 | 64))) => Kind::Float(bits),
        ("void", Some(bits)) => Kind::Void(bits),
        _ => return None,
    })
}

/// A section's least length, by the rules for DroneCAN's last arrays.
fn least_bits(section: &Section, done: &[Option<Definition>]) -> u32 {
    let of = |kind: &Kind| least_bits_of(kind, done);
    let all = section.members.iter().map(|member| of(&member.kind));
    if section.is_union {
        let tag = bits_for(section.members.len().saturating_sub(1).max(1) as u32);
        return all.min().unwrap_or_default().saturating_add(tag.into());
    }
    all.fold(0, u32::saturating_add)
}

fn least_bits_of(kind: &Kind, done: &[Option<Definition>]) -> u32 {
    match kind {
        Kind::Bool => 1,
        Kind::Void(bits) | Kind::Unsigned(bits) | Kind::Signed(bits) | Kind::Float(bits) => (*bits).into(),
        Kind::Array(element, Size::Fixed(count)) => least_bits_of(element, done).saturating_mul(*count),
        Kind::Text(Size::Fixed(count)) => count.saturating_mul(8),
        Kind::Array(..) | Kind::Text(_) => 0,
        Kind::Nested(of) => done[*of].as_ref().map_or(0, |of| of.request.least_bits),
    }
}

/// DroneCAN's data type signature: of the normalized text, then of each nested type, with what there was before.
fn signature(normalized: &str, given: Option<u64>, nested: &[u64]) -> u64 {
    let own = given.unwrap_or_else(|| Signature::new().with(normalized.as_bytes()).value());
    nested.iter().fold(own, |before, nested| {
        let both = Signature::from(before).with(&nested.to_le_bytes());
        both.with(&before.to_le_bytes()).value()
    })
}
