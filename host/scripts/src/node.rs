//! A script, and the thread that it runs in.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use cantap_can::CHANNELS;
use rhai::{AST, ASTNode, Engine, Expr, Scope, Stmt};

use crate::constant_replies::constant_replies;
use crate::exchange::{Input, Next, Output, Resume, Turn, Wanted};
use crate::functions;
use crate::runtime::Runtime;
use crate::sandbox::{self, ENDED, Operations, STACK_BYTES};
use crate::script_result::describe;
use crate::surroundings::Surroundings;

/// The functions whose names begin so are tests.
const TEST_PREFIX: &str = "test_";

/// A node: its name and what it does.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Script {
    /// Its name in reports, usually its file's.
    pub name: String,
    /// Its source.
    pub source: String,
    /// What its `setting(…)` returns in place of the defaults, by name, as users write it.
    pub settings: BTreeMap<String, String>,
}

/// Why a script cannot run.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ScriptError {
    /// It is not in the language.
    #[error("{name}: {reason}")]
    Syntax {
        /// The script.
        name: String,
        /// What is not, and where.
        reason: String,
    },
    /// Nothing to run.
    #[error("there is no script to run")]
    None,
    /// What is to go wrong on the simulated buses cannot.
    #[error("{reason}")]
    Fault {
        /// Why not.
        reason: String,
    },
    /// The system gives no thread.
    #[error("{name}: cannot start: {reason}")]
    Thread {
        /// The script.
        name: String,
        /// Why not.
        reason: String,
    },
}

impl Script {
    /// One without settings.
    pub const fn new(name: String, source: String) -> Self {
        Self { name, source, settings: BTreeMap::new() }
    }

    /// Its tests, in the order of its text.
    ///
    /// # Errors
    /// If it is not in the language.
    pub fn tests(&self) -> Result<Vec<String>, ScriptError> {
        let engine = sandbox::engine(&Operations::default());
        Ok(tests_of(&self.compile(&engine)?, &self.source))
    }

    pub(crate) fn compile(&self, engine: &Engine) -> Result<AST, ScriptError> {
        let faulty = |error: rhai::ParseError| ScriptError::Syntax {
            name: self.name.clone(),
            reason: error.to_string(),
        };
        engine.compile(&self.source).map_err(faulty)
    }
}

/// The tests of a script in the order of its text; the compiler keeps them in no order.
fn tests_of(ast: &AST, source: &str) -> Vec<String> {
    let functions = ast.iter_functions().filter(|function| function.params.is_empty());
    let mut names: Vec<String> = functions
        .map(|function| function.name.to_owned())
        .filter(|name| name.starts_with(TEST_PREFIX))
        .collect();
    names.sort_by_key(|name| (source.find(&format!("fn {name}(")), name.clone()));
    names
}

/// Whether a script's text has calls of `test(name, rows, function)`, which make tests when they run.
fn makes_tests(ast: &AST) -> bool {
    let mut found = false;
    ast.walk(&mut |path| {
        if let Some(ASTNode::Expr(Expr::FnCall(call, _)) | ASTNode::Stmt(Stmt::FnCall(call, _))) = path.last()
        {
            found |= call.name == "test" && call.args.len() == 3;
        }
        !found
    });
    found
}

/// What follows a script's own text: its `on_start`, then its tests, each between `setup` and `teardown`, or else its functions for as
/// long as there are any.
fn tail_of(ast: &AST, source: &str) -> String {
    let has =
        |name: &str| ast.iter_functions().any(|function| function.name == name && function.params.is_empty());
    let mut tail = String::new();
    if has("on_start") {
        tail.push_str("on_start();\n");
    }
    let step = |name: &str| if has(name) { format!("Fn(\"{name}\")") } else { String::new() };
    let (setup, teardown) = (step("setup"), step("teardown"));
    let tests = tests_of(ast, source);
    // Writing to a text cannot fail.
    let _ = writeln!(tail, "tests_are_known();");
    for test in &tests {
        let _ = writeln!(tail, "run_test(\"{test}\", [{setup}], Fn(\"{test}\"), [{teardown}]);");
    }
    let of_rows = format!("run_tests_of_rows([{setup}], [{teardown}])");
    let _ = if tests.is_empty() {
        writeln!(tail, "if !{of_rows} {{ serve(); }}")
    } else {
        writeln!(tail, "{of_rows};")
    };
    tail
}

/// A script that has begun.
pub struct Node {
    /// Its name.
    pub name: String,
    /// Its tests, in their order, as far as they are known: the run ends with the last one.
    pub tests: Vec<String>,
    /// Whether its own lines will make more tests.
    makes_tests: bool,
    /// How many of them have ended.
    pub tests_ended: usize,
    /// When the one after these began, in nanoseconds since the run began.
    pub test_began_ns: Option<u64>,
    /// When it is to be woken, if nothing happens before.
    pub wake_ns: Option<u64>,
    /// Whether it has ended.
    pub has_ended: bool,
    /// Whether it has ended because its node has no power, and begins anew later.
    pub comes_back: bool,
    /// The error with which it has ended.
    pub error: Option<String>,
    inputs: Wanted,
    /// Ends it when true, whatever it does.
    stop: Arc<AtomicBool>,
    /// Frames that were on the bus, of which it does not know yet.
    confirmed: [usize; CHANNELS],
    to: Option<SyncSender<Resume>>,
    from: Receiver<Turn>,
    thread: Option<JoinHandle<()>>,
}

