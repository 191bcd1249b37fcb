//! The engine as the page has it: requests and answers over real bytes.

mod bad_input;
mod board;
mod live;
mod page;
mod protocols;
mod views;
