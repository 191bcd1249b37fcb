//! What is known of the connections on a bus before anything was heard.

use std::sync::Arc;

use super::connection::MasterSlave;
use crate::Protocol;
use crate::a2l::A2lDescriptions;

/// Whose connections are known without having been heard to begin, and what their addresses mean.
#[derive(Clone, Debug, Default)]
pub struct Known {
    /// Masters and slaves that speak XCP.
    pub xcp: Vec<MasterSlave>,
    /// Masters and slaves that speak CCP.
    pub ccp: Vec<MasterSlave>,
    /// What is at which address.
    pub descriptions: Option<Arc<A2lDescriptions>>,
}

impl Known {
    /// The protocols of which a connection is known, as a set.
    pub(crate) fn protocols(&self) -> u16 {
        let described = |has: fn(&A2lDescriptions) -> bool| self.descriptions.as_deref().is_some_and(has);
        let has_xcp = !self.xcp.is_empty() || described(|all| all.xcp_parties().next().is_some());
        let has_ccp = !self.ccp.is_empty() || described(|all| all.ccp_parties().next().is_some());
        let bit = |has, protocol: Protocol| if has { protocol.bit() } else { 0 };
        bit(has_xcp, Protocol::Xcp) | bit(has_ccp, Protocol::Ccp)
    }
}
