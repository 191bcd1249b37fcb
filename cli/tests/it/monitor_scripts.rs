//! Scripts in the live view: started, stopped and edited, with what they say. In a real terminal.
#![cfg(unix)]

use crate::port::Port;
use crate::terminal::Terminal;

use std::path::Path;

const SIZE: (u16, u16) = (110, 30);

fn write(folder: &Path, name: &str, source: &str) -> String {
    let path = folder.join(name);
    std::fs::write(&path, source).unwrap();
    path.display().to_string()
}

/// The view of a device in normal mode, with scripts in the list; the last one is selected.
fn view(device: &str, scripts: &[&str], environment: &[(&str, Option<&str>)]) -> Terminal {
    let mut view = Terminal::start_with(
        &format!("monitor -d {device} -b 500k --normal --view scripts"),
        SIZE,
        environment,
    );
    view.wait_for("running");
    for script in scripts {
        view.keys(&format!("a{script}\r"));
        // The name's last characters, since the column is narrow.
        view.wait_until("the prompt to go", |screen| !screen.contains("add a script"));
    }
    view
}

#[test]
fn a_script_starts_only_when_the_view_takes_part_and_its_verdicts_are_shown() {
    let folder = tempfile::tempdir().unwrap();
    let tester = write(
        folder.path(),
        "t.rhai",
        "fn test_vin() {\n log(\"asking\");\n check(request(\"7E0\", \"7E8\", [0x22, 0xF1, 0x90]).len() == 20, \"17 characters\");\n}\n\
         fn test_wrong() { wait(\"500ms\"); check(1 == 2, \"one is two\"); }\n",
    );
    let recording = folder.path().join("a.log");
    let line = format!("monitor -d virtual:car -b 500k --view scripts -o {}", recording.display());
    let mut view = Terminal::start(&line, SIZE);
    view.wait_for("Listen-only: nothing is sent, so no script is started");
    view.keys(&format!("a{tester}\r"));
    view.wait_for("off");
    view.keys(" ");
    view.wait_for("press m to take part in the bus");
    view.keys("xmy");
    view.wait_for("Normal mode: what scripts send goes onto the bus");
    view.keys(" ");
    let is_said =
        |screen: &str| screen.contains(": ended") && screen.contains("ended                   1      1");
    let text = view.wait_until("its end", is_said);
    assert!(text.contains("FAILED test_wrong") && text.contains("not so: one is two"), "{text}");
    // Below the frames before the failure, of which request and answer are five.
    assert!(text.lines().filter(|line| line.contains(") can")).count() >= 5, "{text}");
    view.keys("\x1b[H");
    let text = view.wait_for("asking");
    assert!(text.contains(": ok test_vin") && text.contains("newer lines below"), "{text}");
    view.keys("q");
    assert_eq!(view.end(), 0);
    // What the script has sent was recorded like everything else.
    assert!(std::fs::read_to_string(&recording).unwrap().contains(" 7E0#"));
}

#[test]
fn an_endless_loop_and_a_wrong_signal_are_said_so_while_the_view_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let endless = write(
        folder.path(),
        "endless.rhai",
        "log(\"begun\"); wait(\"1ms\"); log(\"on\"); wait(\"1ms\"); loop {}",
    );
    let wrong = write(folder.path(), "wrong.rhai", "send(\"Engine\", #{ Sped: 1 });");
    let mut view = view("virtual:load=20", &[&endless, &wrong], &[]);
    view.keys(" ");
    view.wait_for("ERROR: ");
    let text = view.text();
    assert!(text.contains("no database") || text.contains("Engine"), "{text}");
    // The first one: it runs, the view is there, and it ends by its key.
    view.keys("\x1b[A");
    view.keys(" ");
    view.wait_for(": on");
    view.keys("2");
    view.wait_for("Period ms");
    view.keys("9 ");
    view.wait_for("stopped");
    view.keys(" ");
    // Left alone, it is ended with a reason.
    view.wait_for("computed for too long");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_script_is_edited_in_the_users_editor_and_begins_anew() {
    let folder = tempfile::tempdir().unwrap();
    let script = write(folder.path(), "s.rhai", "log(\"first\"); every(\"20ms\", || send(\"100#\"));");
    let editor = write(
        folder.path(),
        "editor",
        "#!/bin/sh\nprintf 'EDITING %s' \"$2\"; read answer\nsed -i 's/first/second/' \"$2\"\n",
    );
    let with = format!("sh {editor} --option");
    let mut view = view("virtual:load=20", &[&script], &[("EDITOR", Some(&with)), ("VISUAL", None)]);
    view.keys(" ");
    view.wait_for(": first");
    view.keys("e");
    view.wait_for("EDITING ");
    assert!(view.is_as_a_shell_wants_it());
    view.keys("yes\r");
    view.wait_for(": second");
    assert!(view.text().contains("RUNNING"), "{}", view.text());
    // An error in the text ends it, with its place.
    std::fs::write(&script, "let a = ;").unwrap();
    view.keys("e");
    view.wait_for("EDITING ");
    view.keys("yes\r");
    view.wait_for("line 1");
    view.wait_for("ERROR: ");
    view.keys("q");
    assert_eq!(view.end(), 0);
    view.check_given_back();
}

#[test]
fn an_editor_that_is_not_there_is_named_and_ctrl_c_in_one_ends_only_that() {
    let folder = tempfile::tempdir().unwrap();
    let script = write(folder.path(), "s.rhai", "log(\"first\");");
    let mut view = view("virtual:load=20", &[&script], &[("VISUAL", Some("no-such-editor-here"))]);
    view.keys("e");
    view.wait_for("the editor 'no-such-editor-here' ended with");
    view.keys("q");
    assert_eq!(view.end(), 0);
    let editor = "echo EDITING; sleep 1000; :";
    let mut view = self::view("virtual:load=20", &[&script], &[("VISUAL", Some(editor))]);
    view.keys("e");
    view.wait_until("the editor", |screen| screen.contains("EDITING") && !screen.contains("9▸Scripts"));
    view.keys("\x03");
    view.wait_for("ended with");
    view.keys("2");
    view.keys("2");
    view.wait_for("Period ms");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_device_that_vanishes_ends_its_scripts_and_nothing_is_sent_when_it_is_back() {
    let folder = tempfile::tempdir().unwrap();
    let script = write(folder.path(), "s.rhai", "periodic(\"123#11\", \"20ms\"); wait(\"1h\");");
    let mut port = Port::new();
    port.plug("load=0,serial=ONE");
    let mut view = view(port.name(), &[&script], &[]);
    view.keys(" ");
    view.wait_for("RUNNING");
    view.keys("2");
    view.wait_for("123");
    view.keys("9");
    port.unplug();
    view.wait_for("ERROR: ");
    view.wait_for("GONE, trying again");
    port.plug("load=0,serial=ONE");
    view.wait_for("is back after");
    view.keys("5");
    let has_sent =
        |screen: &str| screen.lines().any(|line| line.starts_with("Bus 1 ") && !line.contains("sent 0,"));
    let text = view.wait_until("the device's figures", |screen| screen.contains("Bus 1     active"));
    assert!(!has_sent(&text), "{text}");
    // It starts again by its key.
    view.keys("9 ");
    view.wait_for("RUNNING");
    view.keys("5");
    view.wait_until("frames sent", has_sent);
    view.keys("q");
    assert_eq!(view.end(), 0);
}
