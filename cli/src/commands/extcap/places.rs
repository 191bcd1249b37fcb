//! The interfaces shown by Wireshark: one for each connected board, the virtual device, and one for any address.

use cantap::device::Board;

use cantap_address::Address;

/// An interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// A connected board, and its distinguishing name.
    Board(Board, String),
    /// The virtual device.
    Virtual,
    /// An address given by the user: a server, a port, a virtual device with options.
    Address,
}

/// All interfaces at this moment. Nothing is opened.
pub fn all() -> Vec<Place> {
    let boards = cantap::device::list().unwrap_or_else(|error| {
        eprintln!("cantap: {error}");
        Vec::new()
    });
    of_boards(&boards)
}

fn of_boards(boards: &[Board]) -> Vec<Place> {
    let serials: Vec<_> = boards.iter().map(|board| board.serial_number.clone()).collect();
    let name = |board: &Board| {
        let serial = board.serial_number.as_deref().filter(|serial| {
            !serial.is_empty()
                && serials.iter().filter(|other| other.as_deref() == Some(*serial)).count() == 1
        });
        let port = || board.port.rsplit(['/', '\\']).next().unwrap_or_default();
        let plain = |char: char| if char.is_ascii_alphanumeric() { char } else { '-' };
        format!("cantap-{}", serial.unwrap_or_else(port).chars().map(plain).collect::<String>())
    };
    let places = boards.iter().map(|board| Place::Board(board.clone(), name(board)));
    places.chain([Place::Virtual, Place::Address]).collect()
}

/// The one with this name.
pub fn find(name: &str) -> anyhow::Result<Place> {
    all().into_iter().find(|place| place.name() == name).ok_or_else(|| {
        anyhow::anyhow!(
            "'{name}' is not connected; plug it in and let Wireshark look for interfaces again (F5), or see `tshark -D`"
        )
    })
}

impl Place {
    /// Its name in Wireshark. A board keeps its name wherever it is plugged in, and Wireshark its settings.
    pub fn name(&self) -> &str {
        match self {
            Self::Board(_, name) => name,
            Self::Virtual => "cantap-virtual",
            Self::Address => "cantap-address",
        }
    }

    /// The name shown to users.
    pub fn shown(&self) -> String {
        match self {
            Self::Board(board, _) => {
                let product = board.product.as_deref().unwrap_or("cantap");
                format!("{product}, CAN analyser at {}", board.port)
            }
            Self::Virtual => "cantap, a CAN analyser without a board".to_owned(),
            Self::Address => "cantap, a shared or remote CAN analyser".to_owned(),
        }
    }

    /// Its address; `given` is the one from the user.
    pub fn address(&self, given: Option<&Address>) -> anyhow::Result<Address> {
        match (self, given) {
            (_, Some(given)) => Ok(given.clone()),
            (Self::Board(board, _), None) => Ok(board.port.parse()?),
            (Self::Virtual, None) => Ok(Address::of_virtual_device()),
            (Self::Address, None) => {
                anyhow::bail!(
                    "where is the device? Name it in the interface's options, as unix: or tcp://HOST"
                )
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_board_is_called_by_its_serial_number_unless_two_have_it() {
        let board = |port: &str, serial: Option<&str>| Board {
            port: port.to_owned(),
            serial_number: serial.map(str::to_owned),
            product: None,
        };
        let names = |boards: &[Board]| {
            of_boards(boards).iter().map(|place| place.name().to_owned()).collect::<Vec<_>>()
        };
        assert_eq!(
            names(&[board("/dev/ttyACM0", Some("3A/1}")), board("COM7", None)]),
            ["cantap-3A-1-", "cantap-COM7", "cantap-virtual", "cantap-address"]
        );
        let same = names(&[board("/dev/ttyACM0", Some("1")), board("/dev/ttyACM1", Some("1"))]);
        assert_eq!(same[..2], ["cantap-ttyACM0", "cantap-ttyACM1"]);
    }
}
