//! A simulated bus and the controllers on it.

use cantap_virtual::simbus::{Node as BusNode, SimBus};

use crate::attached::Attached;

/// A bus with the scripts' controllers on it, and the caller's own, which sees everything.
pub struct Wire {
    pub bus: SimBus,
    pub nodes: Vec<Attached>,
    pub own: Attached,
}

impl Wire {
    /// Does something with the bus and all controllers on it.
    pub fn with<R>(&mut self, act: impl FnOnce(&mut SimBus, &mut [&mut dyn BusNode]) -> R) -> R {
        let Self { bus, nodes, own } = self;
        let mut all: Vec<&mut dyn BusNode> = nodes.iter_mut().map(|node| node as &mut dyn BusNode).collect();
        all.push(own);
        act(bus, &mut all)
    }

    /// When one of the controllers leaves bus-off.
    pub fn recovers_at_ns(&mut self, now_ns: u64) -> Option<u64> {
        let all = self.nodes.iter_mut().chain([&mut self.own]);
        all.filter_map(|node| node.recovers_at_ns(now_ns)).min()
    }
}
