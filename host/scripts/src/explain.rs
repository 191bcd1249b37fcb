//! Which of a script's statements send, and where each of them runs.

use std::collections::BTreeMap;

use cantap_can::{Channel, Frame};
use cantap_trace::grammar::IdPattern;
use rhai::{ASTNode, Expr, Position, Stmt};

use crate::constant_replies::constant_replies;
use crate::handlers::Selector;
use crate::node::{Script, ScriptError};
use crate::placement::{Placement, Statement, Target};
use crate::sandbox::{self, Operations};
use crate::script_function::Function;

/// A statement of a script.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Explained {
    /// The script.
    pub script: String,
    /// Its line, from 1.
    pub line: usize,
    /// The function.
    pub function: String,
    /// The function, and its line, that calls the function in which the statement stands, if one does.
    pub within: Option<(String, usize)>,
    /// Where it runs, and how exactly.
    pub placement: Placement,
}

/// A function that is called somewhere.
struct Call {
    /// The function of the script in which it stands; none for the script's own lines.
    of: Option<String>,
    at: Position,
    name: String,
    statement: Statement,
    /// The script's functions that it is given.
    given: Vec<String>,
    /// Its first argument, if that is a text.
    text: Option<String>,
}

impl Call {
    /// What it is on a target, with the script's functions that are only a constant reply: the device may do that by itself.
    fn statement(&self, constants: &BTreeMap<String, (Channel, Frame)>, target: Target) -> Statement {
        let Target::Device { replies: Some(replies), .. } = target else { return self.statement };
        let reply = self.given.first().and_then(|name| constants.get(name));
        let is_there = reply.is_some_and(|(channel, _)| *channel == replies.channel);
        let selector = match self.text.as_deref().map(str::parse::<IdPattern>) {
            None => Some(Selector::All),
            Some(Ok(ids)) => Some(Selector::Ids { channel: None, ids }),
            Some(Err(_)) => None,
        };
        let fits = selector.is_some_and(|selector| replies.filters(&selector).is_some());
        if self.name == "on_frame" && is_there && fits { Statement::Reply } else { self.statement }
    }
}

impl Script {
    /// Its statements that send or call functions that do, in the order of its text, as they run on `target`.
    ///
    /// # Errors
    /// If it is not in the language.
    pub fn explain(&self, target: Target) -> Result<Vec<Explained>, ScriptError> {
        let engine = sandbox::engine(&Operations::default());
        let ast = self.compile(&engine)?;
        let mut calls = Vec::new();
        let own: Vec<&str> = ast.iter_functions().map(|function| function.name).collect();
        let is_own_line: Vec<Position> = ast.statements().iter().map(Stmt::position).collect();
        let functions = Function::all(&ast);
        let constants = constant_replies(&ast);
        ast.walk(&mut |path| {
            let root = match path.first() {
                Some(ASTNode::Stmt(root)) => root.position(),
                Some(ASTNode::Expr(root)) => root.position(),
                _ => Position::NONE,
            };
            let of = if is_own_line.contains(&root) { None } else { Function::around(&functions, root) };
            note(path, of, &own, &mut calls)
        });
        calls.sort_by_key(|call: &Call| (call.at.line(), call.at.position()));
        let callers: BTreeMap<&str, &Call> = calls
            .iter()
            .flat_map(|call| call.given.iter().map(move |given| (given.as_str(), call)))
            .collect();
        let line = |call: &Call| call.at.line().unwrap_or_default();
        Ok(calls
            .iter()
            .map(|call| Explained {
                script: self.name.clone(),
                line: line(call),
                function: call.name.clone(),
                within: call
                    .of
                    .as_deref()
                    .and_then(|of| callers.get(of))
                    .map(|caller| (caller.name.clone(), line(caller))),
                placement: {
                    let of = |call: &Call| call.statement(&constants, target);
                    let caller = call.of.as_deref().and_then(|of| callers.get(of)).map(|caller| of(caller));
                    // What the device does by itself, it does with what stands in it.
                    let statement =
                        if caller == Some(Statement::Reply) { Statement::Reply } else { of(call) };
                    statement.place(target, 0)
                },
            })
            .collect())
    }
}

/// Notes a node of the tree if it is a call that sends, or a function that is given to one.
fn note(path: &[ASTNode<'_>], of: Option<&str>, own: &[&str], calls: &mut Vec<Call>) -> bool {
    let text = |call: &rhai::FnCallExpr| match call.args.first() {
        Some(Expr::StringConstant(text, _)) => Some(text.to_string()),
        _ => None,
    };
    let of_call = |node: &ASTNode<'_>| match node {
        ASTNode::Expr(Expr::FnCall(call, at)) | ASTNode::Stmt(Stmt::FnCall(call, at)) => {
            Some((call.name.to_string(), *at, false, text(call)))
        }
        ASTNode::Expr(Expr::MethodCall(call, at)) => Some((call.name.to_string(), *at, true, None)),
        _ => None,
    };
    let Some(node) = path.last() else { return true };
    if let Some((name, at, is_method, text)) = of_call(node)
        && !own.contains(&name.as_str())
        && let Some(statement) = Statement::of(&name, is_method)
    {
        calls.push(Call { of: of.map(str::to_owned), at, name, statement, given: Vec::new(), text });
    }
    if let ASTNode::Expr(Expr::DynamicConstant(value, _)) = node
        && let Some(function) = value.read_lock::<rhai::FnPtr>()
    {
        // The innermost call that is noted takes it: what stands in between makes a function of it.
        let around: Vec<Position> = path.iter().filter_map(of_call).map(|(_, at, ..)| at).collect();
        if let Some(call) = calls.iter_mut().rev().find(|call| around.contains(&call.at)) {
            call.given.push(function.fn_name().to_owned());
        }
    }
    true
}
