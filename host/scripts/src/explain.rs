//! Which of a script's statements send, and where each of them runs.

use std::collections::BTreeMap;

use rhai::{AST, ASTNode, Expr, Position, Stmt};

use crate::node::{Script, ScriptError};
use crate::placement::{Placement, Statement, Target};
use crate::sandbox::{self, Operations};

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

/// A function of the script, also one without a name.
struct Function {
    name: String,
    begin: Position,
    /// None if it is a single expression.
    end: Position,
}

impl Function {
    fn all(ast: &AST) -> Vec<Self> {
        let functions = ast.iter_fn_def().map(|function| Self {
            name: function.name.to_string(),
            begin: function.body.start_position(),
            end: function.body.end_position(),
        });
        functions.collect()
    }

    /// The innermost one in which a statement stands that is directly in a function.
    fn around(all: &[Self], statement: Position) -> Option<&str> {
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

/// A function that is called somewhere.
struct Call {
    /// The function of the script in which it stands; none for the script's own lines.
    of: Option<String>,
    at: Position,
    name: String,
    statement: Statement,
    /// The script's functions that it is given.
    given: Vec<String>,
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
                placement: call.statement.place(target, 0),
            })
            .collect())
    }
}

/// Notes a node of the tree if it is a call that sends, or a function that is given to one.
fn note(path: &[ASTNode<'_>], of: Option<&str>, own: &[&str], calls: &mut Vec<Call>) -> bool {
    let of_call = |node: &ASTNode<'_>| match node {
        ASTNode::Expr(Expr::FnCall(call, at)) | ASTNode::Stmt(Stmt::FnCall(call, at)) => {
            Some((call.name.to_string(), *at, false))
        }
        ASTNode::Expr(Expr::MethodCall(call, at)) => Some((call.name.to_string(), *at, true)),
        _ => None,
    };
    let Some(node) = path.last() else { return true };
    if let Some((name, at, is_method)) = of_call(node)
        && !own.contains(&name.as_str())
        && let Some(statement) = Statement::of(&name, is_method)
    {
        calls.push(Call { of: of.map(str::to_owned), at, name, statement, given: Vec::new() });
    }
    if let ASTNode::Expr(Expr::DynamicConstant(value, _)) = node
        && let Some(function) = value.read_lock::<rhai::FnPtr>()
    {
        // The innermost call that is noted takes it: what stands in between makes a function of it.
        let around: Vec<Position> = path.iter().filter_map(of_call).map(|(_, at, _)| at).collect();
        if let Some(call) = calls.iter_mut().rev().find(|call| around.contains(&call.at)) {
            call.given.push(function.fn_name().to_owned());
        }
    }
    true
}
