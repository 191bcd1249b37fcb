//! The values that shells offer: requested as each of them does, and in the shells themselves if they are installed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("completion").join(test);
    fs::create_dir_all(directory.join("sub")).unwrap();
    let database = "BO_ 256 Engine: 4 A\n SG_ Speed : 0|8@1+ (0.5,0) [0|0] \"km/h\" A\n SG_ Gear : 8|2@1+ (1,0) [0|0] \"\" A\n\
                    BO_ 257 Body: 4 A\n SG_ Door : 0|1@1+ (1,0) [0|0] \"\" A\nVAL_ 256 Gear 1 \"First\" 2 \"Second\" ;\n";
    fs::write(directory.join("car.dbc"), database).unwrap();
    fs::write(directory.join("trace.log"), "").unwrap();
    directory
}

const SHELLS: [&str; 5] = ["bash", "elvish", "fish", "powershell", "zsh"];

/// What a shell gets for a line whose last word is unfinished. Descriptions are left out.
fn offered(shell: &str, words: &[&str]) -> Vec<String> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let at = words.len().to_string();
    command.env("CANTAP_COMPLETE", shell).env("_CANTAP_WORD", &at).env("_CLAP_COMPLETE_INDEX", &at);
    command.env("_CLAP_IFS", "\n").args(["--", "cantap"]).args(words).current_dir(directory("asked"));
    let output = command.output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{shell} {words:?}: {}", String::from_utf8_lossy(&output.stderr));
    let value = |line: &str| match shell {
        "zsh" => line.replace("\\:", "\u{1}").split(':').next().unwrap_or_default().replace('\u{1}', ":"),
        _ => line.split('\t').next().unwrap_or_default().to_owned(),
    };
    text.lines().map(value).collect()
}

#[test]
fn devices_channels_databases_messages_and_signals_are_offered_to_every_shell() {
    let car = ["decode", "--db", "car.dbc", "trace.log"];
    let with = |line: &[&'static str], more: &[&'static str]| [line, more].concat();
    for (words, expected) in [
        (vec!["capture", "-d", "virt"], &["virtual", "virtual:car"][..]),
        (vec!["info", "--device", "virtual:"], &["virtual:car"]),
        (vec!["capture", "-d", "virtual", "-c", ""], &["1", "2", "both"]),
        (vec!["capture", "-d", "virtual", "-d", "virtual", "-c", ""], &["1", "2", "3", "4", "both"]),
        (vec!["capture", "-d", "virtual", "-b", "5"], &["500k", "50k"]),
        (vec!["autobaud", "-c", ""], &["1", "2"]),
        (vec!["decode", "--db", "c"], &["car.dbc"]),
        (vec!["decode", "--db", "2:c"], &["2:car.dbc"]),
        (with(&car, &["--signal", "S"]), &["Speed"]),
        (with(&car, &["-s", ""]), &["Speed", "Gear", "Door"]),
        (with(&car, &["-s", "Engine."]), &["Engine.Speed", "Engine.Gear"]),
        (vec!["decode", "--db=car.dbc", "-s", "Do"], &["Door"]),
        (vec!["decode", "--db", "2:car.dbc", "-s", "Do"], &["Door"]),
        (vec!["decode", "--db", "nothing.dbc", "-s", ""], &[]),
        (vec!["decode", "-d", "virtual:car", "-s", "CurrentG"], &["CurrentGear"]),
        (vec!["search", "trace.log", "--db", "car.dbc", "-e", "Speed > 80 and Ge"], &["Speed > 80 and Gear"]),
        (vec!["search", "trace.log", "--db", "car.dbc", "--id", "10"], &["100", "101"]),
        (vec!["db", "car.dbc", "--message", ""], &["Engine", "Body"]),
        (vec!["send", "--db", "car.dbc", "1", "En"], &["Engine:"]),
        (vec!["send", "--db", "car.dbc", "1", "Engine:S"], &["Engine:Speed="]),
        (vec!["send", "--db", "car.dbc", "1", "Engine:Speed=5,"], &["Engine:Speed=5,Gear="]),
        (vec!["send", "--db", "car.dbc", "1", "Engine:Gear="], &["Engine:Gear=First", "Engine:Gear=Second"]),
        (vec!["convert", "trace.log", "x", "--format", "cand"], &["candump"]),
        (vec!["convert", "trace.log", "x", "--from", "candump"], &["candump", "candump-screen"]),
        (vec!["capture", "--trig"], &["--trigger"]),
        (vec!["captu"], &["capture"]),
    ] {
        for shell in SHELLS {
            let mut found = offered(shell, &words);
            // Connected boards come first.
            found.retain(|value| !value.starts_with("/dev/") && !value.starts_with("COM"));
            if words.last().is_some_and(|word| word.is_empty()) {
                // Options may follow too.
                found.retain(|value| !value.starts_with('-'));
            }
            let mut expected: Vec<_> = expected.iter().map(|value| (*value).to_owned()).collect();
            found.sort();
            expected.sort();
            assert_eq!(found, expected, "{shell}: {words:?}");
        }
    }
}

