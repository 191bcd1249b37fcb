//! What nodes are called.

use std::path::Path;

/// What the name of a ready node begins with.
pub const PREFIX: &str = "node:";

/// A node's name without folder and suffix, or without [`PREFIX`].
pub fn short(name: &str) -> &str {
    let ready = name.strip_prefix(PREFIX);
    ready.or_else(|| Path::new(name).file_stem().and_then(|stem| stem.to_str())).unwrap_or(name)
}
