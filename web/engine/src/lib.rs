//! The engine of cantap's page: reads, filters and decodes traces in the reader's own browser.
//!
//! [`Engine::ask`] takes a request and gives its answer, both as [`message`] lays them out; `web/page/src/api.ts` lists the requests. In
//! WebAssembly, the module `abi` has the functions that the page's worker calls. Natively, the same code is tested.
//!
//! It draws nothing, keeps no file, and speaks to no network. Nothing that a stranger's file contains may make it panic: there, a panic is
//! the engine's end.

#![deny(clippy::unwrap_used)]
#![cfg_attr(test, allow(clippy::unwrap_used))]

#[cfg(target_family = "wasm")]
pub mod abi;
mod alarms;
mod board;
mod conversations;
mod databases;
mod dbc_text;
mod descriptions;
mod device_times;
mod engine;
mod error;
mod export;
mod fields;
mod findings;
mod gaps;
mod identifiers;
mod index;
mod interval;
mod load;
pub mod message;
mod own_database;
mod pieces;
mod request;
mod row;
mod series;
mod store;
mod summary;
mod trace;
mod views;

pub use engine::Engine;
pub use error::EngineError;
pub use findings::{Finding, Severity};