/// The shell itself, with the script printed by `cantap completions`; `None` if it is not installed.
fn in_shell(shell: &str, script: &str) -> Option<Vec<String>> {
    let path = Path::new(env!("CARGO_BIN_EXE_cantap")).parent().unwrap().to_owned();
    let others = std::env::var_os("PATH").unwrap_or_default();
    let paths = std::env::join_paths(std::iter::once(path).chain(std::env::split_paths(&others))).unwrap();
    let mut command = Command::new(shell);
    command.args(["-c", script]).env("PATH", paths).current_dir(directory("in_shell")).stdin(Stdio::null());
    let Ok(output) = command.output() else {
        eprintln!("skipped: {shell} is not there");
        return None;
    };
    assert!(output.stderr.is_empty(), "{shell}: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    Some(text.lines().map(|line| line.split('\t').next().unwrap_or_default().to_owned()).collect())
}

/// Bash splits lines at colons and equals signs, and replaces only the last part.
#[test]
fn bash_completes_behind_colons_and_equals_signs() {
    let complete = |words: &str, at: usize| {
        let script = format!(
            "source <(cantap completions bash); COMP_WORDS=({words}); COMP_CWORD={at}; compopt() {{ :; }}; _cantap; \
             printf '%s\\n' \"${{COMPREPLY[@]}}\""
        );
        in_shell("bash", &script)
    };
    for (words, at, expected) in [
        ("cantap capture -d virtual : c", 5, &["car"][..]),
        ("cantap capture -d virtual :", 4, &["car"]),
        ("cantap decode --db = c", 4, &["car.dbc"]),
        ("cantap decode --db = 2 : c", 6, &["car.dbc"]),
        ("cantap send --db car.dbc 1 Engine : Gear = F", 9, &["First"]),
        ("cantap decode --db car.dbc trace.log -s Sp", 6, &["Speed"]),
        ("cantap ali", 1, &["align"]),
    ] {
        let Some(found) = complete(words, at) else { return };
        assert_eq!(found, expected, "{words}");
    }
}

#[test]
fn fish_elvish_and_zsh_take_their_scripts() {
    let fish = "cantap completions fish | source; complete -C 'cantap decode --db car.dbc trace.log -s Sp'; \
                complete -C 'cantap capture -d virtual:'";
    if let Some(found) = in_shell("fish", fish) {
        assert_eq!(found, ["Speed", "virtual:car"]);
    }
    // Elvish has its line editor's names only in interactive mode: what is registered there gets another name
    // here.
    let elvish = "use str; eval (str:replace 'set edit:completion:arg-completer[cantap] =' 'var asked~ =' (cantap completions elvish | \
                  slurp))\"\nasked cantap decode --db car.dbc trace.log -s Sp\nasked cantap capture -d virtual:\"";
    if let Some(found) = in_shell("elvish", elvish) {
        assert_eq!(found, ["Speed", "virtual:car"]);
    }
    // Zsh completes only in its line editor: without a terminal, all that can be checked is that the script is valid and
    // registers.
    let zsh =
        "autoload -Uz compinit; compinit -D -u; source <(cantap completions zsh); print ${_comps[cantap]}";
    if let Some(found) = in_shell("zsh", zsh) {
        assert_eq!(found, ["_clap_dynamic_completer_cantap"]);
    }
}

/// A user who has another program's variable set is not affected.
#[test]
fn without_a_shell_that_asks_the_command_runs() {
    let run = |variable: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
        command
            .args(["bits", "123#"])
            .env("COMPLETE", "bash")
            .env("CANTAP_COMPLETE", variable)
            .output()
            .unwrap()
    };
    assert!(String::from_utf8(run("").stdout).unwrap().starts_with("frame       123#"));
    let unknown = run("tcsh");
    assert!(!unknown.status.success());
    assert!(
        String::from_utf8(unknown.stderr).unwrap().contains("unknown shell `tcsh`"),
        "{:?}",
        unknown.stdout
    );
}
