//! The page that `cantap report` writes is carried by the program if `CANTAP_BUILT_PAGE` names it, compressed by gzip: `cargo xtask dist`
//! sets it.

use std::path::PathBuf;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=CANTAP_BUILT_PAGE");
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo sets it")).join("page.html.gz");
    match std::env::var_os("CANTAP_BUILT_PAGE") {
        Some(page) => {
            println!("cargo:rerun-if-changed={}", PathBuf::from(&page).display());
            std::fs::copy(page, out).expect("CANTAP_BUILT_PAGE names a file");
        }
        None => std::fs::write(out, []).expect("OUT_DIR can be written"),
    }
}
