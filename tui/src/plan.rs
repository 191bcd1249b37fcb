//! Which devices the live view watches, and how it takes part in their buses.

use cantap::Channel;
use cantap::device::channel_number;
use cantap::wire::CHANNELS;
use cantap::wire::message::Mode;
use cantap_address::Address;

use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::requested_rate::RequestedRate;
use cantap_work::timing_options::TimingOptions;

/// Which devices, and how to take part in their buses.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The devices. The second one's channels are 3 and 4, and so on.
    pub addresses: Vec<Address>,
    /// Channels to open, by number.
    pub channels: Vec<u8>,
    /// How to open them, as on the command line; unless it says otherwise, only listening.
    pub open: ChannelOptions,
}

impl Plan {
    /// Only listens to devices, on the channels whose bit rates are known; on all if none is.
    pub fn listening(addresses: Vec<Address>, options: &cantap_analysis::stats::Options) -> Self {
        let mut plan = Self { addresses, channels: Vec::new(), open: ChannelOptions::default() };
        for channel in plan.all_channels() {
            let rate = options.bitrate_of(channel);
            let rates = rate.map(|bitrate_bps| ChannelBitrate { channel: Some(channel), bitrate_bps });
            plan.open.timing.bitrates.extend(rates.map(RequestedRate::from));
        }
        plan.choose_channels();
        plan
    }

    /// The same with other devices. Their buses are different ones, and bit rates given before say nothing about them: what is saved on the
    /// device counts, or what is heard.
    #[must_use]
    pub fn at(&self, addresses: Vec<Address>) -> Self {
        if addresses == self.addresses {
            return self.clone();
        }
        let mut plan = Self { addresses, ..self.clone() };
        plan.open.timing = TimingOptions::default();
        plan.choose_channels();
        plan
    }

    /// The devices' name in messages.
    pub fn name(&self) -> String {
        let names: Vec<String> = self.addresses.iter().map(ToString::to_string).collect();
        names.join(" + ")
    }

    /// The channels to open on a device, counted from 0.
    pub fn channels_of(&self, board: usize) -> impl Iterator<Item = Channel> + use<'_> {
        Channel::ALL
            .into_iter()
            .filter(move |channel| self.channels.contains(&channel_number(board, *channel)))
    }

    /// The numbers of all the devices' channels.
    fn all_channels(&self) -> std::ops::RangeInclusive<u8> {
        1..=(self.addresses.len() * CHANNELS) as u8
    }

    /// How it takes part in the buses.
    pub fn mode(&self) -> Mode {
        self.open.mode.unwrap_or(Mode::ListenOnly)
    }

    /// Sets other bit rates, replacing any earlier timing. If a rate is for one channel, only that channel is opened.
    pub fn set_bit_rates(&mut self, rates: Vec<RequestedRate>) {
        self.open.timing.set_bit_rates(rates);
        self.choose_channels();
    }

    /// Selects the channels that have bit rates; all if there are none.
    pub fn choose_channels(&mut self) {
        let rates = &self.open.timing.bitrates;
        self.channels = self
            .all_channels()
            .filter(|channel| rates.is_empty() || RequestedRate::of(rates, *channel).is_some())
            .collect();
    }

    /// The statistics' options with this plan's bit rates, if it has any.
    pub fn options(&self, others: &cantap_analysis::stats::Options) -> cantap_analysis::stats::Options {
        let known = self.open.timing.known();
        let rates = self.channels.iter().copied().filter_map(|number| {
            let own = ChannelBitrate::of(&known, number);
            Some((number, own.or_else(|| others.bitrate_of(number))?))
        });
        cantap_analysis::stats::Options {
            bitrate_bps: None,
            channel_bitrate_bps: rates.collect(),
            ..others.clone()
        }
    }
}
