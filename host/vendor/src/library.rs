//! Finding and loading a library.

use std::path::Path;

use libloading::Library;

/// Why a library is not there to be used. Each message says what to do next.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LoadError {
    /// There is no such library.
    #[error("{name} cannot be loaded ({reason}); {advice}")]
    NotInstalled {
        /// Its file.
        name: String,
        /// The system's reason.
        reason: String,
        /// Who has it.
        advice: &'static str,
    },
    /// There is a file of that name, which is damaged, or a library for other programs than this: of 32 bits, or for another processor.
    #[error(
        "{name} cannot be loaded ({reason}): it is no library for {}, as this program is; {advice}",
        std::env::consts::ARCH
    )]
    Unfit {
        /// Its file.
        name: String,
        /// The system's reason.
        reason: String,
        /// Who has another.
        advice: &'static str,
    },
    /// It lacks a function.
    #[error("{name} has no function {function}: it is another library, or too old; {advice}")]
    NoFunction {
        /// Its file.
        name: String,
        /// The function.
        function: &'static str,
        /// Who has a newer one.
        advice: &'static str,
    },
    /// The path is relative.
    #[error("the library's path '{0}' must begin with the root, as in /opt/lib/libpcanbasic.so")]
    RelativePath(String),
}

impl LoadError {
    /// Whether there is no file of that name where libraries are: nobody has installed it. What is there and cannot be loaded, for the lack of another
    /// library for example, is something else.
    pub fn is_absent(&self) -> bool {
        let Self::NotInstalled { name, reason, .. } = self else { return false };
        // The loader's words: Windows' number of them, glibc's and musl's, macOS' list of what it has tried.
        let names_it = reason.starts_with(name.as_str())
            || reason.contains(&format!("library {name}:"))
            || reason.contains(&format!("dlopen({name}"));
        reason.contains("(os error 126)")
            || names_it && (reason.contains("No such file") || reason.contains("no such file"))
    }
}

/// The loader's words about a file that is no library for this program: Windows' number of them, glibc's, musl's, macOS'.
const UNFIT: [&str; 7] = [
    "(os error 193)",
    "wrong ELF class",
    "invalid ELF header",
    "file too short",
    "Exec format error",
    "incompatible architecture",
    "not a mach-o file",
];

/// A library that is loaded, and what errors call it.
pub(crate) struct Loaded {
    pub library: Library,
    name: String,
    advice: &'static str,
}

impl Loaded {
    /// Loads the library at a path, or the one that the system has under a name.
    pub fn load(path: Option<&Path>, system_name: &str, advice: &'static str) -> Result<Self, LoadError> {
        let loaded = match path {
            // A relative one would depend on where the program was started.
            Some(path) if !path.is_absolute() => {
                return Err(LoadError::RelativePath(path.display().to_string()));
            }
            Some(path) => load(path.as_os_str()),
            None => from_system(system_name),
        };
        let name = path.map_or_else(|| in_system(system_name), |path| path.display().to_string());
        match loaded {
            Ok(library) => Ok(Self { library, name, advice }),
            Err(error) => {
                let reason = reason(&error);
                let is_unfit = UNFIT.iter().any(|words| reason.contains(words));
                Err(if is_unfit {
                    LoadError::Unfit { name, reason, advice }
                } else {
                    LoadError::NotInstalled { name, reason, advice }
                })
            }
        }
    }

    /// A function of the library, to be called only while the library is loaded.
    ///
    /// # Safety
    ///
    /// `F` is the function's type as the maker's header declares it.
    pub unsafe fn function<F: Copy>(&self, function: &'static str) -> Result<F, LoadError> {
        // SAFETY: the caller knows the type.
        unsafe { self.library.get::<F>(function) }.map(|symbol| *symbol).map_err(|_| LoadError::NoFunction {
            name: self.name.clone(),
            function,
            advice: self.advice,
        })
    }
}

/// The error and its cause, which has the system's words.
fn reason(error: &libloading::Error) -> String {
    std::error::Error::source(error).map_or_else(|| error.to_string(), ToString::to_string)
}

/// A library, with further ones that it needs from beside it and from the system.
#[cfg(windows)]
fn load(path: &std::ffi::OsStr) -> Result<Library, libloading::Error> {
    use libloading::os::windows::{LOAD_LIBRARY_SEARCH_DLL_LOAD_DIR, LOAD_LIBRARY_SEARCH_SYSTEM32};
    with_flags(path, LOAD_LIBRARY_SEARCH_DLL_LOAD_DIR | LOAD_LIBRARY_SEARCH_SYSTEM32)
}

#[cfg(not(windows))]
fn load(name: &std::ffi::OsStr) -> Result<Library, libloading::Error> {
    // SAFETY: what a maker's library does when it is loaded is the maker's; the user has installed it, or named it.
    unsafe { Library::new(name) }
}

/// Not from the folder in which the program was started, where anybody may have put one: only from where installers put it.
#[cfg(windows)]
fn from_system(name: &str) -> Result<Library, libloading::Error> {
    with_flags(name.as_ref(), libloading::os::windows::LOAD_LIBRARY_SEARCH_SYSTEM32)
}

#[cfg(windows)]
fn with_flags(name: &std::ffi::OsStr, flags: u32) -> Result<Library, libloading::Error> {
    use libloading::os::windows::Library as Windows;
    // SAFETY: what a maker's library does when it is loaded is the maker's; the user has installed it, or named it.
    unsafe { Windows::load_with_flags(name, flags) }.map(Library::from)
}

/// From where installers put it. By its name alone, macOS would look in the current folder first (`dlopen(3)`).
#[cfg(target_os = "macos")]
fn from_system(name: &str) -> Result<Library, libloading::Error> {
    load(in_system(name).as_ref())
}

/// From the folders of the system's loader, among which the current one is not.
#[cfg(not(any(windows, target_os = "macos")))]
fn from_system(name: &str) -> Result<Library, libloading::Error> {
    load(name.as_ref())
}

/// What the system's library of a name is asked for as.
fn in_system(name: &str) -> String {
    if cfg!(target_os = "macos") { format!("/usr/local/lib/{name}") } else { name.to_owned() }
}

/// The text in a buffer that a library has filled, up to its first NUL. It is from outside: who shows it cleans it.
pub(crate) fn text(buffer: &[u8]) -> String {
    let end = buffer.iter().position(|byte| *byte == 0).unwrap_or(buffer.len());
    String::from_utf8_lossy(&buffer[..end]).trim().to_owned()
}
