//! Conditions on frames and signals: `Speed > 80 and Gear == Drive`, `id == 0x123 and byte[0] & 0x80`.
//!
//! | Part | Means |
//! |---|---|
//! | `Speed`, `Engine.Speed` | a signal's physical value, the last one received |
//! | `EngineData`, `msg:EngineData` | 1 for a frame of that message; without `msg:`, if no signal has the name |
//! | `Gear == Drive`, `Gear == "Not available"` | a text of the signal's value table |
//! | `id`, `dlc`, `len`, `ch` | the frame's identifier, length code, data bytes, channel (from 1) |
//! | `ext`, `rtr` | 1 for a 29-bit identifier, for a remote frame |
//! | `pgn` | the parameter group of a 29-bit identifier (J1939), without its destination |
//! | `byte[0]` | a data byte, counted from 0 |
//! | `error`, `lost` | 1 for a bus error, for a place where frames are missing |
//! | `uds.sid`, `j1939.pgn` | a value of what several frames say together, where a [`Listener`] puts them together |
//! | `12`, `0x1F`, `0b101`, `1.5e3` | numbers |
//! | `+ - * / % & \|`, `== != < <= > >=`, `not and or`, `( )` | as usual; `&` and `\|` bind tighter than comparisons |
//!
//! Unknown values make a comparison neither true nor false: a signal before its first frame, a byte beyond the
//! data, a division by zero. A condition about signals alone is evaluated when one of them arrives.

mod bind;
mod error;
mod evaluate;
mod expression;
mod listener;
mod syntax;

pub use error::{ConditionError, ConditionFault};
pub use evaluate::Condition;
pub use listener::{ConditionEvent, Listener};
