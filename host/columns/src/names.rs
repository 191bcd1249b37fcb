//! Names of columns. No two columns of a table have the same: programs that find columns by name would take one for the other.

use std::collections::HashSet;

use arrow_schema::Field;

/// The names that are taken.
#[derive(Default)]
pub struct ColumnNames(HashSet<String>);

/// The name of the column with a signal's texts.
pub fn text_column(name: &str) -> String {
    format!("{name}.text")
}

impl ColumnNames {
    /// Those of the columns so far.
    pub fn of(fields: &[Field]) -> Self {
        Self(fields.iter().map(|field| field.name().clone()).collect())
    }

    /// Takes a name that is no signal's.
    #[cfg(feature = "mcap")]
    pub fn take(&mut self, name: &str) {
        self.0.insert(name.to_owned());
    }

    /// Chooses a name for a signal's column, and for that of its texts if it has any: its own; with the message's name in front if
    /// that one is taken; with a number behind it if both are.
    pub fn choose(&mut self, signal: &str, message: &str, has_texts: bool) -> String {
        let with_message = format!("{message}.{signal}");
        let numbered = (2..).map(|number| format!("{with_message}_{number}"));
        let mut names = [signal.to_owned(), with_message.clone()].into_iter().chain(numbered);
        let is_taken =
            |name: &String| self.0.contains(name) || has_texts && self.0.contains(&text_column(name));
        let name = names.find(|name| !is_taken(name)).unwrap_or_default();
        if has_texts {
            self.0.insert(text_column(&name));
        }
        self.0.insert(name.clone());
        name
    }
}
