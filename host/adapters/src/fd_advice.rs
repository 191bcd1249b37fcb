//! What to do so that CAN FD frames can be sent.

use cantap_wire::Hello;

/// Why a device sends no CAN FD frames, and what to do about it.
pub fn fd_advice(hello: &Hello) -> String {
    advice(&hello.board, &hello.serial, hello.capabilities)
}

fn advice(board: &str, serial: &str, capabilities: u32) -> String {
    // Users type what stands here as root, and a server may lie.
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "_-.".contains(letter);
    let is_name = (1..16).contains(&serial.len()) && serial.chars().all(is_plain);
    let name = if is_name { serial } else { "INTERFACE" };
    match board {
        "socketcan-virtual" => format!(
            "CAN FD is off on {name}; as root: ip link set {name} down && ip link set {name} mtu 72 && ip link set {name} up"
        ),
        board if board.starts_with("socketcan") && board != "socketcand" => format!(
            "CAN FD is off on {name}; as root: ip link set {name} down && ip link set {name} up type can bitrate 500000 dbitrate 2000000 fd on, with the bus's bit rates"
        ),
        board if board.starts_with("gs_usb") => needs_rate("gs_usb:"),
        board @ ("pcan" | "kvaser") => needs_rate(&format!("{board}:")),
        "gvret" | "gvret-fd" => {
            "GVRET's adapters do not agree on a command for CAN FD frames, and one of them would take it for others; use an adapter with CAN FD (docs/adapters.md)"
                .to_owned()
        }
        _ if capabilities & cantap_wire::message::capability::ADAPTER != 0 => {
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

#[cfg(test)]
mod tests {
    use super::advice;

    #[test]
    fn what_is_to_be_typed_as_root_has_nothing_of_a_server_that_lies() {
        assert!(advice("socketcan-virtual", "vcan0", 0).contains("ip link set vcan0 down"));
        for lie in ["can0;reboot", "$(reboot)", "can0 up", ""] {
            let advice = advice("socketcan-virtual", lie, 0);
            assert!(advice.contains("ip link set INTERFACE down") && !advice.contains("reboot"), "{advice}");
        }
    }
}
