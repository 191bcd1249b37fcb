//! What to do so that CAN FD frames can be sent.

use cantap_wire::Hello;

/// Why a device sends no CAN FD frames, and what to do about it.
pub fn fd_advice(hello: &Hello) -> String {
    let name = &hello.serial;
    match hello.board.as_str() {
        "socketcan-virtual" => format!(
            "CAN FD is off on {name}; as root: ip link set {name} down && ip link set {name} mtu 72 && ip link set {name} up"
        ),
        board if board.starts_with("socketcan") && board != "socketcand" => format!(
            "CAN FD is off on {name}; as root: ip link set {name} down && ip link set {name} up type can bitrate 500000 dbitrate 2000000 fd on, with the bus's bit rates"
        ),
        board if board.starts_with("gs_usb") => needs_rate("gs_usb:"),
        board @ ("pcan" | "kvaser") => needs_rate(&format!("{board}:")),
        _ if hello.capabilities & cantap_wire::message::capability::ADAPTER != 0 => {
            "this adapter's protocol has none that could be sent; use one with CAN FD (docs/adapters.md)"
                .to_owned()
        }
        _ => "this device is a classical CAN controller; use an adapter with CAN FD (docs/adapters.md)"
            .to_owned(),
    }
}

fn needs_rate(scheme: &str) -> String {
    format!("CAN FD is off without the bus's data bit rate in the address, as in {scheme}?data-bitrate=2M")
}
