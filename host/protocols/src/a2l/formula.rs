//! Formulas of conversions (FORMULA): numbers, the measured number `X1` (also `X` and `x`), `+ - * /`, parentheses, and the usual functions.
//!
//! `^` is not evaluated: tools take it for a power or for an exclusive or. Nor are operations on bits.

/// How deep parentheses and signs may be within each other.
const DEEPEST: usize = 64;
/// How many operations a formula may have.
const MOST_OPERATIONS: usize = 1000;

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

/// As tools name them. What `log` is without a number behind it, they do not agree on: it is not evaluated.
const FUNCTIONS: [(&str, Function); 17] = [
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
];

impl Formula {
    /// Reads a formula; `None` if anything in it is not understood.
    pub fn read(text: &str) -> Option<Self> {
        let mut parser = Parser { rest: text.trim_start(), depth: 0, operations: 0 };
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
        let mut left = self.factor()?;
        while let Some(operator) = self.take(&['*', '/']) {
            left = Term::Binary(operator, left.into(), self.factor()?.into());
        }
        Some(left)
    }

    fn factor(&mut self) -> Option<Term> {
        self.depth += 1;
        if self.depth > DEEPEST || self.operations > MOST_OPERATIONS {
            return None;
        }
        let factor = match self.take(&['+', '-', '(']) {
            Some('+') => self.factor()?,
            Some('-') => Term::Negative(self.factor()?.into()),
            Some(_) => {
                let inner = self.sum()?;
                self.take(&[')'])?;
                inner
            }
            None => self.word_or_number()?,
        };
        self.depth -= 1;
        Some(factor)
    }

    fn word_or_number(&mut self) -> Option<Term> {
        let end =
            self.rest.find(|letter: char| !letter.is_ascii_alphanumeric() && letter != '.' && letter != '_');
        let (mut word, mut rest) = self.rest.split_at(end.unwrap_or(self.rest.len()));
        // 1E-3 is one number.
        if word.starts_with(|first: char| first.is_ascii_digit() || first == '.')
            && word.ends_with(['e', 'E'])
        {
            let behind = rest.strip_prefix(['+', '-'])?;
            let digits = behind.find(|letter: char| !letter.is_ascii_digit()).unwrap_or(behind.len());
            (word, rest) = self.rest.split_at(word.len() + 1 + digits);
        }
        self.rest = rest.trim_start();
        if let Ok(number) = word.parse::<f64>()
            && word.starts_with(|first: char| first.is_ascii_digit() || first == '.')
        {
            return Some(Term::Number(number));
        }
        let name = word.to_ascii_lowercase();
        if name == "x" || name == "x1" {
            return Some(Term::Measured);
        }
        let is_power = name == "pow" || name == "power";
        let function = FUNCTIONS.iter().position(|(known, _)| *known == name);
        if !is_power && function.is_none() {
            return None;
        }
        self.take(&['('])?;
        let first = self.sum()?;
        let term = if let Some(at) = function {
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

    #[test]
    fn formulas_have_the_usual_precedence() {
        for (text, at_4) in [
            ("X1", 4.0),
            ("X1 * 0.5 - 40", -38.0),
            ("(X1 + 2) * 3", 18.0),
            ("10 - X1 - 1", 5.0),
            ("-X1 / 2", -2.0),
            ("1E-1*x+1e+1", 10.4),
            ("sqrt(X) + pow(X1, 2)", 18.0),
            ("LOG10(25 * X1)", 2.0),
            (".5*X1", 2.0),
        ] {
            let value = Formula::read(text).unwrap_or_else(|| panic!("{text}")).value(4.0);
            assert!((value - at_4).abs() < 1e-12, "{text}: {value}");
        }
    }

    #[test]
    fn what_is_not_understood_is_no_formula() {
        for text in [
            "",
            "X1^2",
            "X2",
            "X1 +",
            "(X1",
            "X1)",
            "X1 & 3",
            "sin X1",
            "log(X1)",
            "pow(X1)",
            "system(X1)",
            "1.2.3",
            "X1 X1",
        ] {
            assert_eq!(Formula::read(text), None, "{text}");
        }
        assert_eq!(Formula::read(&"(".repeat(100_000)), None);
        assert_eq!(Formula::read(&"-".repeat(100_000)), None);
        assert_eq!(Formula::read(&format!("X1{}", "+1".repeat(100_000))), None);
        assert!(Formula::read(&format!("{}X1{}", "(".repeat(60), ")".repeat(60))).is_some());
    }
}
