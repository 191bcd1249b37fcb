//! Formulas of one variable, as conversions have them (ASAM MCD-2 MC): numbers, `X` or `X1`, `+ - * / ^`, brackets and functions.

use std::str::FromStr;

/// How deeply brackets may be nested.
const MAX_DEPTH: u32 = 64;

/// A formula.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Formula {
    Variable,
    Number(f64),
    Two(char, Box<Formula>, Box<Formula>),
    /// By its index in [`FUNCTIONS`].
    Function(usize, Box<Formula>),
}

type Function = fn(f64) -> f64;

/// `ln` is the natural logarithm, `log` the decimal one.
const FUNCTIONS: [(&str, Function); 21] = [
    ("abs", f64::abs),
    ("acos", f64::acos),
    ("arccos", f64::acos),
    ("arcsin", f64::asin),
    ("arctan", f64::atan),
    ("asin", f64::asin),
    ("atan", f64::atan),
    ("ceil", f64::ceil),
    ("cos", f64::cos),
    ("cosh", f64::cosh),
    ("exp", f64::exp),
    ("floor", f64::floor),
    ("ln", f64::ln),
    ("log", f64::log10),
    ("log10", f64::log10),
    ("round", f64::round),
    ("sin", f64::sin),
    ("sinh", f64::sinh),
    ("sqrt", f64::sqrt),
    ("tan", f64::tan),
    ("tanh", f64::tanh),
];

impl Formula {
    /// Its value where the variable has this one.
    pub(super) fn value(&self, x: f64) -> f64 {
        match self {
            Self::Variable => x,
            Self::Number(number) => *number,
            Self::Function(at, of) => FUNCTIONS[*at].1(of.value(x)),
            Self::Two(operator, left, right) => {
                let (left, right) = (left.value(x), right.value(x));
                match operator {
                    '+' => left + right,
                    '-' => left - right,
                    '*' => left * right,
                    '/' => left / right,
                    _ => left.powf(right),
                }
            }
        }
    }
}

impl FromStr for Formula {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let text = text.to_ascii_lowercase().replace("**", "^");
        let mut parser = Parser { rest: &text, depth: 0 };
        let formula = parser.sum()?;
        parser.skip();
        if parser.rest.is_empty() { Ok(formula) } else { Err(()) }
    }
}

struct Parser<'a> {
    rest: &'a str,
    depth: u32,
}

impl Parser<'_> {
    fn skip(&mut self) {
        self.rest = self.rest.trim_start();
    }

    /// One of these characters, if it is next.
    fn one_of(&mut self, characters: &[char]) -> Option<char> {
        self.skip();
        let next = self.rest.chars().next().filter(|next| characters.contains(next))?;
        self.rest = &self.rest[next.len_utf8()..];
        Some(next)
    }

    fn sum(&mut self) -> Result<Formula, ()> {
        self.left_to_right(&['+', '-'], Self::product)
    }

    fn product(&mut self) -> Result<Formula, ()> {
        self.left_to_right(&['*', '/'], Self::signed)
    }

    fn left_to_right(
        &mut self,
        operators: &[char],
        part: fn(&mut Self) -> Result<Formula, ()>,
    ) -> Result<Formula, ()> {
        let mut left = part(self)?;
        let mut count = 0;
        while let Some(operator) = self.one_of(operators) {
            // Each makes the formula deeper.
            count += 1;
            if count > MAX_DEPTH {
                return Err(());
            }
            left = Formula::Two(operator, Box::new(left), Box::new(part(self)?));
        }
        Ok(left)
    }

    /// A sign binds less than a power: -2^2 is -4.
    fn signed(&mut self) -> Result<Formula, ()> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(());
        }
        let formula = match self.one_of(&['+', '-']) {
            Some('-') => Formula::Two('-', Box::new(Formula::Number(0.0)), Box::new(self.signed()?)),
            Some(_) => self.signed()?,
            None => self.power()?,
        };
        self.depth -= 1;
        Ok(formula)
    }

    fn power(&mut self) -> Result<Formula, ()> {
        let base = self.atom()?;
        Ok(match self.one_of(&['^']) {
            None => base,
            Some(operator) => Formula::Two(operator, Box::new(base), Box::new(self.signed()?)),
        })
    }

    fn atom(&mut self) -> Result<Formula, ()> {
        if self.one_of(&['(']).is_some() {
            return self.bracket();
        }
        let is_of_name = |character: char| character.is_ascii_alphanumeric() || character == '_';
        let name = self.rest.find(|character| !is_of_name(character)).unwrap_or(self.rest.len());
        let (name, rest) = self.rest.split_at(name);
        if name.starts_with(|character: char| character.is_ascii_alphabetic()) {
            self.rest = rest;
            return match name {
                "x" | "x1" => Ok(Formula::Variable),
                "pi" => Ok(Formula::Number(std::f64::consts::PI)),
                _ => {
                    let known = FUNCTIONS.iter().position(|(known, _)| *known == name).ok_or(())?;
                    self.one_of(&['(']).ok_or(())?;
                    Ok(Formula::Function(known, Box::new(self.bracket()?)))
                }
            };
        }
        self.number()
    }

    /// What is inside a bracket that has been opened.
    fn bracket(&mut self) -> Result<Formula, ()> {
        let inside = self.sum()?;
        self.one_of(&[')']).map(|_| inside).ok_or(())
    }

    fn number(&mut self) -> Result<Formula, ()> {
        let bytes = self.rest.as_bytes();
        let is_inside = |at: usize| match bytes[at] {
            b'0'..=b'9' | b'.' => true,
            b'e' => at > 0,
            b'+' | b'-' => at > 0 && bytes[at - 1] == b'e',
            _ => false,
        };
        let len = (0..bytes.len()).find(|at| !is_inside(*at)).unwrap_or(bytes.len());
        let (number, rest) = self.rest.split_at(len);
        self.rest = rest;
        number.parse().map(Formula::Number).map_err(|_| ())
    }
}

#[cfg(test)]
mod tests {
    use super::Formula;

    #[test]
    fn operators_bind_as_in_mathematics() {
        for (text, x, value) in [
            ("X", 3.0, 3.0),
            ("2*X1+1", 3.0, 7.0),
            ("1 + 2 * x ^ 2", 3.0, 19.0),
            ("-2^2", 0.0, -4.0),
            ("2^-1", 0.0, 0.5),
            ("2^3^2", 0.0, 512.0),
            ("10-3-2", 0.0, 5.0),
            ("(X-32)/1.8", 212.0, 100.0),
            ("sqrt(abs(X)) + 1.5e2", -9.0, 153.0),
            ("log(X)*10", 100.0, 20.0),
            ("X**2", 4.0, 16.0),
        ] {
            let formula: Formula = text.parse().unwrap();
            assert!((formula.value(x) - value).abs() < 1e-9, "{text}: {}", formula.value(x));
        }
    }

    #[test]
    fn what_is_no_formula_or_too_deep_is_refused() {
        let deep = ["(".repeat(1000), "1".into(), ")".repeat(1000)].concat();
        let long = "1+".repeat(1000);
        for text in
            ["", "X+", "(X", "X)", "foo(X)", "sin X", "1..2", "Y", "X X", &deep, &"-".repeat(1000), &long]
        {
            assert_eq!(text.parse::<Formula>(), Err(()), "{text}");
        }
    }
}
