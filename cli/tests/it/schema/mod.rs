//! Checks JSON values against a JSON Schema.
//!
//! It supports only what our own schema uses, and everything else in a schema is an error, so that no part of it is
//! overlooked: a complete validator would need forty crates for a handful of keywords.

use serde_json::{Map, Value};

/// A schema, and what it refers to.
pub struct Schema {
    root: Value,
}

impl Schema {
    /// From its text.
    pub fn new(text: &str) -> Self {
        Self { root: serde_json::from_str(text).unwrap() }
    }

    /// The object types by name.
    pub fn types(&self) -> &Map<String, Value> {
        self.root["$defs"].as_object().unwrap()
    }

    /// Where a value violates the type; empty if it is valid.
    pub fn faults(&self, name: &str, value: &Value) -> Vec<String> {
        let mut faults = Vec::new();
        self.check(&self.root["$defs"][name], value, name, &mut faults);
        faults
    }

    fn check(&self, schema: &Value, value: &Value, path: &str, faults: &mut Vec<String>) {
        let schema = schema.as_object().unwrap_or_else(|| panic!("{path}: the schema has nothing for it"));
        for (keyword, says) in schema {
            match keyword.as_str() {
                "description" => {}
                "$ref" => {
                    let name = says.as_str().unwrap().strip_prefix("#/$defs/").unwrap();
                    self.check(&self.root["$defs"][name], value, path, faults);
                }
                "anyOf" => {
                    let fits = |schema: &Value| {
                        let mut faults = Vec::new();
                        self.check(schema, value, path, &mut faults);
                        faults.is_empty()
                    };
                    if !says.as_array().unwrap().iter().any(fits) {
                        faults.push(format!("{path}: {value} is none of {says}"));
                    }
                }
                "type" => {
                    let is = |name: &Value| is_of_type(value, name.as_str().unwrap());
                    if !says.as_array().map_or_else(|| is(says), |names| names.iter().any(is)) {
                        faults.push(format!("{path}: {value} is no {says}"));
                    }
                }
                "items" => {
                    for (at, item) in value.as_array().into_iter().flatten().enumerate() {
                        self.check(says, item, &format!("{path}[{at}]"), faults);
                    }
                }
                "required" => {
                    let keys = says.as_array().unwrap().iter().map(|key| key.as_str().unwrap());
                    for key in keys.filter(|key| value.is_object() && value.get(key).is_none()) {
                        faults.push(format!("{path}: without {key}"));
                    }
                }
                "properties" => {
                    for (key, member) in value.as_object().into_iter().flatten() {
                        if let Some(schema) = says.get(key) {
                            self.check(schema, member, &format!("{path}.{key}"), faults);
                        }
                    }
                }
                "additionalProperties" => {
                    let known = schema.get("properties").and_then(Value::as_object);
                    for (key, member) in value.as_object().into_iter().flatten() {
                        match says {
                            _ if known.is_some_and(|known| known.contains_key(key)) => {}
                            Value::Bool(false) => faults.push(format!("{path}: {key} is unknown")),
                            says => self.check(says, member, &format!("{path}.{key}"), faults),
                        }
                    }
                }
                other => panic!("{path}: the schema has {other}, which this test does not know"),
            }
        }
    }
}

fn is_of_type(value: &Value, name: &str) -> bool {
    match name {
        "null" => value.is_null(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_i64() || value.is_u64(),
        "number" => value.is_number(),
        "string" => value.is_string(),
        "array" => value.is_array(),
        "object" => value.is_object(),
        other => panic!("the schema has the type {other}, which this test does not know"),
    }
}
