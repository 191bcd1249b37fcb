//! The functions with which scripts read the files that they are granted.

use std::collections::BTreeSet;
use std::rc::Rc;

use rhai::{Array, Dynamic, Engine, Map};

use crate::runtime::Runtime;
use crate::script_result::Result;

/// The largest table, in bytes: its values take many times as much.
const MOST_TABLE: usize = 1 << 20;

/// Makes everything known to an engine.
pub fn register(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let read = {
        let runtime = Rc::clone(runtime);
        move |path: &str| -> Result<String> {
            let text = runtime.surroundings.files.read(path)?;
            runtime.spend(text.len());
            Ok(text)
        }
    };
    let file = read.clone();
    engine.register_fn("read", move |path: &str| file(path));
    engine.register_fn("csv", move |path: &str| -> Result<Array> {
        let text = read(path)?;
        if text.len() > MOST_TABLE {
            return Err(format!("{path} has more than {} MiB, too much for a table", MOST_TABLE >> 20).into());
        }
        table(path, &text)
    });
}

/// The rows below the first one, whose cells are the names of the others.
fn table(path: &str, text: &str) -> Result<Array> {
    let text = text.strip_prefix('\u{FEFF}').unwrap_or(text);
    let mut rows = cantap_signals::rows_of_text(text).into_iter();
    let (_, names) = rows.next().ok_or_else(|| format!("{path} has no rows"))?;
    // Not each with all others: an attacker's table has many.
    let mut known = BTreeSet::new();
    if let Some(name) = names.iter().find(|name| !known.insert(name.as_str())) {
        return Err(format!("{path} has two columns {name:?}").into());
    }
    rows.map(|(line, cells)| -> Result<Dynamic> {
        if cells.len() > names.len() && cells[names.len()..].iter().any(|cell| !cell.is_empty()) {
            return Err(format!("{path}, line {line}: more cells than there are columns").into());
        }
        let cells = cells.into_iter().chain(std::iter::repeat(String::new()));
        let row: Map =
            names.iter().zip(cells).map(|(name, cell)| (name.as_str().into(), value(cell))).collect();
        Ok(Dynamic::from_map(row))
    })
    .collect()
}

/// A whole number, also hexadecimal with 0x, another number, or else a text.
fn value(cell: String) -> Dynamic {
    let hexadecimal = cell.strip_prefix("0x").or_else(|| cell.strip_prefix("0X"));
    let whole = hexadecimal.map_or_else(|| cell.parse().ok(), |digits| i64::from_str_radix(digits, 16).ok());
    let looks_like_number =
        cell.starts_with(|first: char| first.is_ascii_digit() || matches!(first, '-' | '+' | '.'));
    let number = || cell.parse::<f64>().ok().filter(|number| looks_like_number && number.is_finite());
    whole.map(Dynamic::from_int).or_else(|| number().map(Dynamic::from_float)).unwrap_or_else(|| cell.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_s_cells_are_numbers_where_they_look_so() {
        let rows = table("a.csv", "\u{FEFF}id;name;x\n0x10;\"a;b\";1.5\n\n7;nan\n").unwrap();
        let texts: Vec<String> = rows.iter().map(ToString::to_string).collect();
        assert_eq!(
            texts,
            [r#"#{"id": 16, "name": "a;b", "x": 1.5}"#, r#"#{"id": 7, "name": "nan", "x": ""}"#]
        );
        assert!(table("a.csv", "a,a\n1,2").unwrap_err().to_string().contains("two columns \"a\""));
        assert!(table("a.csv", "a,b\n1,2,3").unwrap_err().to_string().contains("line 2: more cells"));
        assert!(table("a.csv", "").unwrap_err().to_string().contains("no rows"));
    }
}
