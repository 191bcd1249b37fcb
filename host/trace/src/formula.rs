//! Formulas of one number, as conversions in MF4 and A2L have them (ASAM MCD-2 MC): numbers, the measured number `X1` (also `X` and `x`),
//! `+ - * /`, parentheses, and the usual functions.

/// How deep parentheses and signs may be within each other.
const DEEPEST: usize = 64;
/// How many operations a formula may have.
const MOST_OPERATIONS: usize = 1000;

/// What the formulas of a file are taken to say where programs differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dialect {
    /// Of A2L, whose `^` is a power or an exclusive or, and whose `log` is natural or decimal: neither is read.
    A2l,
    /// Of MDF: `^` and `**` are powers, `log` is decimal, `pi` is a number.
    Mdf,
}

/// A formula of one number.
#[derive(Clone, Debug, PartialEq)]
pub struct Formula(Term);

#[derive(Clone, Debug, PartialEq)]
enum Term {
    Number(f64),
    Measured,
    Negative(Box<Self>),
    Binary(char, Box<Self>, Box<Self>),
    /// By its index in [`FUNCTIONS`].
    Function(usize, Box<Self>),
    Power(Box<Self>, Box<Self>),
}

type Function = fn(f64) -> f64;

/// As programs name them.
const FUNCTIONS: [(&str, Function); 21] = [
    ("abs", f64::abs),
    ("sqrt", f64::sqrt),
    ("exp", f64::exp),
    ("ln", f64::ln),
    ("log10", f64::log10),
    ("sin", f64::sin),
    ("cos", f64::cos),
    ("tan", f64::tan),
    ("asin", f64::asin),
    ("acos", f64::acos),
    ("atan", f64::atan),
    ("arcsin", f64::asin),
    ("arccos", f64::acos),
    ("arctan", f64::atan),
    ("sinh", f64::sinh),
    ("cosh", f64::cosh),
    ("tanh", f64::tanh),
    ("ceil", f64::ceil),
    ("floor", f64::floor),
    ("round", f64::round),
    LOG,
];
/// Of MDF only.
const LOG: (&str, Function) = ("log", f64::log10);

impl Formula {
    /// Reads a formula; `None` if anything in it is not understood, or if it is longer or deeper than any that a person writes.
    pub fn read(text: &str, dialect: Dialect) -> Option<Self> {
        let mut parser = Parser { rest: text.trim_start(), dialect, depth: 0, operations: 0 };
        let term = parser.sum()?;
        parser.rest.is_empty().then_some(Self(term))
    }

    /// Its value for a number.
    pub fn value(&self, number: f64) -> f64 {
        self.0.value(number)
    }
}

impl Term {
    fn value(&self, x: f64) -> f64 {
        match self {
            Self::Number(number) => *number,
            Self::Measured => x,
            Self::Negative(term) => -term.value(x),
            Self::Binary(operator, left, right) => {
                let (left, right) = (left.value(x), right.value(x));
                match operator {
                    '+' => left + right,
                    '-' => left - right,
                    '*' => left * right,
                    _ => left / right,
                }
            }
            Self::Power(base, exponent) => base.value(x).powf(exponent.value(x)),
            Self::Function(at, of) => FUNCTIONS[*at].1(of.value(x)),
        }
    }
}

struct Parser<'t> {
    rest: &'t str,
    dialect: Dialect,
    depth: usize,
    operations: usize,
}

