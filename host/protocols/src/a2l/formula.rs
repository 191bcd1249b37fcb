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
    Function(Function, Vec<Self>),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Function {
    One(One),
    Power,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum One {
    Abs,
    Sqrt,
    Exp,
    Ln,
    Log10,
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Sinh,
    Cosh,
    Tanh,
}

/// As tools name them. What `log` is without a number behind it, they do not agree on: it is not evaluated.
const FUNCTIONS: [(&str, Function); 17] = [
    ("abs", Function::One(One::Abs)),
    ("sqrt", Function::One(One::Sqrt)),
    ("exp", Function::One(One::Exp)),
    ("ln", Function::One(One::Ln)),
    ("log10", Function::One(One::Log10)),
    ("sin", Function::One(One::Sin)),
    ("cos", Function::One(One::Cos)),
    ("tan", Function::One(One::Tan)),
    ("asin", Function::One(One::Asin)),
    ("acos", Function::One(One::Acos)),
    ("atan", Function::One(One::Atan)),
    ("arcsin", Function::One(One::Asin)),
    ("arccos", Function::One(One::Acos)),
    ("arctan", Function::One(One::Atan)),
    ("sinh", Function::One(One::Sinh)),
    ("cosh", Function::One(One::Cosh)),
    ("tanh", Function::One(One::Tanh)),
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
            Self::Function(Function::Power, terms) => match &terms[..] {
                [base, exponent] => base.value(x).powf(exponent.value(x)),
                _ => f64::NAN,
            },
            Self::Function(Function::One(one), terms) => {
                let value = terms.first().map_or(f64::NAN, |term| term.value(x));
                match one {
                    One::Abs => value.abs(),
                    One::Sqrt => value.sqrt(),
                    One::Exp => value.exp(),
                    One::Ln => value.ln(),
                    One::Log10 => value.log10(),
                    One::Sin => value.sin(),
                    One::Cos => value.cos(),
                    One::Tan => value.tan(),
                    One::Asin => value.asin(),
                    One::Acos => value.acos(),
                    One::Atan => value.atan(),
                    One::Sinh => value.sinh(),
                    One::Cosh => value.cosh(),
                    One::Tanh => value.tanh(),
                }
            }
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
        let known = FUNCTIONS.iter().find(|(known, _)| *known == name).map(|(_, function)| *function);
        let function = known.or_else(|| (name == "pow" || name == "power").then_some(Function::Power))?;
        self.take(&['('])?;
        let mut terms = vec![self.sum()?];
        while self.take(&[',']).is_some() {
            terms.push(self.sum()?);
        }
        self.take(&[')'])?;
        let wanted = if function == Function::Power { 2 } else { 1 };
        (terms.len() == wanted).then_some(Term::Function(function, terms))
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
