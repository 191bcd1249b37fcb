//! Keys typed at the terminal while a command runs, one at a time and not shown. Ctrl-C stays a signal, and output is as before.

#[cfg(unix)]
pub use self::unix::Keyboard;

/// Not available on this system.
#[cfg(not(unix))]
pub struct Keyboard(std::convert::Infallible);

#[cfg(not(unix))]
impl Keyboard {
    /// There is none.
    pub const fn open() -> Option<Self> {
        None
    }

    /// The next key that was typed.
    pub fn next(&mut self) -> Option<char> {
        match self.0 {}
    }
}

#[cfg(unix)]
mod unix {
    use std::collections::VecDeque;
    use std::io::stdin;
    use std::sync::{Mutex, PoisonError};

    use cantap_work::interrupt;
    use rustix::io::{Errno, read};
    use rustix::process::getpgrp;
    use rustix::termios::{
        LocalModes, OptionalActions, SpecialCodeIndex, Termios, isatty, tcgetattr, tcgetpgrp, tcsetattr,
    };

    /// What begins an arrow or function key, of which nothing is a key for scripts.
    const ESCAPE: u8 = 0x1B;

    /// How the terminal was before.
    static BEFORE: Mutex<Option<Termios>> = Mutex::new(None);

    /// The terminal, until this is dropped.
    pub struct Keyboard {
        typed: VecDeque<char>,
        /// The beginning of a character whose other bytes have not come.
        begun: Vec<u8>,
    }

    impl Keyboard {
        /// Takes keys from standard input, if that is a terminal and this program is in its foreground: one in the background would be
        /// stopped.
        pub fn open() -> Option<Self> {
            let terminal = stdin();
            if !isatty(&terminal) || tcgetpgrp(&terminal).ok()? != getpgrp() {
                return None;
            }
            let before = tcgetattr(&terminal).ok()?;
            let mut single = before.clone();
            single.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
            // A read returns at once, with what there is.
            single.special_codes[SpecialCodeIndex::VMIN] = 0;
            single.special_codes[SpecialCodeIndex::VTIME] = 0;
            *BEFORE.lock().unwrap_or_else(PoisonError::into_inner) = Some(before);
            interrupt::before_the_end(Some(give_back));
            let keyboard = Self { typed: VecDeque::new(), begun: Vec::new() };
            tcsetattr(&terminal, OptionalActions::Now, &single).ok()?;
            Some(keyboard)
        }

        /// The next key that was typed, without waiting.
        pub fn next(&mut self) -> Option<char> {
            if self.typed.is_empty() {
                let mut bytes = [0; 256];
                let count = match read(stdin(), &mut bytes) {
                    Ok(count) => count,
                    Err(Errno::AGAIN | Errno::INTR) => 0,
                    // A terminal that is gone has no more keys.
                    Err(_) => return None,
                };
                self.take(&bytes[..count]);
            }
            self.typed.pop_front()
        }

        fn take(&mut self, bytes: &[u8]) {
            if bytes.first() == Some(&ESCAPE) && bytes.len() > 1 {
                return;
            }
            self.begun.extend_from_slice(bytes);
            let begun = std::mem::take(&mut self.begun);
            for chunk in begun.utf8_chunks() {
                self.typed.extend(chunk.valid().chars());
                // The last one may go on; in the middle it is none.
                self.begun = chunk.invalid().to_vec();
            }
        }
    }

    impl Drop for Keyboard {
        fn drop(&mut self) {
            interrupt::before_the_end(None);
            give_back();
        }
    }

    fn give_back() {
        let before = BEFORE.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(before) = before {
            // If that fails, there is nobody left to report it to.
            let _ = tcsetattr(stdin(), OptionalActions::Now, &before);
        }
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn characters_are_put_together_and_arrow_keys_are_none() {
            let mut keyboard = Keyboard { typed: VecDeque::new(), begun: Vec::new() };
            let typed = |keyboard: &mut Keyboard, bytes: &[u8]| {
                keyboard.take(bytes);
                keyboard.typed.drain(..).collect::<String>()
            };
            assert_eq!(typed(&mut keyboard, b"ab"), "ab");
            assert_eq!(typed(&mut keyboard, &[0xC3]), "");
            assert_eq!(typed(&mut keyboard, &[0xA4, b'c']), "\u{E4}c");
            assert_eq!(typed(&mut keyboard, &[ESCAPE, b'[', b'A']), "");
            assert_eq!(typed(&mut keyboard, &[ESCAPE]), "\x1b");
            assert_eq!(typed(&mut keyboard, &[0xFF, b'd']), "d");
        }
    }
}
