//! Functions of a script that do nothing but send one frame that never changes: a device can do that by itself.

use std::collections::BTreeMap;

use cantap_can::{Channel, Frame};
use cantap_trace::grammar;
use rhai::{AST, ASTNode, Expr, Position, Stmt};

use crate::script_function::Function;

/// The functions of a script, also those without names, that only send a constant frame, and what they send where.
pub fn constant_replies(ast: &AST) -> BTreeMap<String, (Channel, Frame)> {
    let functions = Function::all(ast);
    let own_lines: Vec<Position> = ast.statements().iter().map(Stmt::position).collect();
    // Of each function, what each of its statements sends if it does nothing else.
    let mut bodies: BTreeMap<&str, Vec<Option<(Channel, Frame)>>> = BTreeMap::new();
    ast.walk(&mut |path| {
        if let [ASTNode::Stmt(statement)] = path
            && !own_lines.contains(&statement.position())
            && let Some(name) = Function::around(&functions, statement.position())
        {
            bodies.entry(name).or_default().push(sent(statement));
        }
        true
    });
    let constant = bodies.into_iter().filter_map(|(name, body)| match body[..] {
        [Some(reply)] => Some((name.to_owned(), reply)),
        _ => None,
    });
    constant.collect()
}

/// What a statement sends, if it is `send("123#01")` or `send(1, "123#01")` with constants.
fn sent(statement: &Stmt) -> Option<(Channel, Frame)> {
    let call = match statement {
        Stmt::FnCall(call, _) => call,
        Stmt::Expr(expression) => match &**expression {
            Expr::FnCall(call, _) => call,
            _ => return None,
        },
        _ => return None,
    };
    if call.name != "send" {
        return None;
    }
    let (channel, text) = match &call.args[..] {
        [Expr::StringConstant(text, _)] => (Channel::Can1, text),
        [Expr::IntegerConstant(channel, _), Expr::StringConstant(text, _)] => {
            (Channel::from_number(u8::try_from(*channel).ok()?)?, text)
        }
        _ => return None,
    };
    Some((channel, grammar::frame(text).ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sandbox::{self, Operations};

    #[test]
    fn only_what_sends_one_constant_frame_and_does_nothing_else_is_found() {
        let source = r#"
            on_frame("1", |f| send("101#01"));
            on_frame("2", |f| { send(2, "102#02"); });
            let n = 5;
            on_frame("3", |f| send(frame(0x103, [n])));
            on_frame("4", |f| { send("104#"); send("105#"); });
            on_frame("5", |f| if f.dlc > 1 { send("106#") });
            on_frame("6", |f| send(`107#${n}`));
            on_frame("7", |f| log("108#"));
            on_frame("8", |f| send("no frame"));
            on_frame("9", |f| send(3, "109#"));
            fn named(f) { send("110#") }
        "#;
        let ast = sandbox::engine(&Operations::default()).compile(source).unwrap();
        let found: Vec<String> = constant_replies(&ast)
            .values()
            .map(|(channel, frame)| format!("{} {frame}", channel.number()))
            .collect();
        let mut sorted = found;
        sorted.sort();
        assert_eq!(sorted, ["1 101#01", "1 110#", "2 102#02"]);
    }
}
