//! What the `cantap` command does with buses and traces, without its arguments and its output, for other programs.
//!
//! | Modules | Subject |
//! |---|---|
//! | [`boards`], [`channels`], [`channel_bitrate`] | which devices, and which of their channels |
//! | [`requested_rate`], [`bit_rate_search`], [`remembered_rates`] | the bit rate that is asked for, or found by listening |
//! | [`channel_options`], [`timing_options`], [`bus_off`] | how channels are opened, and brought back from bus-off |
//! | [`live`], [`reception`] | records of devices that may come and go; a channel that receives only errors |
//! | [`doctor`], [`bus_hints`], `port_access` (Linux) | what is the matter with a port, a device or a bus, and what to do next |
//! | [`selftest`] | what a board can show on its own |
//! | [`sending`], [`speaking`], [`uds`], [`uds_memory`], [`calibration`], [`odx`], [`a2l`], [`eds`], [`dsdl`], [`bus_description`] | frames and their fate; a protocol's client on a device; descriptions of ECUs and buses |
//! | [`drive`] | a drive's motion, and how it is left |
//! | [`obd`] | a vehicle's parameters: who has which, asked again and again, as a table |
//! | [`changing`], [`disturbance`] | messages whose values change with time; error frames on purpose |
//! | [`gateway`] | the rules of a gateway, and what they do to a trace |
//! | [`read_ahead`], [`missing`], [`databases`], [`reading`] | traces, what is missing from them, and what they mean |
//! | [`recording`] | a trace that grows, or waits for a condition |
//! | [`report`], [`advice`], [`announcement`], [`terms`], [`code_texts`], [`cut`] | messages for people |
//! | [`atomic_file`], [`memory_image`], [`interrupt`], [`dfu`] | files, Ctrl-C, and the chip's bootloader |

#![forbid(unsafe_code)]

#[cfg(feature = "buses")]
pub mod a2l;
#[cfg(feature = "buses")]
pub mod advice;
#[cfg(feature = "buses")]
pub mod announcement;
pub mod atomic_file;
#[cfg(feature = "buses")]
pub mod bit_rate_search;
#[cfg(feature = "buses")]
pub mod boards;
#[cfg(feature = "buses")]
pub mod bus_description;
#[cfg(feature = "buses")]
pub mod bus_hints;
#[cfg(feature = "buses")]
pub mod bus_off;
#[cfg(feature = "buses")]
pub mod cache;
#[cfg(feature = "buses")]
pub mod calibration;
#[cfg(feature = "buses")]
pub mod changing;
#[cfg(feature = "buses")]
pub mod channel_bitrate;
#[cfg(feature = "buses")]
pub mod channel_options;
#[cfg(feature = "buses")]
pub mod channels;
#[cfg(feature = "buses")]
pub mod code_texts;
#[cfg(feature = "buses")]
pub mod cut;
#[cfg(feature = "buses")]
pub mod databases;
#[cfg(feature = "dfu")]
pub mod dfu;
#[cfg(feature = "buses")]
pub mod disturbance;
#[cfg(feature = "buses")]
pub mod doctor;
#[cfg(feature = "buses")]
pub mod drive;
#[cfg(feature = "buses")]
pub mod dsdl;
#[cfg(feature = "buses")]
pub mod eds;
#[cfg(feature = "buses")]
pub mod gateway;
pub mod interrupt;
#[cfg(feature = "buses")]
pub mod live;
pub mod locale;
mod losses;
#[cfg(feature = "buses")]
pub mod memory_image;
mod meter;
#[cfg(feature = "buses")]
pub mod missing;
#[cfg(feature = "buses")]
pub mod node_text;
#[cfg(feature = "buses")]
pub mod obd;
#[cfg(feature = "buses")]
pub mod odx;
#[cfg(target_os = "linux")]
pub mod port_access;
#[cfg(feature = "buses")]
pub mod read_ahead;
#[cfg(feature = "buses")]
pub mod reading;
#[cfg(feature = "buses")]
pub mod reception;
#[cfg(feature = "buses")]
pub mod recording;
#[cfg(feature = "buses")]
pub mod remembered_rates;
#[cfg(feature = "buses")]
pub mod report;
#[cfg(feature = "buses")]
pub mod requested_rate;
#[cfg(feature = "buses")]
pub mod selftest;
#[cfg(feature = "buses")]
pub mod sending;
#[cfg(feature = "buses")]
pub mod speaking;
#[cfg(feature = "buses")]
pub mod terms;
#[cfg(feature = "buses")]
pub mod timing_options;
#[cfg(feature = "buses")]
pub mod uds;
#[cfg(feature = "buses")]
pub mod uds_memory;

pub use cantap_trace::grammar::{duration, positive_duration};
pub use losses::{Losses, lost_frames};
pub use meter::{Meter, rounded};
