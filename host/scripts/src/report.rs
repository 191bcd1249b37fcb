//! How a run ended.

use std::fmt::Write as _;

/// How a test ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Everything that it checked was so.
    Passed,
    /// What was not so, or why it could not run.
    Failed(String),
}

/// One test.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TestResult {
    /// Its script.
    pub script: String,
    /// Its function.
    pub name: String,
    /// How it ended.
    pub outcome: Outcome,
    /// When it began, in nanoseconds since the run began.
    pub began_ns: u64,
    /// When it ended.
    pub ended_ns: u64,
    /// The last frames before a failure, each as a line of candump's log format.
    pub trace: Vec<String>,
    /// What came after it: at most 20 frames, within 100 ms, in the same format.
    pub trace_after: Vec<String>,
}

/// What stands between the frames before a failure and those after it.
pub const FAILED_HERE: &str = "--- failed here ---";

impl TestResult {
    /// The frames around a failure, with [`FAILED_HERE`] where it was if any came after it.
    pub fn trace_lines(&self) -> impl Iterator<Item = &str> {
        let mark = (!self.trace_after.is_empty()).then_some(FAILED_HERE);
        let [before, after] = [&self.trace, &self.trace_after].map(|lines| lines.iter().map(String::as_str));
        before.chain(mark).chain(after)
    }
}

/// A line that a script logged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// Nanoseconds since the run began.
    pub at_ns: u64,
    /// Its script.
    pub script: String,
    /// Its text.
    pub text: String,
}

/// How a run ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// Tests, in the order in which they ended.
    pub tests: Vec<TestResult>,
    /// Scripts that ended with an error, and the error.
    pub errors: Vec<(String, String)>,
    /// Nanoseconds that the run took, of the bus's time.
    pub duration_ns: u64,
    /// Frames that the scripts had sent, confirmed by the bus.
    pub frames_sent: u64,
    /// Those among them that the device sent by itself: repeated ones and replies.
    pub frames_repeated: u64,
    /// Frames of others, and those of the other scripts.
    pub frames_received: u64,
    /// Frames that scripts asked for and that had not been on the bus at the end.
    pub frames_not_sent: u64,
    /// Scripts that waited for keys, of which none come in such a run.
    pub without_keys: Vec<String>,
    /// Frames that the device lost.
    pub frames_lost: u64,
}

impl Report {
    /// Whether no test failed and no script ended with an error.
    pub fn is_success(&self) -> bool {
        self.errors.is_empty() && self.failed().next().is_none()
    }

    /// The tests that failed.
    pub fn failed(&self) -> impl Iterator<Item = &TestResult> {
        self.tests.iter().filter(|test| test.outcome != Outcome::Passed)
    }

    /// The same for programs that collect the results of tests, in JUnit's XML: a suite for each script; a script's error is a test named
    /// after it.
    pub fn junit(&self) -> String {
        let mut scripts: Vec<&str> = Vec::new();
        let names =
            self.tests.iter().map(|test| &test.script).chain(self.errors.iter().map(|(script, _)| script));
        for script in names {
            if !scripts.contains(&script.as_str()) {
                scripts.push(script);
            }
        }
        let mut xml = String::from("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites>\n");
        for script in scripts {
            self.suite(script, &mut xml);
        }
        xml.push_str("</testsuites>\n");
        xml
    }

    fn suite(&self, script: &str, xml: &mut String) {
        let tests: Vec<&TestResult> = self.tests.iter().filter(|test| test.script == script).collect();
        let errors: Vec<&str> =
            self.errors.iter().filter(|(of, _)| of == script).map(|(_, error)| error.as_str()).collect();
        let failures = tests.iter().filter(|test| test.outcome != Outcome::Passed).count();
        // Writing to a text cannot fail.
        let _ = writeln!(
            xml,
            "  <testsuite name=\"{}\" tests=\"{}\" failures=\"{failures}\" errors=\"{}\">",
            escape(script),
            tests.len() + errors.len(),
            errors.len()
        );
        for test in tests {
            let seconds = (test.ended_ns - test.began_ns) as f64 / 1e9;
            let _ = write!(
                xml,
                "    <testcase classname=\"{}\" name=\"{}\" time=\"{seconds:.6}\"",
                escape(script),
                escape(&test.name)
            );
            match &test.outcome {
                Outcome::Passed => xml.push_str("/>\n"),
                Outcome::Failed(reason) => {
                    let _ = writeln!(
                        xml,
                        ">\n      <failure message=\"{}\">{}</failure>\n    </testcase>",
                        escape(reason),
                        escape(&test.trace_lines().collect::<Vec<_>>().join("\n"))
                    );
                }
            }
        }
        for error in errors {
            let name = escape(script);
            let _ = writeln!(
                xml,
                "    <testcase classname=\"{name}\" name=\"{name}\">\n      <error message=\"{}\"/>\n    </testcase>",
                escape(error)
            );
        }
        xml.push_str("  </testsuite>\n");
    }
}

/// A text as XML may contain it: XML 1.0 has no way to write most control characters.
fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\n' => escaped.push_str("&#10;"),
            '\t' => escaped.push('\t'),
            '\0'..='\u{1F}' | '\u{7F}'..='\u{9F}' | '\u{FFFE}' | '\u{FFFF}' => {
                escaped.push('\u{FFFD}');
            }
            other => escaped.push(other),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn junit_has_a_suite_for_each_script_and_escapes_what_scripts_wrote() {
        let test = |name: &str, outcome: Outcome| TestResult {
            script: "a.rhai".to_owned(),
            name: name.to_owned(),
            outcome,
            began_ns: 0,
            ended_ns: 1_500_000_000,
            trace: vec!["(0.000001) can0 123#".to_owned()],
            trace_after: vec!["(0.000002) can0 124#".to_owned()],
        };
        let report = Report {
            tests: vec![
                test("test_one", Outcome::Passed),
                test("test_two", Outcome::Failed("<\u{1b}\"&".to_owned())),
            ],
            errors: vec![("b.rhai".to_owned(), "no".to_owned())],
            ..Report::default()
        };
        assert_eq!(
            report.junit(),
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites>\n  <testsuite name=\"a.rhai\" tests=\"2\" failures=\"1\" errors=\"0\">\n    \
             <testcase classname=\"a.rhai\" name=\"test_one\" time=\"1.500000\"/>\n    \
             <testcase classname=\"a.rhai\" name=\"test_two\" time=\"1.500000\">\n      \
             <failure message=\"&lt;\u{FFFD}&quot;&amp;\">(0.000001) can0 123#&#10;--- failed here ---&#10;(0.000002) can0 124#</failure>\n    </testcase>\n  </testsuite>\n  \
             <testsuite name=\"b.rhai\" tests=\"1\" failures=\"0\" errors=\"1\">\n    \
             <testcase classname=\"b.rhai\" name=\"b.rhai\">\n      <error message=\"no\"/>\n    </testcase>\n  </testsuite>\n</testsuites>\n"
        );
        assert!(!report.is_success());
    }
}
