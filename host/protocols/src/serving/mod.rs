//! Nodes that answer: servers for ISO-TP, CANopen's SDO and DeviceNet's explicit messages, a J1939 node, an LSS slave, and slaves of XCP and
//! CCP.
//!
//! Each but the last three is a [`Machine`](crate::active::Machine), like the clients, and never done. What is to be answered is taken from it, and the answer given
//! back whenever there is one.

pub mod canopen;
pub mod ccp;
pub mod devicenet;
pub mod iso_tp;
pub mod j1939;
pub mod lss;
pub mod xcp;

use std::collections::VecDeque;

/// How many requests may wait for their answers; more are left out, as by a node that is busy.
const MOST_WAITING: usize = 16;

/// Appends, unless too many wait already.
fn push_bounded<T>(queue: &mut VecDeque<T>, value: T) {
    if queue.len() < MOST_WAITING {
        queue.push_back(value);
    }
}
