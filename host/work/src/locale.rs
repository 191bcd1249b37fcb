//! The locale of the terminal, judging by the environment.

/// Whether the terminal shows more than ASCII, judging by its environment.
pub fn is_utf8_locale() -> bool {
    if cfg!(windows) {
        return true;
    }
    // The first that is set and not empty decides (POSIX.1-2017, 8.2).
    let set = ["LC_ALL", "LC_CTYPE", "LANG"].into_iter().filter_map(|name| std::env::var(name).ok());
    let locale = set.into_iter().find(|value| !value.is_empty()).unwrap_or_default().to_ascii_lowercase();
    locale.contains("utf-8") || locale.contains("utf8")
}
