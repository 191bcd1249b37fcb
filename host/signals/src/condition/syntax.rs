//! Parses the text of a condition into a tree.

use super::error::{ConditionError, ConditionFault};
use crate::named::PREFIX;

/// Nobody types more; and it bounds the depth of the tree, on which evaluation recurses.
const MAX_CHARACTERS: usize = 2000;

/// Limit for nested parentheses, `not` and signs.
const MAX_DEPTH: usize = 50;

/// A part of a condition and its position.
#[derive(Clone, Debug, PartialEq)]
pub struct Node {
    pub at: usize,
    pub kind: Kind,
}

#[derive(Clone, Debug, PartialEq)]
pub enum Kind {
    Number(f64),
    Text(String),
    /// A signal, a part of the frame or a text: only databases can decide which.
    Name(String),
    Byte(Box<Node>),
    Not(Box<Node>),
    Negative(Box<Node>),
    Binary(Operator, Box<Node>, Box<Node>),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operator {
    Or,
    And,
    Equal,
    NotEqual,
    Less,
    LessOrEqual,
    Greater,
    GreaterOrEqual,
    BitOr,
    BitAnd,
    Add,
    Subtract,
    Multiply,
    Divide,
    Remainder,
}

impl Operator {
    /// From loose to tight; comparisons have 3.
    fn binding(self) -> u8 {
        match self {
            Self::Or => 1,
            Self::And => 2,
            Self::Equal
            | Self::NotEqual
            | Self::Less
            | Self::LessOrEqual
            | Self::Greater
            | Self::GreaterOrEqual => COMPARISON,
            Self::BitOr => 4,
            Self::BitAnd => 5,
            Self::Add | Self::Subtract => 6,
            Self::Multiply | Self::Divide | Self::Remainder => 7,
        }
    }
}

const COMPARISON: u8 = 3;
/// `not` applies to a comparison, but not to `and` or `or`.
const NOT: u8 = COMPARISON;
/// A sign applies only to the next value.
const SIGN: u8 = 8;

#[derive(Clone, Debug, PartialEq)]
enum Token {
    Number(f64),
    Text(String),
    Name(String),
    Operator(Operator),
    Not,
    Open,
    Close,
    OpenIndex,
    CloseIndex,
    End,
}

/// Parses a condition.
pub fn parse(text: &str) -> Result<Node, ConditionError> {
    let error = |(at, fault)| ConditionError { text: text.to_owned(), at, fault };
    if let Some((at, _)) = text.char_indices().nth(MAX_CHARACTERS) {
        return Err(error((at, ConditionFault::TooLong(MAX_CHARACTERS))));
    }
    let tokens = tokens(text).map_err(error)?;
    let mut parser = Parser { text, tokens, next: 0, depth: 0 };
    let node = parser.expression(0).map_err(error)?;
    match parser.peek() {
        Token::End => Ok(node),
        _ => Err(error(parser.unexpected("and, or, or the end"))),
    }
}

type Fault = (usize, ConditionFault);

fn tokens(text: &str) -> Result<Vec<(usize, Token)>, Fault> {
    let mut tokens = Vec::new();
    let mut rest = text;
    loop {
        rest = rest.trim_start();
        let at = text.len() - rest.len();
        let Some(first) = rest.chars().next() else { break };
        let (token, length) = match first {
            '"' | '\'' => quoted(rest, first).ok_or((at, ConditionFault::OpenText))?,
            c if c.is_ascii_digit() || c == '.' => number(rest).map_err(|fault| (at, fault))?,
            c if c.is_alphabetic() || c == '_' => name(rest),
            _ => symbol(rest).ok_or((at, ConditionFault::Character(first)))?,
        };
        tokens.push((at, token));
        rest = &rest[length..];
    }
    tokens.push((text.trim_end().len(), Token::End));
    Ok(tokens)
}

fn quoted(rest: &str, quote: char) -> Option<(Token, usize)> {
    let end = rest[1..].find(quote)?;
    Some((Token::Text(rest[1..=end].to_owned()), end + 2))
}

fn number(rest: &str) -> Result<(Token, usize), ConditionFault> {
    let mut end =
        rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '.' || c == '_')).unwrap_or(rest.len());
    let decimal = !rest.starts_with("0x") && !rest.starts_with("0X");
    // The exponent's sign: 1e-3.
    if decimal && rest[..end].ends_with(['e', 'E']) && rest[end..].starts_with(['+', '-']) {
        end += 1;
        end += rest[end..].find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len() - end);
    }
    let digits = rest[..end].replace('_', "").to_ascii_lowercase();
    let radix = |prefix, radix| {
        let digits = digits.strip_prefix(prefix)?;
        Some(
            u64::from_str_radix(digits, radix)
                .ok()
                .filter(|_| !digits.starts_with('+'))
                .map(|value| value as f64),
        )
    };
    let value = radix("0x", 16).or_else(|| radix("0b", 2)).unwrap_or_else(|| digits.parse().ok());
    let value = value.filter(|value: &f64| value.is_finite());
    match value {
        Some(value) => Ok((Token::Number(value), end)),
        None => Err(ConditionFault::Number(rest[..end].to_owned())),
    }
}

