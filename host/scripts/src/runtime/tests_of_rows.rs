//! The tests that a script's own lines make.

use super::{Runtime, has_place};
use crate::row_test::RowTest;
use crate::script_result::Result;

impl Runtime {
    /// More tests, which run after the script's own lines.
    pub fn add_tests(&self, tests: Vec<RowTest>) -> Result<()> {
        let mut state = self.state.borrow_mut();
        if state.has_all_tests {
            return Err("tests are made by the script's own lines, and not by its functions".into());
        }
        if state.tests.iter().any(|known| known.name == tests[0].name) {
            return Err(format!("there is a test {} already", tests[0].name).into());
        }
        has_place(state.tests.len() + tests.len(), "tests")?;
        state.tests.extend(tests);
        Ok(())
    }

    /// There will be no more of them; returns their names.
    pub fn tests_are_known(&self) -> Vec<String> {
        let mut state = self.state.borrow_mut();
        state.has_all_tests = true;
        state.tests.iter().map(|test| test.name.clone()).collect()
    }

    /// The next of them.
    pub fn next_test(&self) -> Option<RowTest> {
        self.state.borrow_mut().tests.pop_front()
    }
}