impl Parser<'_> {
    /// Takes one of these characters, and the blanks behind it.
    fn take(&mut self, wanted: &[char]) -> Option<char> {
        let first = self.rest.chars().next().filter(|first| wanted.contains(first))?;
        self.operations += 1;
        self.rest = self.rest[first.len_utf8()..].trim_start();
        Some(first)
    }

    fn sum(&mut self) -> Option<Term> {
        let mut left = self.product()?;
        while let Some(operator) = self.take(&['+', '-']) {
            left = Term::Binary(operator, left.into(), self.product()?.into());
        }
        Some(left)
    }

    fn product(&mut self) -> Option<Term> {
        let mut left = self.signed()?;
        while !self.rest.starts_with("**")
            && let Some(operator) = self.take(&['*', '/'])
        {
            left = Term::Binary(operator, left.into(), self.signed()?.into());
        }
        Some(left)
    }

    /// A sign binds less than a power: -2^2 is -4.
    fn signed(&mut self) -> Option<Term> {
        self.depth += 1;
        if self.depth > DEEPEST || self.operations > MOST_OPERATIONS {
            return None;
        }
        let term = match self.take(&['+', '-']) {
            Some('-') => Term::Negative(self.signed()?.into()),
            Some(_) => self.signed()?,
            None => self.power()?,
        };
        self.depth -= 1;
        Some(term)
    }

    fn power(&mut self) -> Option<Term> {
        let base = self.atom()?;
        if self.dialect == Dialect::A2l {
            return Some(base);
        }
        let Some(rest) = self.rest.strip_prefix('^').or_else(|| self.rest.strip_prefix("**")) else {
            return Some(base);
        };
        self.operations += 1;
        self.rest = rest.trim_start();
        Some(Term::Power(base.into(), self.signed()?.into()))
    }

    fn atom(&mut self) -> Option<Term> {
        if self.take(&['(']).is_some() {
            let inner = self.sum()?;
            self.take(&[')'])?;
            return Some(inner);
        }
        let end =
            self.rest.find(|letter: char| !letter.is_ascii_alphanumeric() && letter != '.' && letter != '_');
        let (mut word, mut rest) = self.rest.split_at(end.unwrap_or(self.rest.len()));
        let is_number = word.starts_with(|first: char| first.is_ascii_digit() || first == '.');
        // 1E-3 is one number.
        if is_number && word.ends_with(['e', 'E']) {
            let behind = rest.strip_prefix(['+', '-'])?;
            let digits = behind.find(|letter: char| !letter.is_ascii_digit()).unwrap_or(behind.len());
            (word, rest) = self.rest.split_at(word.len() + 1 + digits);
        }
        self.rest = rest.trim_start();
        if is_number {
            return word.parse().ok().map(Term::Number);
        }
        match word.to_ascii_lowercase().as_str() {
            "x" | "x1" => Some(Term::Measured),
            "pi" if self.dialect == Dialect::Mdf => Some(Term::Number(std::f64::consts::PI)),
            name => self.function(name),
        }
    }

    /// What follows a function's name.
    fn function(&mut self, name: &str) -> Option<Term> {
        let is_power = name == "pow" || name == "power";
        let known = FUNCTIONS.iter().position(|(known, _)| *known == name);
        if !is_power && known.is_none() || self.dialect == Dialect::A2l && name == LOG.0 {
            return None;
        }
        self.take(&['('])?;
        let first = self.sum()?;
        let term = if let Some(at) = known {
            Term::Function(at, first.into())
        } else {
            self.take(&[','])?;
            Term::Power(first.into(), self.sum()?.into())
        };
        self.take(&[')'])?;
        Some(term)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOTH: [Dialect; 2] = [Dialect::A2l, Dialect::Mdf];

    fn assert_values(dialect: Dialect, formulas: &[(&str, f64, f64)]) {
        for (text, x, expected) in formulas {
            let value = Formula::read(text, dialect).unwrap_or_else(|| panic!("{text}")).value(*x);
            assert!((value - expected).abs() < 1e-9, "{text}: {value}");
        }
    }

    #[test]
    fn formulas_have_the_usual_precedence() {
        for dialect in BOTH {
            assert_values(
                dialect,
                &[
                    ("X1", 4.0, 4.0),
                    ("X1 * 0.5 - 40", 4.0, -38.0),
                    ("(X1 + 2) * 3", 4.0, 18.0),
                    ("10 - X1 - 1", 4.0, 5.0),
                    ("-X1 / 2", 4.0, -2.0),
                    ("1E-1*x+1e+1", 4.0, 10.4),
                    ("sqrt(X) + pow(X1, 2)", 4.0, 18.0),
                    ("LOG10(25 * X1)", 4.0, 2.0),
                    (".5*X1", 4.0, 2.0),
                    ("(X-32)/1.8", 212.0, 100.0),
                    ("sqrt(abs(X)) + 1.5e2", -9.0, 153.0),
                ],
            );
        }
    }

    #[test]
    fn powers_and_logarithms_are_those_of_mdf_only() {
        let formulas = [
            ("1 + 2 * x ^ 2", 3.0, 19.0),
            ("-2^2", 0.0, -4.0),
            ("2^-1", 0.0, 0.5),
            ("2^3^2", 0.0, 512.0),
            ("X**2", 4.0, 16.0),
            ("2 * X ** 2 * 3", 4.0, 96.0),
            ("log(X)*10", 100.0, 20.0),
        ];
        assert_values(Dialect::Mdf, &formulas);
        for (text, ..) in formulas {
            assert_eq!(Formula::read(text, Dialect::A2l), None, "{text}");
        }
    }

    #[test]
    fn what_is_not_understood_or_too_long_is_no_formula() {
        let deep = ["(".repeat(100_000), "1".into(), ")".repeat(100_000)].concat();
        let long = format!("X1{}", "+1".repeat(100_000));
        let (signs, powers) = ("-".repeat(100_000), "2^".repeat(100_000) + "2");
        for text in [
            "",
            "X2",
            "X1 +",
            "(X1",
            "X1)",
            "X1 & 3",
            "sin X1",
            "pow(X1)",
            "system(X1)",
            "1.2.3",
            "1..2",
            "Y",
            "X1 X1",
            &deep,
            &long,
            &signs,
            &powers,
        ] {
            for dialect in BOTH {
                assert_eq!(Formula::read(text, dialect), None, "{}", &text[..text.len().min(20)]);
            }
        }
        assert!(Formula::read(&format!("{}X1{}", "(".repeat(60), ")".repeat(60)), Dialect::A2l).is_some());
    }
}
