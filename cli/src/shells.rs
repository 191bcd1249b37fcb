//! How shells request completions: they run `cantap` with an environment variable, and the words of the command line after `--`.

use std::ffi::OsString;
use std::io::{self, Write};
use std::path::Path;

use clap_complete::Shell;
use clap_complete::engine::complete;
use clap_complete::env::{Elvish, EnvCompleter, Fish, Powershell, Shells, Zsh};

/// The variable that names the requesting shell.
pub const VARIABLE: &str = "CANTAP_COMPLETE";

/// All supported shells.
pub const ALL: Shells<'static> = Shells(&[&Bash, &Elvish, &Fish, &Powershell, &Zsh]);

/// The script that makes a shell request completions; it runs whichever `cantap` is found.
pub fn script(shell: Shell) -> io::Result<Vec<u8>> {
    let completer = ALL.completer(&shell.to_string());
    let completer =
        completer.ok_or_else(|| io::Error::other(format!("there is no completion for {shell}")))?;
    let mut script = Vec::new();
    completer.write_registration(VARIABLE, "cantap", "cantap", "cantap", &mut script)?;
    Ok(script)
}

/// The words of the command line for which a shell requests completions.
pub fn line() -> Vec<String> {
    let words = std::env::args_os().skip_while(|word| word != "--").skip(1).collect();
    let (words, _) = join(words, 0);
    words.into_iter().filter_map(|word| word.into_string().ok()).collect()
}

/// Bash splits a line at colons and equals signs, and replaces only the last part with what it gets.
struct Bash;

/// Bash's index of the word with the cursor.
const WORD: &str = "_CANTAP_WORD";

/// Whether a part only separates others.
fn separates(word: &OsString) -> bool {
    let bytes = word.as_encoded_bytes();
    !bytes.is_empty() && bytes.iter().all(|byte| matches!(byte, b':' | b'='))
}

/// Joins the parts of words again. For the part with index `at`, returns the index of its word, and the text of that before the
/// part, or before the cursor if the part only separates.
fn join(parts: Vec<OsString>, at: usize) -> (Vec<OsString>, (usize, OsString)) {
    let mut words: Vec<OsString> = Vec::new();
    let mut place = (0, OsString::new());
    let mut goes_on = false;
    for (number, part) in parts.into_iter().enumerate() {
        let is_separator = separates(&part);
        let mut word =
            if goes_on || is_separator { words.pop().unwrap_or_default() } else { OsString::new() };
        if number == at && !is_separator {
            place.1.clone_from(&word);
        }
        word.push(part);
        if number == at && is_separator {
            place.1.clone_from(&word);
        }
        words.push(word);
        if number == at {
            place.0 = words.len() - 1;
        }
        goes_on = is_separator;
    }
    (words, place)
}

impl EnvCompleter for Bash {
    fn name(&self) -> &'static str {
        "bash"
    }

    fn is(&self, name: &str) -> bool {
        name == "bash"
    }

    fn write_registration(
        &self,
        variable: &str,
        name: &str,
        bin: &str,
        completer: &str,
        out: &mut dyn Write,
    ) -> io::Result<()> {
        // Nothing is sorted again, and nothing that may be continued ends in a blank; bash before 4.4 and 4.0 cannot do
        // that.
        write!(
            out,
            r#"_{name}() {{
    local IFS=$'\n'
    COMPREPLY=( $({variable}=bash {WORD}="$COMP_CWORD" {completer} -- "${{COMP_WORDS[@]}}" 2>/dev/null) )
    if [[ "${{COMPREPLY-}}" == *[=/:,] ]]; then
        compopt -o nospace 2>/dev/null
    fi
}}
complete -o bashdefault -o nosort -F _{name} {bin} 2>/dev/null || complete -o bashdefault -F _{name} {bin}
"#
        )
    }

    fn write_complete(
        &self,
        command: &mut clap::Command,
        parts: Vec<OsString>,
        folder: Option<&Path>,
        out: &mut dyn Write,
    ) -> io::Result<()> {
        let at =
            std::env::var(WORD).ok().and_then(|at| at.parse().ok()).unwrap_or(parts.len().saturating_sub(1));
        let (words, (word, before)) = join(parts, at);
        let before = before.to_string_lossy();
        for candidate in complete(command, words, word, folder)? {
            let whole = candidate.get_value().to_string_lossy();
            if let Some(rest) = whole.strip_prefix(&*before) {
                writeln!(out, "{rest}")?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_bash_takes_apart_is_put_together_again() {
        let joined = |parts: &str, at| {
            let (words, (word, before)) = join(parts.split(' ').map(OsString::from).collect(), at);
            let words: Vec<_> = words.into_iter().map(|word| word.into_string().unwrap()).collect();
            (words.join(" "), word, before.into_string().unwrap())
        };
        assert_eq!(joined("cantap capture -d", 2), ("cantap capture -d".into(), 2, String::new()));
        assert_eq!(
            joined("cantap capture -d virtual : c", 5),
            ("cantap capture -d virtual:c".into(), 3, "virtual:".into())
        );
        // The cursor is after the colon, which bash counts as the word.
        assert_eq!(
            joined("cantap capture -d virtual :", 4),
            ("cantap capture -d virtual:".into(), 3, "virtual:".into())
        );
        assert_eq!(
            joined("cantap decode --db = 2 : car.dbc -s Sp", 8),
            ("cantap decode --db=2:car.dbc -s Sp".into(), 4, String::new())
        );
        assert_eq!(joined("cantap decode --db = 2", 4), ("cantap decode --db=2".into(), 2, "--db=".into()));
    }
}