fn name(rest: &str) -> (Token, usize) {
    let length = |rest: &str| {
        rest.find(|c: char| !(c.is_alphanumeric() || c == '_' || c == '.')).unwrap_or(rest.len())
    };
    if let Some(name) = rest.strip_prefix(PREFIX) {
        let end = PREFIX.len() + length(name);
        return (Token::Name(rest[..end].to_owned()), end);
    }
    let end = length(rest);
    let token = match rest[..end].to_ascii_lowercase().as_str() {
        "and" => Token::Operator(Operator::And),
        "or" => Token::Operator(Operator::Or),
        "not" => Token::Not,
        _ => Token::Name(rest[..end].to_owned()),
    };
    (token, end)
}

fn symbol(rest: &str) -> Option<(Token, usize)> {
    const SYMBOLS: &[(&str, Token)] = &[
        ("&&", Token::Operator(Operator::And)),
        ("||", Token::Operator(Operator::Or)),
        ("==", Token::Operator(Operator::Equal)),
        ("!=", Token::Operator(Operator::NotEqual)),
        ("<=", Token::Operator(Operator::LessOrEqual)),
        (">=", Token::Operator(Operator::GreaterOrEqual)),
        ("=", Token::Operator(Operator::Equal)),
        ("<", Token::Operator(Operator::Less)),
        (">", Token::Operator(Operator::Greater)),
        ("!", Token::Not),
        ("&", Token::Operator(Operator::BitAnd)),
        ("|", Token::Operator(Operator::BitOr)),
        ("+", Token::Operator(Operator::Add)),
        ("-", Token::Operator(Operator::Subtract)),
        ("*", Token::Operator(Operator::Multiply)),
        ("/", Token::Operator(Operator::Divide)),
        ("%", Token::Operator(Operator::Remainder)),
        ("(", Token::Open),
        (")", Token::Close),
        ("[", Token::OpenIndex),
        ("]", Token::CloseIndex),
    ];
    let (text, token) = SYMBOLS.iter().find(|(text, _)| rest.starts_with(text))?;
    Some((token.clone(), text.len()))
}

struct Parser<'a> {
    text: &'a str,
    /// The last one is the end of the text.
    tokens: Vec<(usize, Token)>,
    next: usize,
    depth: usize,
}

