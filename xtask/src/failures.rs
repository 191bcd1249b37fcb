//! What `cargo test` prints of tests that failed.

/// Reads it line by line.
#[derive(Debug, Default)]
pub struct Failures {
    /// Names in the list that a test program is printing.
    listed: Vec<String>,
    names: Vec<String>,
    /// Test programs that ended with a list.
    told: usize,
    /// Test programs that failed, a list or none.
    failed: usize,
    passed: usize,
}

impl Failures {
    /// Takes the next line.
    pub fn line(&mut self, line: &str) {
        if line == "failures:" {
            // The same word stands above what the tests printed and above their names, which come last.
            self.listed.clear();
        } else if let Some(result) = line.strip_prefix("test result: ") {
            if result.starts_with("FAILED") {
                self.told += 1;
                self.names.append(&mut self.listed);
            }
            let passed = result.split_once(". ").and_then(|(_, counts)| counts.split_once(" passed"));
            self.passed += passed.and_then(|(count, _)| count.parse::<usize>().ok()).unwrap_or_default();
        } else if let Some(name) = line.strip_prefix("    ") {
            self.listed.push(name.to_owned());
        } else if let Some((count, _)) =
            line.strip_prefix("error: ").and_then(|line| line.split_once(" target"))
        {
            self.failed = count.parse().unwrap_or_default();
        }
    }

    /// The tests that failed, if that is all that went wrong: none if a program crashed or did not compile.
    pub fn names(&self) -> Option<&[String]> {
        (self.told > 0 && self.told == self.failed && self.names.len() >= self.told)
            .then_some(&self.names[..])
    }

    /// How many tests passed.
    pub fn passed(&self) -> usize {
        self.passed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LISTS: &str = "
running 3 tests
test a::one ... FAILED
test a::two ... ok

failures:

---- a::one stdout ----
    not a name
failures:
    a::one
    lib.rs - (line 3)

test result: FAILED. 1 passed; 2 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.00s

test result: ok. 5 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.00s
";

    fn read(text: &str) -> Failures {
        let mut failures = Failures::default();
        text.lines().for_each(|line| failures.line(line));
        failures
    }

    #[test]
    fn names_are_the_last_list_of_each_program() {
        let failures = read(&format!("{LISTS}error: 1 target failed:\n    `-p cantap-can --lib`\n"));
        assert_eq!(failures.names().unwrap(), ["a::one", "lib.rs - (line 3)"]);
        assert_eq!(failures.passed(), 6);
    }

    #[test]
    fn a_program_that_crashes_is_not_a_test_that_failed() {
        for end in
            ["error: 2 targets failed:\n    `-p a`\n    `-p b`\n", "error: could not compile `a`\n", ""]
        {
            assert_eq!(read(&format!("{LISTS}{end}")).names(), None, "{end}");
        }
        assert_eq!(read("error: 1 target failed:\n    `-p a`\n").names(), None);
    }
}
