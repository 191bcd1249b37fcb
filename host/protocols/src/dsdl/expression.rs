//! Numbers in definitions: `2 ** 8 - 1`, `24 * 60 * 60`, `'/'`, `SubjectID.1.0.MAX + 1`.

/// The value of an expression of integers, if it is one; `named` has the constants. Divisions that have a remainder have no value here.
pub fn evaluate(text: &str, named: &dyn Fn(&str) -> Option<i128>) -> Option<i128> {
    let text = text.trim();
    if let Some(character) = text.strip_prefix('\'').and_then(|rest| rest.strip_suffix('\'')) {
        return character_value(character);
    }
    let mut parser = Parser { rest: text, named, depth: 0 };
    let value = parser.sum()?;
    parser.rest.trim().is_empty().then_some(value)
}

fn character_value(text: &str) -> Option<i128> {
    let mut characters = text.chars();
    let value = match (characters.next()?, characters.next()) {
        ('\\', Some('n')) => '\n',
        ('\\', Some('r')) => '\r',
        ('\\', Some('t')) => '\t',
        ('\\', Some(same @ ('\\' | '\'' | '"'))) => same,
        (one, None) => return Some(i128::from(u32::from(one))),
        _ => return None,
    };
    characters.next().is_none().then(|| u32::from(value).into())
}

struct Parser<'a> {
    rest: &'a str,
    named: &'a dyn Fn(&str) -> Option<i128>,
    depth: u8,
}

/// How many parentheses and signs may be within each other.
const MOST_DEPTH: u8 = 32;

impl Parser<'_> {
    fn eat(&mut self, sign: &str) -> bool {
        self.rest = self.rest.trim_start();
        let after = self.rest.strip_prefix(sign);
        // `**` is not twice `*`.
        match after.filter(|after| sign != "*" || !after.starts_with('*')) {
            Some(after) => {
                self.rest = after;
                true
            }
            None => false,
        }
    }

    fn sum(&mut self) -> Option<i128> {
        let mut value = self.product()?;
        loop {
            if self.eat("+") {
                value = value.checked_add(self.product()?)?;
            } else if self.eat("-") {
                value = value.checked_sub(self.product()?)?;
            } else {
                return Some(value);
            }
        }
    }

    fn product(&mut self) -> Option<i128> {
        let mut value = self.power()?;
        loop {
            if self.eat("*") {
                value = value.checked_mul(self.power()?)?;
            } else if self.eat("/") {
                let divisor = self.power()?;
                value = (value.checked_rem(divisor)? == 0).then_some(value / divisor)?;
            } else if self.eat("%") {
                value = value.checked_rem_euclid(self.power()?)?;
            } else {
                return Some(value);
            }
        }
    }

    fn power(&mut self) -> Option<i128> {
        let base = self.one()?;
        if !self.eat("**") {
            return Some(base);
        }
        self.descend()?;
        let exponent = self.power()?;
        self.depth -= 1;
        base.checked_pow(u32::try_from(exponent).ok()?)
    }

    fn descend(&mut self) -> Option<()> {
        self.depth += 1;
        (self.depth <= MOST_DEPTH).then_some(())
    }

    fn one(&mut self) -> Option<i128> {
        self.descend()?;
        let value = if self.eat("-") {
            self.power()?.checked_neg()?
        } else if self.eat("+") {
            self.power()?
        } else if self.eat("(") {
            let value = self.sum()?;
            self.eat(")").then_some(value)?
        } else {
            self.word()?
        };
        self.depth -= 1;
        Some(value)
    }

    fn word(&mut self) -> Option<i128> {
        self.rest = self.rest.trim_start();
        let is_part = |letter: char| letter.is_ascii_alphanumeric() || matches!(letter, '_' | '.');
        let end = self.rest.find(|letter| !is_part(letter)).unwrap_or(self.rest.len());
        let (word, rest) = self.rest.split_at(end);
        self.rest = rest;
        if !word.starts_with(|first: char| first.is_ascii_digit()) {
            return match word {
                "true" => Some(1),
                "false" => Some(0),
                _ => (self.named)(word),
            };
        }
        let digits = word.replace('_', "");
        let radix = |prefix: &str, radix| {
            digits.strip_prefix(prefix).and_then(|digits| i128::from_str_radix(digits, radix).ok())
        };
        radix("0x", 16).or_else(|| radix("0b", 2)).or_else(|| radix("0o", 8)).or_else(|| digits.parse().ok())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expressions_have_their_values() {
        let named = |name: &str| (name == "SubjectID.1.0.MAX").then_some(8191);
        for (text, value) in [
            ("300 * 8", Some(2400)),
            ("2 ** 8 - 1", Some(255)),
            ("-2 ** 3 * (1 + 1)", Some(-16)),
            ("1024 * 9 - 20 - 8", Some(9188)),
            ("SubjectID.1.0.MAX + 1", Some(8192)),
            ("0xACCE551B1E", Some(0xAC_CE55_1B1E)),
            ("7 / 2", None),
            ("1 / 0", None),
            ("'/'", Some(47)),
            ("'\\n'", Some(10)),
            ("4.77", None),
            ("true", Some(1)),
            ("2 ** 2000", None),
            ("2 ** -1", None),
            ("OTHER", None),
            ("(1", None),
        ] {
            assert_eq!(evaluate(text, &named), value, "{text}");
        }
        assert_eq!(evaluate(&"(".repeat(100_000), &named), None);
        assert_eq!(evaluate(&"-".repeat(100_000), &named), None);
        assert_eq!(evaluate(&"1**".repeat(100_000), &named), None);
    }
}
