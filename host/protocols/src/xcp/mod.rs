//! XCP on CAN (ASAM MCD-1 XCP 1.5): commands with their responses, events, and measured data by the lists that a master has set up.
//!
//! A master and its slave are found by CONNECT and its response; other pairs must be known ([`crate::calibration::Known`]). A command and
//! its response are one event, as is a block of several frames; a data packet is one by itself.
//!
//! Memory: for each of at most 256 connections, 16 waiting commands of at most 255 elements each, and 65,536 entries of lists.

pub mod codec;
pub(crate) mod daq;
pub(crate) mod signs;
mod slave;
mod state;
#[cfg(test)]
mod tests;

/// Decodes XCP.
pub type Xcp = crate::calibration::Connections<slave::XcpConnection>;
