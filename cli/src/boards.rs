//! Which boards a command uses: those given, otherwise the one that is connected.

use cantap::Channel;
use cantap::device::channel_number;
use cantap::wire::CHANNELS;
use cantap_address::{Address, OpenDevice};
use cantap_trace::filter::Filter;

use crate::args::Channels;
use crate::completion;
use crate::wrong::wrong;

/// No command supports more boards than this: channels are numbered up to 32.
const MOST: usize = 16;

/// The device of a command that uses a single one; commands flatten this into their arguments.
#[derive(clap::Args, Clone, Debug)]
pub struct OneBoard {
    /// Where the device is: a serial port, or virtual. Without it, the board that is connected, if there is one.
    #[arg(short, long, add = completion::devices())]
    device: Option<Address>,
}

impl OneBoard {
    /// Its address.
    pub fn address(&self) -> anyhow::Result<Address> {
        self.device.clone().map_or_else(the_one_connected, Ok)
    }

    /// Its address, if given.
    pub const fn given(&self) -> Option<&Address> {
        self.device.as_ref()
    }

    /// Begins a session with it.
    pub fn open(&self) -> anyhow::Result<OpenDevice> {
        Ok(self.address()?.open()?)
    }
}

/// The board that is connected, if there is exactly one.
pub fn the_one_connected() -> anyhow::Result<Address> {
    let ports: Vec<String> = cantap::device::list()?.into_iter().map(|board| board.port).collect();
    choose(&ports)
}

fn choose(ports: &[String]) -> anyhow::Result<Address> {
    match ports {
        [port] => Ok(port.parse()?),
        [] => Err(wrong("no board is connected; plug one in, or use -d virtual, which needs none")),
        ports => {
            Err(wrong(format!("{} boards are connected; choose with -d: {}", ports.len(), ports.join(", "))))
        }
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
    pub fn new(given: &[Address], channels: &Channels) -> anyhow::Result<Self> {
        let addresses = if given.is_empty() { vec![the_one_connected()?] } else { given.to_vec() };
        if addresses.len() > MOST {
            return Err(wrong(format!("{} boards are too many; give at most {MOST}", addresses.len())));
        }
        for (number, address) in addresses.iter().enumerate() {
            if address.may_come_back() && addresses[..number].contains(address) {
                return Err(wrong(format!("-d {address} is given twice; a board can be used once")));
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

/// The board, from 0, and its channel for a number, from 1.
pub fn place_of(number: u8) -> (usize, Channel) {
    let index = usize::from(number.saturating_sub(1));
    (index / CHANNELS, Channel::ALL[index % CHANNELS])
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
    use crate::args;

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
        let boards =
            |text| Boards::new(&[address("virtual"), address("virtual")], &args::channels(text).unwrap());
        let numbers = |text| boards(text).unwrap().channel_numbers().collect::<Vec<_>>();
        assert_eq!(numbers("both"), [1, 2, 3, 4]);
        assert_eq!(numbers("2,3"), [2, 3]);
        let second: Vec<Channel> = boards("2,3").unwrap().channels_of(1).collect();
        assert_eq!(second, [Channel::Can1]);
        assert!(boards("5").unwrap_err().to_string().contains("channels 1 to 4"));
        let twice = Boards::new(&[address("/dev/x"), address("/dev/x")], &args::channels("both").unwrap());
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