impl Node {
    /// Starts the `number`th script of a run, from 0, with random numbers of its own; its first turn is at once.
    pub fn start_nth(
        number: u64,
        script: &Script,
        surroundings: &Surroundings,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, ScriptError> {
        let seed = surroundings.seed.wrapping_mul(0x9E37_79B9).wrapping_add(number).wrapping_add(1);
        let ast = script.compile(&sandbox::engine(&Operations::default()))?;
        let (to, resume) = sync_channel(1);
        let (turn, from) = sync_channel(1);
        let own = Surroundings { seed, ..surroundings.clone() };
        let (text, stops) = (script.clone(), Arc::clone(&stop));
        let thread = std::thread::Builder::new()
            .name(format!("script {}", script.name))
            .stack_size(STACK_BYTES)
            .spawn(move || run(&text, resume, turn, own, &stops))
            .map_err(|error| ScriptError::Thread { name: script.name.clone(), reason: error.to_string() })?;
        Ok(Self {
            name: script.name.clone(),
            tests: tests_of(&ast, &script.source),
            makes_tests: makes_tests(&ast),
            tests_ended: 0,
            test_began_ns: None,
            wake_ns: Some(0),
            has_ended: false,
            comes_back: false,
            error: None,
            inputs: Wanted::default(),
            stop,
            confirmed: [0; CHANNELS],
            to: Some(to),
            from,
            thread: Some(thread),
        })
    }

    /// Whether it has tests, or will have.
    pub const fn has_tests(&self) -> bool {
        !self.tests.is_empty() || self.makes_tests
    }

    /// Whether it has not come to make its tests.
    pub const fn waits_for_tests(&self) -> bool {
        self.makes_tests && !self.has_ended
    }

    /// Whether it waits for keys.
    pub const fn waits_for_keys(&self) -> bool {
        !self.has_ended && self.inputs.keys
    }

    /// Ends it from outside, without an error.
    pub fn end(&mut self) {
        self.has_ended = true;
        self.wake_ns = None;
        self.to = None;
    }

    /// Its turn, if it has one for this input: returns what it wants.
    pub fn resume(&mut self, now_ns: u64, input: Option<Input>) -> Vec<Output> {
        if self.has_ended {
            return Vec::new();
        }
        if input.as_ref().is_some_and(|input| !self.inputs.has(input)) {
            if let Some(Input::Sent { channel } | Input::NotSent { channel }) = input {
                self.confirmed[channel.index()] += 1;
            }
            return Vec::new();
        }
        let confirmed = std::mem::take(&mut self.confirmed);
        let is_sent = self.to.as_ref().is_some_and(|to| to.send(Resume { now_ns, input, confirmed }).is_ok());
        let turn = if is_sent { self.from.recv().ok() } else { None };
        let lost = || Turn {
            outputs: Vec::new(),
            next: Next::End { error: Some("the script's thread has died; please report this".to_owned()) },
        };
        let Turn { outputs, next } = turn.unwrap_or_else(lost);
        for output in &outputs {
            match output {
                Output::Tests(names) => {
                    self.tests.extend(names.iter().cloned());
                    self.makes_tests = false;
                }
                Output::TestBegan(_) => self.test_began_ns = Some(now_ns),
                Output::Test { .. } => {
                    self.tests_ended += 1;
                    self.test_began_ns = None;
                }
                Output::Send { .. }
                | Output::Repeat { .. }
                | Output::EndRepeat { .. }
                | Output::Reply { .. }
                | Output::Fault { .. }
                | Output::Log(_) => {}
            }
        }
        match next {
            Next::Wait { until_ns, inputs } => {
                self.wake_ns = until_ns;
                self.inputs = inputs;
            }
            Next::End { error } => {
                self.wake_ns = None;
                self.has_ended = true;
                self.error = error;
            }
        }
        outputs
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        // Its wait fails now, or its next operation, which ends it.
        self.stop.store(true, Ordering::Relaxed);
        self.to = None;
        while self.from.recv().is_ok() {}
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A script's thread.
fn run(
    script: &Script,
    resume: Receiver<Resume>,
    turn: SyncSender<Turn>,
    surroundings: Surroundings,
    stop: &Arc<AtomicBool>,
) {
    let operations = Operations::until(Arc::clone(stop));
    let settings = script.settings.clone();
    let runtime = Runtime::new(resume, turn, operations.clone(), surroundings, settings);
    let mut engine = sandbox::engine(&operations);
    functions::register(&mut engine, &runtime);
    let result = runtime.begin().map_err(|error| describe(&error)).and_then(|()| {
        let ast = script.compile(&engine).map_err(|error| error.to_string())?;
        runtime.set_constant_replies(constant_replies(&ast));
        let tail = engine.compile(tail_of(&ast, &script.source)).map_err(|error| error.to_string())?;
        let mut scope = Scope::new();
        operations.begin();
        engine.run_ast_with_scope(&mut scope, &ast).map_err(|error| describe(&error))?;
        // Its own lines have asked for all settings that it knows.
        runtime.settings.check()?;
        let tail = ast.clone_functions_only().merge(&tail);
        engine.run_ast_with_scope(&mut scope, &tail).map_err(|error| describe(&error))
    });
    let is_stopped = stop.load(Ordering::Relaxed);
    runtime.finish(result.err().filter(|error| error != ENDED && !is_stopped));
}
