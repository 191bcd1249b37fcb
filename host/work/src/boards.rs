//! Which boards to use: those given, otherwise the one that is connected.

use cantap::device::channel_number;
use cantap::{Channel, DeviceError};
use cantap_address::{Address, AddressError};
use cantap_trace::filter::Filter;

use crate::channels::{Channels, NoSuchChannel, place_of};

/// Channels are numbered up to 32.
const MOST: usize = 16;

/// Why there is no board to use, or none can be chosen.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BoardsError {
    /// No address was given, and there is no board.
    #[error("no board is connected; plug one in, or use -d virtual, which needs none")]
    NoneConnected,
    /// No address was given, and there are several boards.
    #[error("{} boards are connected; choose with -d: {}", ports.len(), ports.join(", "))]
    SeveralConnected {
        /// The ports at which they are.
        ports: Vec<String>,
    },
    /// More than can be used at once.
    #[error("{count} boards are too many; give at most {MOST}")]
    TooMany {
        /// How many were given.
        count: usize,
    },
    /// The same address twice.
    #[error("-d {address} is given twice; a board can be used once")]
    GivenTwice {
        /// The address.
        address: Address,
    },
    /// A channel that they do not have.
    #[error(transparent)]
    Channel(#[from] NoSuchChannel),
    /// A connected board's port is not an address.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// The ports cannot be listed.
    #[error(transparent)]
    Device(#[from] DeviceError),
}

impl BoardsError {
    /// Whether other arguments would help, as opposed to a fault of the system.
    pub const fn is_usage(&self) -> bool {
        !matches!(self, Self::Address(_) | Self::Device(_))
    }
}

/// The board that is connected, if there is exactly one.
pub fn the_one_connected() -> Result<Address, BoardsError> {
    let ports: Vec<String> = cantap::device::list()?.into_iter().map(|board| board.port).collect();
    choose(&ports)
}

fn choose(ports: &[String]) -> Result<Address, BoardsError> {
    match ports {
        [port] => Ok(port.parse()?),
        [] => Err(BoardsError::NoneConnected),
        ports => Err(BoardsError::SeveralConnected { ports: ports.to_vec() }),
    }
}

/// The boards of a command, and which of their channels it uses. Channels are numbered consecutively: 1 and 2 are the first
/// board's, 3 and 4 the second one's.
#[derive(Clone, Debug)]
pub struct Boards {
    addresses: Vec<Address>,
    channels: Channels,
}

impl Boards {
    /// The given boards, otherwise the one that is connected.
    pub fn new(given: &[Address], channels: &Channels) -> Result<Self, BoardsError> {
        let addresses = if given.is_empty() { vec![the_one_connected()?] } else { given.to_vec() };
        if addresses.len() > MOST {
            return Err(BoardsError::TooMany { count: addresses.len() });
        }
        for (number, address) in addresses.iter().enumerate() {
            if address.may_come_back() && addresses[..number].contains(address) {
                return Err(BoardsError::GivenTwice { address: address.clone() });
            }
        }
        channels.check(addresses.len())?;
        Ok(Self { addresses, channels: channels.clone() })
    }

    /// Their addresses.
    pub fn addresses(&self) -> &[Address] {
        &self.addresses
    }

    /// The used channels of a board, counted from 0.
    pub fn channels_of(&self, board: usize) -> impl Iterator<Item = Channel> + use<'_> {
        Channel::ALL.into_iter().filter(move |channel| self.channels.has(channel_number(board, *channel)))
    }

    /// The numbers of all used channels.
    pub fn channel_numbers(&self) -> impl Iterator<Item = u8> + use<'_> {
        (0..self.addresses.len())
            .flat_map(|board| self.channels_of(board).map(move |channel| channel_number(board, channel)))
    }
}

/// Filters for a board: its channels have their own numbers there, and other boards' channels get numbers
/// that it does not have.
pub fn filters_on(board: usize, filters: &[Filter]) -> Vec<Filter> {
    let own = |number: u8| match place_of(number) {
        (place, channel) if place == board && number > 0 => channel.number(),
        _ => u8::MAX,
    };
    filters.iter().map(|filter| Filter { channel: filter.channel.map(own), ..filter.clone() }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_connected_board_is_taken_and_several_are_listed() {
        let chosen =
            |ports: &[&str]| choose(&ports.iter().map(|port| (*port).to_owned()).collect::<Vec<_>>());
        assert_eq!(chosen(&["/dev/ttyACM3"]).unwrap().to_string(), "/dev/ttyACM3");
        assert!(chosen(&[]).unwrap_err().to_string().contains("-d virtual"));
        let several = chosen(&["COM3", "COM5"]).unwrap_err().to_string();
        assert_eq!(several, "2 boards are connected; choose with -d: COM3, COM5");
    }

    #[test]
    fn channels_are_numbered_on_over_the_boards() {
        let address = |text: &str| text.parse::<Address>().unwrap();
        let boards = |numbers: &[u8]| {
            Boards::new(&[address("virtual"), address("virtual")], &Channels::of_numbers(numbers.to_vec()))
        };
        let numbers = |numbers| boards(numbers).unwrap().channel_numbers().collect::<Vec<_>>();
        assert_eq!(numbers(&[]), [1, 2, 3, 4]);
        assert_eq!(numbers(&[2, 3]), [2, 3]);
        let second: Vec<Channel> = boards(&[2, 3]).unwrap().channels_of(1).collect();
        assert_eq!(second, [Channel::Can1]);
        assert!(boards(&[5]).unwrap_err().to_string().contains("channels 1 to 4"));
        let twice = Boards::new(&[address("/dev/x"), address("/dev/x")], &Channels::all());
        assert!(twice.unwrap_err().to_string().contains("given twice"));
    }

    #[test]
    fn a_filter_of_one_boards_channel_lets_nothing_of_another_pass() {
        let filters = ["can2,123:7FF".parse::<Filter>().unwrap(), "456:7FF".parse().unwrap()];
        let channels =
            |board| filters_on(board, &filters).iter().map(|filter| filter.channel).collect::<Vec<_>>();
        assert_eq!(channels(1), [Some(1), None]);
        assert_eq!(channels(0), [Some(u8::MAX), None]);
    }
}
