//! Digests of a file's blocks, made or compared while it is read.

use std::io::{self, Read};

use sha2::{Digest as _, Sha256};

use super::BLOCK_BYTES;

/// A block's SHA-256: nobody can make another block that has the same.
pub(crate) type Digest = [u8; 32];

fn digest(block: &[u8]) -> Digest {
    Sha256::digest(block).into()
}

/// Why reading ends where the file is not what its index is about.
pub(crate) fn has_changed() -> io::Error {
    io::Error::other("the file has changed since its index was made, which is deleted; read it again")
}

/// The digests of a file's whole blocks, from the first on.
#[derive(Clone, Debug, Default)]
pub(crate) struct Blocks {
    pub digests: Vec<Digest>,
    /// A block was not what it had been.
    pub differs: bool,
}

impl Blocks {
    /// Compares a block that was read, or learns it if it is the next one. The last block of a file may be a part of one, and is neither.
    pub(crate) fn read(&mut self, offset: u64, block: &[u8]) -> io::Result<()> {
        if block.len() < BLOCK_BYTES {
            return Ok(());
        }
        let number = usize::try_from(offset / BLOCK_BYTES as u64).unwrap_or(usize::MAX);
        match self.digests.get(number) {
            Some(known) if *known != digest(block) => {
                self.differs = true;
                Err(has_changed())
            }
            Some(_) => Ok(()),
            None => {
                if number == self.digests.len() {
                    self.digests.push(digest(block));
                }
                Ok(())
            }
        }
    }

    /// How many bytes they are digests of.
    pub(crate) fn bytes(&self) -> u64 {
        self.digests.len() as u64 * BLOCK_BYTES as u64
    }

    /// Forgets those from the first on that is not in `file`.
    pub(crate) fn keep_those_of(&mut self, mut file: impl Read) -> io::Result<()> {
        let mut block = vec![0; BLOCK_BYTES];
        for (number, known) in self.digests.iter().enumerate() {
            let is_there = match file.read_exact(&mut block) {
                Ok(()) => digest(&block) == *known,
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => false,
                Err(error) => return Err(error),
            };
            if !is_there {
                self.digests.truncate(number);
                break;
            }
        }
        Ok(())
    }
}
