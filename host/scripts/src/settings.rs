//! What a user sets for a script: `node:boat?address=35`.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};

use rhai::Dynamic;

/// Settings by name, and which of them the script knows.
#[derive(Debug, Default)]
pub struct Settings {
    given: BTreeMap<String, String>,
    known: RefCell<BTreeSet<String>>,
}

impl Settings {
    /// As the user wrote them.
    pub fn new(given: BTreeMap<String, String>) -> Self {
        Self { given, known: RefCell::default() }
    }

    /// What the user has set, as a value of the default's kind, or else the default.
    pub fn value(&self, name: &str, default: Dynamic) -> Result<Dynamic, String> {
        self.known.borrow_mut().insert(name.to_owned());
        let Some(text) = self.given.get(name) else { return Ok(default) };
        let parsed = if default.is_int() {
            integer(text).map(Dynamic::from)
        } else if default.is_float() {
            text.parse::<f64>().ok().filter(|number| number.is_finite()).map(Dynamic::from)
        } else if default.is_bool() {
            text.parse::<bool>().ok().map(Dynamic::from)
        } else {
            Some(Dynamic::from(text.clone()))
        };
        let kind = match default.type_name() {
            "i64" => "a whole number",
            "f64" => "a number",
            _ => "true or false",
        };
        parsed.ok_or_else(|| format!("the setting {name} is {kind}, as in {name}={default}, and not {text}"))
    }

    /// An error if there is a setting that the script has not asked for.
    pub fn check(&self) -> Result<(), String> {
        let known = self.known.borrow();
        let Some(unknown) = self.given.keys().find(|name| !known.contains(*name)) else { return Ok(()) };
        let names: Vec<&str> = known.iter().map(String::as_str).collect();
        Err(if names.is_empty() {
            format!("it has no settings, so no {unknown}")
        } else {
            format!("it has no setting {unknown}; it has {}", names.join(", "))
        })
    }
}

/// Decimal, or hexadecimal with 0x.
fn integer(text: &str) -> Option<i64> {
    let hexadecimal = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
    hexadecimal.map_or_else(|| text.parse().ok(), |digits| i64::from_str_radix(digits, 16).ok())
}
