//! Completes what is typed for the send list: messages, their signals, texts of values.

use cantap_signals::Decoder;

/// The result of completing.
#[derive(Debug, PartialEq, Eq)]
pub struct Completed {
    /// The text, as far as it is unambiguous.
    pub text: String,
    /// The possible continuations, if there are several.
    pub choices: Vec<String>,
}

/// Completes `[CHANNEL:]Message:Signal=value,…` at its end.
pub fn complete(text: &str, decoder: &Decoder) -> Completed {
    let (start, rest) = match text.split_once(':') {
        Some((number, rest)) if !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit()) => {
            (&text[..=number.len()], rest)
        }
        _ => ("", text),
    };
    let Some((name, signals)) = rest.split_once(':') else {
        let names = decoder.messages().map(|(_, _, message)| message.name.as_str());
        return best(start, rest, names, ":");
    };
    let Some((_, _, message)) = decoder.messages().find(|(_, _, message)| message.name == name) else {
        return Completed { text: text.to_owned(), choices: Vec::new() };
    };
    let (given, last) = signals.rsplit_once(',').map_or(("", signals), |(given, last)| (given, last));
    let before = &text[..text.len() - last.len()];
    match last.split_once('=') {
        None => {
            let is_given = |name: &str| given.split(',').any(|part| part.split('=').next() == Some(name));
            let names = message.signals.iter().map(|signal| signal.name.as_str());
            best(before, last, names.filter(|name| !is_given(name)), "=")
        }
        Some((signal, value)) => {
            let before = &text[..text.len() - value.len()];
            let table = message.signal(signal).map(|signal| &signal.values);
            best(before, value, table.into_iter().flat_map(|table| table.iter().map(|(_, text)| text)), "")
        }
    }
}

/// The names that begin with what was typed, ignoring case.
fn best<'a>(before: &str, typed: &str, names: impl Iterator<Item = &'a str>, behind: &str) -> Completed {
    let small = typed.to_lowercase();
    let mut fitting: Vec<&str> = names.filter(|name| name.to_lowercase().starts_with(&small)).collect();
    fitting.sort_unstable();
    fitting.dedup();
    match fitting[..] {
        [] => Completed { text: format!("{before}{typed}"), choices: Vec::new() },
        [only] => Completed { text: format!("{before}{only}{behind}"), choices: Vec::new() },
        [first, ..] => {
            let is_common = |len: &usize| {
                let start = first.get(..*len);
                start.is_some() && fitting.iter().all(|name| name.get(..*len) == start)
            };
            let common = (0..=first.len()).rev().find(is_common).unwrap_or(0);
            // Names that differ only in case have less in common than was typed.
            let text = if common < typed.len() { typed } else { &first[..common] };
            Completed {
                text: format!("{before}{text}"),
                choices: fitting.iter().map(|name| (*name).to_owned()).collect(),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_signals_and_values_are_completed() {
        let decoder = Decoder::new(vec![cantap_signals::Source {
            channel: None,
            database: cantap_virtual::car::database().unwrap(),
        }]);
        let messages: Vec<_> = decoder.messages().map(|(_, _, message)| message).collect();
        let message = messages.iter().find(|message| message.signals.len() > 2).unwrap();
        let (name, signal) = (&message.name, &message.signals[0].name);
        let whole = complete(&name.to_lowercase(), &decoder);
        assert!(whole.text.starts_with(name.as_str()), "{whole:?}");
        assert_eq!(complete(&format!("2:{name}"), &decoder).text[..2], *"2:");
        let done = complete(&format!("{name}:{signal}"), &decoder);
        assert!(done.text.starts_with(&format!("{name}:{signal}")), "{done:?}");
        // What was given is not offered again.
        let rest = complete(&format!("{name}:{signal}=1,"), &decoder);
        assert!(!rest.choices.contains(signal) && !rest.choices.is_empty(), "{rest:?}");
        assert_eq!(complete("NoSuch:Thing", &decoder).choices, Vec::<String>::new());
        assert_eq!(complete("123#11", &decoder).text, "123#11");
        let all = complete("", &decoder);
        assert!(all.text.is_empty() && all.choices.len() > 10);
    }
}
