//! A program's ELF: what goes into flash, the names of its functions, and the checks that refuse a
//! file that could not run, with a one-line message each.

use object::{Object, ObjectSymbol, SymbolKind};

use crate::memory_map as map;

/// Why a file is not a program that this emulator runs.
#[derive(Debug, thiserror::Error)]
pub enum ElfError {
    /// Not an ELF, or a damaged one.
    #[error("not an ELF file")]
    NotElf,
    /// Not for a 32-bit ARM processor.
    #[error("an ELF for another chip ({machine}); the emulator runs programs for the STM32F405")]
    OtherMachine {
        /// The machine it is for.
        machine: String,
    },
    /// Linked for a chip with another memory map.
    #[error(
        "an ELF for another chip: it loads {len} bytes to {address:#010x}, where an STM32F405 has no \
         flash"
    )]
    OtherMemoryMap {
        /// Where a segment wants to be loaded.
        address: u32,
        /// Its bytes.
        len: usize,
    },
    /// There is no usable vector table at the start of flash.
    #[error("an ELF for another chip: no vector table at {:#010x}", map::FLASH.start)]
    NoVectorTable,
}

/// A program for the emulated chip.
#[derive(Clone, Debug, Default)]
pub struct Image {
    segments: Vec<(u32, Vec<u8>)>,
    /// Functions, by address.
    functions: Vec<Symbol>,
    /// Everything else with a name.
    data: Vec<(String, u32)>,
}

/// A function's name and place.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Symbol {
    address: u32,
    size: u32,
    name: String,
}

impl Image {
    /// Takes any program for this chip from an ELF's bytes.
    pub fn program(elf: &[u8]) -> Result<Self, ElfError> {
        let file = object::File::parse(elf).map_err(|_| ElfError::NotElf)?;
        if file.format() != object::BinaryFormat::Elf {
            return Err(ElfError::NotElf);
        }
        if file.architecture() != object::Architecture::Arm || file.is_64() || !file.is_little_endian() {
            return Err(ElfError::OtherMachine { machine: format!("{:?}", file.architecture()) });
        }
        let mut segments = Vec::new();
        for (address, bytes) in load_segments(elf)? {
            let end = u64::from(address) + bytes.len() as u64;
            if !map::FLASH.contains(&address) || end > map::FLASH.end.into() {
                return Err(ElfError::OtherMemoryMap { address, len: bytes.len() });
            }
            segments.push((address, bytes));
        }
        let data = file
            .symbols()
            .filter(|symbol| symbol.kind() != SymbolKind::Text)
            .filter_map(|symbol| Some((symbol.name().ok()?.to_owned(), symbol.address() as u32)))
            .collect();
        let mut functions: Vec<Symbol> = file
            .symbols()
            .filter(|symbol| symbol.kind() == SymbolKind::Text && symbol.size() > 0)
            .filter_map(|symbol| {
                let name = format!("{:#}", rustc_demangle::demangle(symbol.name().ok()?));
                Some(Symbol { address: symbol.address() as u32 & !1, size: symbol.size() as u32, name })
            })
            .collect();
        functions.sort_by_key(|symbol| symbol.address);
        let image = Self { segments, functions, data };
        image.check_vectors()?;
        Ok(image)
    }

    /// A program given as what flash holds from its start, vector table first; without names.
    pub fn raw(flash: Vec<u8>) -> Self {
        Self { segments: vec![(map::FLASH.start, flash)], ..Self::default() }
    }

    /// What to load, as addresses in flash and bytes.
    pub fn segments(&self) -> impl Iterator<Item = (u32, &[u8])> {
        self.segments.iter().map(|(address, bytes)| (*address, &bytes[..]))
    }

    /// The function at `address` and the distance from its start, if there is a function.
    pub fn function_at(&self, address: u32) -> Option<(&str, u32)> {
        let after = self.functions.partition_point(|symbol| symbol.address <= address);
        let symbol = &self.functions[..after].last()?;
        let offset = address - symbol.address;
        (offset < symbol.size).then_some((&symbol.name[..], offset))
    }

    /// The address of the function called `name` (demangled), if there is one.
    pub fn address_of(&self, name: &str) -> Option<u32> {
        self.functions.iter().find(|symbol| symbol.name == name).map(|symbol| symbol.address)
    }

    /// `name+0x12`, or the bare address if there is no name.
    pub fn describe(&self, address: u32) -> String {
        match self.function_at(address) {
            Some((name, 0)) => name.to_owned(),
            Some((name, offset)) => format!("{name}+{offset:#x}"),
            None => format!("{address:#010x}"),
        }
    }

    /// The address of the datum called `name`, if there is one.
    pub fn datum(&self, name: &str) -> Option<u32> {
        self.data.iter().find(|(datum, _)| datum == name).map(|(_, address)| *address)
    }

    /// What is in flash from `address` on.
    pub fn bytes_at(&self, address: u32) -> Option<&[u8]> {
        self.segments.iter().find_map(|(base, bytes)| {
            // The address just past a segment is not in it, and may be the next one's first.
            bytes.get(address.checked_sub(*base)? as usize..).filter(|bytes| !bytes.is_empty())
        })
    }

    fn word_at(&self, address: u32) -> Option<u32> {
        Some(u32::from_le_bytes(self.bytes_at(address)?.get(..4)?.try_into().ok()?))
    }

    fn check_vectors(&self) -> Result<(), ElfError> {
        let stack = self.word_at(map::FLASH.start).ok_or(ElfError::NoVectorTable)?;
        let reset = self.word_at(map::FLASH.start + 4).ok_or(ElfError::NoVectorTable)?;
        // An initial stack pointer may lie just past its memory's end.
        let in_ram = [map::SRAM, map::CCM].iter().any(|ram| ram.start < stack && stack <= ram.end);
        if in_ram && reset & 1 == 1 && map::FLASH.contains(&reset) {
            Ok(())
        } else {
            Err(ElfError::NoVectorTable)
        }
    }
}

/// The segments with their load addresses: initialised data is loaded into flash, although it lives
/// in RAM.
fn load_segments(elf: &[u8]) -> Result<Vec<(u32, Vec<u8>)>, ElfError> {
    use object::elf::{FileHeader32, PT_LOAD};
    use object::read::elf::{FileHeader, ProgramHeader};
    let header = FileHeader32::<object::Endianness>::parse(elf).map_err(|_| ElfError::NotElf)?;
    let endian = header.endian().map_err(|_| ElfError::NotElf)?;
    let mut segments = Vec::new();
    for program in header.program_headers(endian, elf).map_err(|_| ElfError::NotElf)? {
        if program.p_type(endian) == PT_LOAD && program.p_filesz(endian) > 0 {
            let bytes = program.data(endian, elf).map_err(|()| ElfError::NotElf)?;
            segments.push((program.p_paddr(endian), bytes.to_vec()));
        }
    }
    Ok(segments)
}
