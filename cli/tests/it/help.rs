//! `cantap help`: groups, commands, topics.

use std::process::{Command, Output};

fn cantap(arguments: &str) -> (Option<i32>, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments.split_whitespace()).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn the_commands_are_in_groups_with_the_most_used_first() {
    let (code, whole, err) = cantap("--help");
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert_eq!(cantap("help").1, whole);
    let at = |text: &str| whole.find(text).unwrap_or_else(|| panic!("{text} is not in {whole}"));
    let order = [
        "Usage: cantap",
        "\n  monitor ",
        "\n  capture ",
        "\n  decode ",
        "\n  send ",
        "\n  list ",
        "\n  serve ",
        "Topics",
        "Options:",
        "Exit codes:",
    ];
    assert!(order.windows(2).all(|pair| at(pair[0]) < at(pair[1])), "{whole}");
    assert!(whole.lines().all(|line| line.chars().count() <= 100), "{whole}");
}

#[test]
fn help_explains_a_command_a_command_of_a_command_and_topics() {
    for (line, parts) in [
        ("help capture", &["Usage: cantap capture", "Examples:"][..]),
        ("help canopen read", &["Usage: cantap canopen read"]),
        ("help wiring", &["CAN_H pin 6, CAN_L pin 14", "60 ohms"]),
        ("help filters", &["pgn:61444", "C0 is 0C0"]),
        ("help conditions", &["Speed > 80 and Gear == Drive"]),
        ("help times", &["1m30s", "2:250k"]),
    ] {
        let (code, out, err) = cantap(line);
        assert_eq!((code, err.as_str()), (Some(0), ""), "{line}");
        assert!(parts.iter().all(|part| out.contains(part)), "{line}: {out}");
    }
    let (code, out, err) = cantap("help captures");
    assert!(code == Some(2) && out.is_empty() && err.contains("`cantap help` lists both"), "{err}");
    // What means nothing is not there.
    for command in ["diff", "plot", "db"] {
        assert!(!cantap(&format!("{command} --help")).1.contains("--follow"), "{command}");
    }
    assert!(cantap("decode --help").1.contains("--follow"));
}
