//! Tests that run the firmware's ELF are compiled as ignored if there is none: a test that checks nothing must not report
//! "ok".

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=CANTAP_FIRMWARE_ELF");
    println!("cargo:rustc-check-cfg=cfg(cantap_elf)");
    if std::env::var_os("CANTAP_FIRMWARE_ELF").is_some() {
        println!("cargo:rustc-cfg=cantap_elf");
    }
}
