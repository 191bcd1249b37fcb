//! Frames of SDO and LSS as types, with [`encode`](sdo::SdoRequest::encode) and [`decode`](sdo::SdoRequest::decode) and without state: for
//! those who read a bus, for clients, and for simulated nodes.

pub mod lss;
pub mod sdo;
