//! Checks of the sources and the pages that need parsers: if this program was built without them, it runs itself again
//! with them.

use anyhow::Result;

/// Files that import each other in a circle, and public types of one name.
pub fn circles() -> Result<()> {
    #[cfg(feature = "check")]
    return crate::circles::check();
    #[cfg(not(feature = "check"))]
    again("circles")
}

/// Broken links.
pub fn links() -> Result<()> {
    #[cfg(feature = "check")]
    return crate::links::check();
    #[cfg(not(feature = "check"))]
    again("links")
}

/// The public face of each published library against its file.
pub fn public_api() -> Result<()> {
    #[cfg(feature = "check")]
    return crate::public_api::check();
    #[cfg(not(feature = "check"))]
    again("public-api")
}

#[cfg(not(feature = "check"))]
fn again(task: &str) -> Result<()> {
    let shell = crate::workspace::shell()?;
    Ok(xshell::cmd!(shell, "cargo run --locked --quiet -p xtask --features check -- {task}").quiet().run()?)
}
