//! How much processor time the commands of a step have taken: unlike the time by the clock, it hardly depends on what else the machine does.

use std::time::Duration;

/// What `/proc` counts in, on every Linux that Rust runs on (`USER_HZ`).
const TICKS_PER_SECOND: u32 = 100;

/// Processor time of all commands that this program has waited for so far, and of their children; none where there is no `/proc`.
pub fn of_children() -> Option<Duration> {
    parse(&std::fs::read_to_string("/proc/self/stat").ok()?)
}

/// Fields 16 and 17 of proc_pid_stat(5): `cutime` and `cstime`. The second, a name in brackets, may contain anything.
fn parse(stat: &str) -> Option<Duration> {
    let (_, after_name) = stat.rsplit_once(')')?;
    let mut fields = after_name.split_whitespace().skip(16 - 3);
    let user: u32 = fields.next()?.parse().ok()?;
    let system: u32 = fields.next()?.parse().ok()?;
    Some(Duration::from_secs(1) * (user + system) / TICKS_PER_SECOND)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::{of_children, parse};

    #[test]
    fn a_name_with_brackets_and_spaces_does_not_shift_the_fields() {
        let stat = "26679 (a) b (c) S 1 26679 26679 0 -1 4194560 1 2 3 4 5 6 1250 250 20 0 1 0 99 0 0";
        assert_eq!(parse(stat), Some(Duration::from_secs(15)));
        assert_eq!(parse("26679 (cut"), None);
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn what_a_child_took_is_counted() {
        let before = of_children().unwrap();
        let busy = std::process::Command::new("sh")
            .args(["-c", "i=0; while [ $i -lt 200000 ]; do i=$((i+1)); done"])
            .status()
            .unwrap();
        assert!(busy.success());
        assert!(of_children().unwrap() > before);
    }
}