impl Parser<'_> {
    fn peek(&self) -> &Token {
        &self.tokens[self.next].1
    }

    fn at(&self) -> usize {
        self.tokens[self.next].0
    }

    /// Takes the next token, except for the end, which stays.
    fn take(&mut self) -> Token {
        let token = self.peek().clone();
        self.next = (self.next + 1).min(self.tokens.len() - 1);
        token
    }

    fn unexpected(&self, expected: &'static str) -> Fault {
        let found = if *self.peek() == Token::End {
            "the end".to_owned()
        } else {
            let end = self.tokens.get(self.next + 1).map_or(self.text.len(), |&(at, _)| at);
            format!("{:?}", self.text[self.at()..end].trim())
        };
        (self.at(), ConditionFault::Unexpected { expected, found })
    }

    fn expect(&mut self, token: &Token, expected: &'static str) -> Result<(), Fault> {
        if self.peek() != token {
            return Err(self.unexpected(expected));
        }
        self.take();
        Ok(())
    }

    /// Parses everything that binds tighter than `floor`.
    fn expression(&mut self, floor: u8) -> Result<Node, Fault> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err((self.at(), ConditionFault::TooDeep(MAX_DEPTH)));
        }
        let mut left = self.value()?;
        let mut compared = false;
        while let &Token::Operator(operator) = self.peek() {
            let binding = operator.binding();
            if binding <= floor {
                break;
            }
            if binding == COMPARISON && std::mem::replace(&mut compared, true) {
                return Err((self.at(), ConditionFault::Chained));
            }
            compared &= binding >= COMPARISON;
            self.take();
            let right = self.expression(binding)?;
            left = Node { at: left.at, kind: Kind::Binary(operator, left.into(), right.into()) };
        }
        self.depth -= 1;
        Ok(left)
    }

    fn value(&mut self) -> Result<Node, Fault> {
        const VALUE: &str = "a number, a signal, a part of the frame or \"(\"";
        let at = self.at();
        let kind = match self.peek() {
            Token::Number(_) | Token::Text(_) | Token::Name(_) => match self.take() {
                Token::Number(value) => Kind::Number(value),
                Token::Text(text) => Kind::Text(text),
                Token::Name(name)
                    if *self.peek() == Token::OpenIndex && name.eq_ignore_ascii_case("byte") =>
                {
                    self.take();
                    let index = self.expression(0)?;
                    self.expect(&Token::CloseIndex, "\"]\"")?;
                    Kind::Byte(index.into())
                }
                Token::Name(name) => Kind::Name(name),
                _ => return Err(self.unexpected(VALUE)),
            },
            Token::Open => {
                self.take();
                let inner = self.expression(0)?;
                self.expect(&Token::Close, "\")\"")?;
                inner.kind
            }
            Token::Not => {
                self.take();
                // One below its own binding, so that "not not a" and "not a == b" work.
                Kind::Not(self.expression(NOT - 1)?.into())
            }
            Token::Operator(Operator::Subtract) => {
                self.take();
                Kind::Negative(self.expression(SIGN)?.into())
            }
            _ => return Err(self.unexpected(VALUE)),
        };
        Ok(Node { at, kind })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The tree with every pair of parentheses.
    fn explicit(node: &Node) -> String {
        match &node.kind {
            Kind::Number(value) => value.to_string(),
            Kind::Text(text) => format!("{text:?}"),
            Kind::Name(name) => name.clone(),
            Kind::Byte(index) => format!("byte[{}]", explicit(index)),
            Kind::Not(inner) => format!("not({})", explicit(inner)),
            Kind::Negative(inner) => format!("-({})", explicit(inner)),
            Kind::Binary(operator, left, right) => {
                format!("({} {operator:?} {})", explicit(left), explicit(right))
            }
        }
    }

    #[test]
    fn operators_bind_as_people_expect() {
        for (text, expected) in [
            ("a or b and c", "(a Or (b And c))"),
            ("not a == 1 and b", "(not((a Equal 1)) And b)"),
            ("a & 0x80 != 0", "((a BitAnd 128) NotEqual 0)"),
            ("1 + 2 * 3 - 4", "((1 Add (2 Multiply 3)) Subtract 4)"),
            ("-a * 2", "(-(a) Multiply 2)"),
            ("!(a || b) && byte[1+1] >= 1.5e-1", "(not((a Or b)) And (byte[(1 Add 1)] GreaterOrEqual 0.15))"),
            ("Engine.Speed = 'x y'", "(Engine.Speed Equal \"x y\")"),
            ("a == 1 and b == 2 or c == 3", "(((a Equal 1) And (b Equal 2)) Or (c Equal 3))"),
            ("0b101 + 1_000", "(5 Add 1000)"),
        ] {
            assert_eq!(explicit(&parse(text).unwrap()), expected, "{text}");
        }
    }

    #[test]
    fn errors_point_at_their_place() {
        for (text, at, message) in [
            ("Speed > ", 7, "expected a number, a signal, a part of the frame or \"(\", found the end"),
            ("Speed > and", 8, "expected a number, a signal, a part of the frame or \"(\", found \"and\""),
            ("(a", 2, "expected \")\", found the end"),
            ("byte[1", 6, "expected \"]\", found the end"),
            ("a b", 2, "expected and, or, or the end, found \"b\""),
            ("1 < a < 3", 6, "comparisons cannot be chained; write \"a < b and b < c\""),
            ("a == 'x", 5, "this text has no closing quote"),
            ("a == 0xZZ", 5, "\"0xZZ\" is not a number"),
            ("a == 1e999", 5, "\"1e999\" is not a number; in hexadecimal digits it is 0x1e999"),
            ("id == 7DF", 6, "\"7DF\" is not a number; in hexadecimal digits it is 0x7DF"),
            ("a # b", 2, "'#' has no meaning here"),
            ("", 0, "expected a number, a signal, a part of the frame or \"(\", found the end"),
        ] {
            let error = parse(text).unwrap_err();
            assert_eq!((error.at, error.fault.to_string().as_str()), (at, message), "{text}");
        }
        let error = parse("größe > ?").unwrap_err();
        assert_eq!(error.to_string(), "'?' has no meaning here\n  größe > ?\n          ^");
    }

    #[test]
    fn neither_depth_nor_length_can_overflow() {
        for text in
            ["(".repeat(1000), "not ".repeat(499), "-".repeat(1999), "1+".repeat(1000), "a".repeat(3000)]
        {
            assert!(parse(&text).is_err());
        }
        assert!(parse(&format!("1{}", "+1".repeat(999))).is_ok());
    }
}
