//! CCP 2.1: commands with their answers, events, and measured data by the lists that a master has set up.
//!
//! A master and its slave are found by CONNECT and its answer, if the next command is answered as well; other pairs must be known
//! ([`crate::calibration::Known`]). A command and its answer are one event; a data packet is one by itself.
//!
//! Memory: for each of at most 256 connections, a waiting command, and 65,536 entries of lists.

pub mod codec;
pub(crate) mod signs;
mod slave;
#[cfg(test)]
mod tests;

/// Decodes CCP.
pub type Ccp = crate::calibration::Connections<slave::CcpConnection>;
