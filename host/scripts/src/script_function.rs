//! Where the functions of a script are in its text.

use rhai::{AST, Position};

/// A function of the script, also one without a name.
pub struct Function {
    name: String,
    begin: Position,
    /// None if it is a single expression.
    end: Position,
}

impl Function {
    /// All of a script.
    pub fn all(ast: &AST) -> Vec<Self> {
        let functions = ast.iter_fn_def().map(|function| Self {
            name: function.name.to_string(),
            begin: function.body.start_position(),
            end: function.body.end_position(),
        });
        functions.collect()
    }

    /// The innermost one in which a statement stands that is directly in a function.
    pub fn around(all: &[Self], statement: Position) -> Option<&str> {
        let has = |function: &&Self| {
            if function.end.is_none() {
                function.begin == statement
            } else {
                function.begin <= statement && statement <= function.end
            }
        };
        all.iter().filter(has).max_by_key(|function| function.begin).map(|function| function.name.as_str())
    }
}
