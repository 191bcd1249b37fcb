//! The firmware that the tests run: what `cargo xtask firmware` built.
#![allow(dead_code, reason = "each test file uses its part")]

use std::path::{Path, PathBuf};

use cantap_emu::elf::Image;
use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound;
use cantap_sim::board;
use cantap_sim::firmware;

/// The default board's firmware.
pub fn firmware() -> Image {
    open(&elf())
}

/// A board's name, its crystal's frequency in Hz, and where each channel's TX is: port (0 is A) and pin.
pub type BoardFacts = (&'static str, u64, [(usize, u32); 2]);

const BOARDS: [BoardFacts; 3] = [
    ("olimex-p405", 8_000_000, [(1, 9), (1, 6)]),
    ("feather-f405", 12_000_000, [(1, 9), (1, 13)]),
    ("stm32f4-discovery", 8_000_000, [(3, 1), (1, 13)]),
];

/// The boards whose firmware was built for this run: those that `CANTAP_BOARDS` names, by default only the first. `cargo xtask ci` names all.
pub fn boards() -> Vec<BoardFacts> {
    let Ok(names) = std::env::var("CANTAP_BOARDS") else {
        eprintln!("SKIPPED: all boards but {}: CANTAP_BOARDS does not name them", BOARDS[0].0);
        return BOARDS[..1].to_vec();
    };
    let facts =
        |name| *BOARDS.iter().find(|(known, ..)| *known == name).unwrap_or_else(|| panic!("no board {name}"));
    names.split_whitespace().map(facts).collect()
}

/// A board's firmware, which is next to the default board's.
pub fn board(name: &str) -> Image {
    open(&elf().with_file_name(format!("cantap-{name}.elf")))
}

fn open(path: &Path) -> Image {
    firmware::open(path).unwrap_or_else(|error| {
        panic!("{}: {error}; build it with `cargo xtask firmware --all`", path.display())
    })
}

/// The ELF's path: `CANTAP_FIRMWARE_ELF`. Every test that uses it is marked as ignored; `cargo xtask test` includes them when there
/// is an ELF.
pub fn elf() -> PathBuf {
    let path = std::env::var_os("CANTAP_FIRMWARE_ELF");
    path.expect("CANTAP_FIRMWARE_ELF is not set; build the firmware with `cargo xtask firmware`").into()
}

/// How long memories and buses keep the core waiting in a test that does not choose: `CANTAP_TIMING` (`best` or `worst`), by
/// default the best.
pub fn bound() -> Bound {
    std::env::var("CANTAP_TIMING").map_or(Bound::Best, |text| {
        text.parse().unwrap_or_else(|reason| panic!("CANTAP_TIMING={text}: {reason}"))
    })
}

/// The default board under [`bound`].
pub fn setup() -> Setup {
    Setup { bound: bound(), ..board::setup() }
}
