//! Tests: each function that is one, and those of tables, in which each row is one.

use std::rc::Rc;

use rhai::{Array, Dynamic, Engine, FnPtr, NativeCallContext};

use crate::exchange::Output;
use crate::report::Outcome;
use crate::row_test::RowTest;
use crate::runtime::Runtime;
use crate::script_result::{Result, describe, is_final};

/// Characters of a row that stand in a failure's reason, at most.
const MOST_OF_ROW: usize = 200;

/// Makes everything known to an engine.
pub fn register(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    engine.register_fn("test", move |name: &str, rows: Array, call: FnPtr| -> Result<()> {
        of.add_tests(tests_of(name, rows, &call)?)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("tests_are_known", move || {
        let names = of.tests_are_known();
        of.output(Output::Tests(names))
    });
    let of = Rc::clone(runtime);
    engine.register_fn(
        "run_test",
        move |context: NativeCallContext<'_>, name: &str, setup: Array, test: FnPtr, teardown: Array| {
            run(&of, &context, (name, None), [setup, vec![test.into()], teardown])
        },
    );
    let of = Rc::clone(runtime);
    engine.register_fn(
        "run_tests_of_rows",
        move |context: NativeCallContext<'_>, setup: Array, teardown: Array| -> Result<bool> {
            let mut has_some = false;
            while let Some(test) = of.next_test() {
                let RowTest { name, row, call } = test;
                has_some = true;
                run(
                    &of,
                    &context,
                    (&name, Some(&row)),
                    [setup.clone(), vec![call.into()], teardown.clone()],
                )?;
            }
            Ok(has_some)
        },
    );
}

fn tests_of(name: &str, rows: Array, call: &FnPtr) -> Result<Vec<RowTest>> {
    if rows.is_empty() {
        return Err(format!("test {name:?} has no rows, so it tests nothing").into());
    }
    let numbered = rows.into_iter().enumerate();
    Ok(numbered
        .map(|(index, row)| {
            let text: String = row.to_string().chars().take(MOST_OF_ROW).collect();
            let mut call = call.clone();
            call.add_curry(row);
            RowTest { name: format!("{name}[{}]", index + 1), row: text, call }
        })
        .collect())
}

/// Runs a test between what comes before and after it.
fn run(
    runtime: &Runtime,
    context: &NativeCallContext<'_>,
    (name, row): (&str, Option<&str>),
    steps: [Array; 3],
) -> Result<()> {
    let began_ns = runtime.now_ns();
    let mut outcome = Outcome::Passed;
    runtime.output(Output::TestBegan(name.to_owned()))?;
    for step in steps.into_iter().flatten() {
        let call: FnPtr = step.try_cast().ok_or("a step of a test is a function")?;
        // The last step tidies up: it runs whatever happened before.
        match call.call_within_context::<Dynamic>(context, ()) {
            Err(error) if is_final(&error) => return Err(error),
            Err(error) if outcome == Outcome::Passed => {
                let reason = describe(&error);
                outcome = Outcome::Failed(match row {
                    Some(row) => format!("{reason}, with {row}"),
                    None => reason,
                });
            }
            _ => {}
        }
    }
    runtime.output(Output::Test { name: name.to_owned(), outcome, began_ns })
}
