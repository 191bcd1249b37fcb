//! Every key has an entry in the help.

use std::collections::BTreeSet;

use super::super::views::help::KEYS;

const SOURCES: [&str; 2] = [include_str!("../app/keys.rs"), include_str!("../app/graph.rs")];

/// The characters handled in the sources: `'x'` in a pattern that begins with `KeyCode::Char(`.
fn letters(source: &str) -> BTreeSet<char> {
    let mut letters = BTreeSet::new();
    for pattern in source.split("KeyCode::Char(").skip(1) {
        let pattern = &pattern[..pattern.find("=>").unwrap_or(pattern.len())];
        let mut rest = pattern;
        while let Some((_, behind)) = rest.split_once('\'') {
            let mut characters = behind.chars();
            letters.extend(characters.next());
            rest = characters.as_str().strip_prefix('\'').unwrap_or_default();
        }
    }
    letters
}

#[test]
fn every_key_that_does_something_is_in_the_help() {
    let letters: BTreeSet<char> = SOURCES.iter().flat_map(|source| letters(source)).collect();
    assert!(letters.len() > 40 && letters.is_superset(&BTreeSet::from(['m', 'A', '{', '#'])), "{letters:?}");
    let told: BTreeSet<&str> = KEYS.iter().flat_map(|(keys, _)| keys.split([' ', ','])).collect();
    // Page numbers are shown as a range, blank by its name, k and j duplicate the arrows, Ctrl-J is Enter.
    let otherwise = ['1', '9', ' ', 'j', 'k', 'z', 'u', 'h', '?', ','];
    let missing: Vec<_> = letters
        .iter()
        .filter(|letter| !otherwise.contains(letter) && !told.contains(letter.to_string().as_str()))
        .collect();
    assert!(missing.is_empty(), "{missing:?} are not in {told:?}");
    // All of it can be read on the smallest usual screen.
    let wide = KEYS.iter().find(|(keys, what)| keys.chars().count() > 16 || what.chars().count() > 60);
    assert_eq!(wide, None);
    for name in ["Space", "Enter", "Esc", "Tab", "Ctrl-C", "Ctrl-Z"] {
        assert!(told.contains(name), "{name}");
    }
}
