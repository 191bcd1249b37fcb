//! Every integration test of this crate, in one program: each program is linked on its own.

mod a2l_agrees_with_pya2l;
mod anything_is_taken;
mod cdd_agrees_with_cantools;
mod odx_agrees_with_odxtools;
mod protocols_agree_with_peers;
mod protocols_agree_with_tshark;
mod protocols_page;
mod test_buses;
mod uavcan_agrees_with_peers;
mod uds_contents_agree_with_py_uds;
