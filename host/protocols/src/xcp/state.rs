//! What a master has told its slave, as far as it was heard and agreed to.

use cantap_trace::Id;

use super::codec::command;
use super::daq::PacketLayout;
use crate::calibration::lists::{ListEntry, Lists};
use crate::calibration::parts::ByteOrder;

/// The state of a connection.
#[derive(Clone, Debug)]
pub struct State {
    /// By CONNECT's response.
    pub order: Option<ByteOrder>,
    /// Bytes of an address unit.
    pub granularity: usize,
    /// Commands may be sent before the last one is answered.
    pub is_interleaved: bool,
    /// The memory transfer address: extension and address.
    pub mta: Option<(u8, u32)>,
    /// The memory transfer address is that of a text which the slave has been asked for.
    pub is_text: bool,
    /// What is measured.
    pub lists: Lists,
    /// How data packets are made.
    pub layout: PacketLayout,
    /// An identifier of its own that data packets of this slave were given.
    pub daq_id: Option<Id>,
}

impl Default for State {
    fn default() -> Self {
        Self {
            order: None,
            granularity: 1,
            is_interleaved: false,
            mta: None,
            is_text: false,
            lists: Lists::default(),
            layout: PacketLayout::default(),
            daq_id: None,
        }
    }
}

impl State {
    /// Extension and address in a command, from this place on.
    pub fn address_in(&self, command: &[u8], at: usize) -> Option<(u8, u32)> {
        let (&extension, address) = command.get(at..at + 5)?.split_first()?;
        Some((extension, self.order?.number(address) as u32))
    }

    fn number_in(&self, command: &[u8], at: usize) -> Option<u16> {
        Some(self.order?.number(command.get(at..at + 2)?) as u16)
    }

    fn entry_of(&self, bit: u8, size: u8, extension: u8, address: &[u8]) -> Option<ListEntry> {
        Some(ListEntry {
            extension,
            address: self.order?.number(address) as u32,
            size: usize::from(size) * self.granularity,
            bit: (bit < 0x20).then_some(bit),
        })
    }

    /// The entries of WRITE_DAQ_MULTIPLE.
    pub fn entries_of<'a>(&'a self, command: &'a [u8]) -> impl Iterator<Item = ListEntry> + 'a {
        let count = usize::from(command.get(1).copied().unwrap_or_default());
        let all = command.get(2..).unwrap_or_default().chunks(8).take(count);
        all.filter_map(|bytes| match *bytes {
            [bit, size, a, b, c, d, extension, ..] => self.entry_of(bit, size, extension, &[a, b, c, d]),
            [bit, size, a, b, c, d] => self.entry_of(bit, size, 0, &[a, b, c, d]),
            _ => None,
        })
    }

    /// What a command has changed, now that the slave has agreed.
    pub fn apply(&mut self, command: &[u8], response: &[u8]) {
        match command[0] {
            command::SET_MTA | command::CONNECT | command::SHORT_UPLOAD | command::SHORT_DOWNLOAD => {
                self.is_text = false;
            }
            command::GET_ID | command::GET_DAQ_EVENT_INFO => self.is_text = true,
            _ => {}
        }
        let number = |at| self.number_in(command, at);
        let byte = |at: usize| command.get(at).copied();
        match command[0] {
            command::CONNECT => {
                if let &[_, _, mode, ..] = response {
                    self.order = Some(if mode & 1 == 0 { ByteOrder::Little } else { ByteOrder::Big });
                    self.granularity = 1 << (mode >> 1 & 3).min(2);
                    self.mta = None;
                }
            }
            command::DISCONNECT => {
                self.lists.clear();
                self.mta = None;
            }
            command::GET_COMM_MODE_INFO => {
                self.is_interleaved = response.get(2).is_some_and(|mode| mode & 2 != 0);
            }
            command::SET_MTA => self.mta = self.address_in(command, 3),
            command::SHORT_UPLOAD | command::SHORT_DOWNLOAD => {
                self.mta = self.address_in(command, 3);
                self.advance(byte(1));
            }
            command::UPLOAD | command::DOWNLOAD | command::PROGRAM => self.advance(byte(1)),
            // The slave sets it in ways that are not seen here.
            command::GET_ID
            | command::GET_DAQ_EVENT_INFO
            | command::DOWNLOAD_MAX
            | command::PROGRAM_MAX
            | command::BUILD_CHECKSUM => {
                self.mta = None;
            }
            command::FREE_DAQ => self.lists.clear(),
            command::CLEAR_DAQ_LIST => {
                if let Some(daq) = number(2) {
                    self.lists.clear_list(daq);
                }
            }
            command::ALLOC_ODT => {
                if let (Some(daq), Some(count)) = (number(2), byte(4)) {
                    self.lists.allocate_packets(daq, count);
                }
            }
            command::ALLOC_ODT_ENTRY => {
                if let (Some(daq), Some(odt), Some(count)) = (number(2), byte(4), byte(5)) {
                    self.lists.allocate_entries(daq, odt, count);
                }
            }
            command::SET_DAQ_PTR => {
                if let (Some(daq), Some(odt), Some(entry)) = (number(2), byte(4), byte(5)) {
                    self.lists.point_to(daq, odt, entry);
                }
            }
            command::WRITE_DAQ => {
                if let &[_, bit, size, extension, a, b, c, d, ..] = command
                    && let Some(entry) = self.entry_of(bit, size, extension, &[a, b, c, d])
                {
                    self.lists.write(entry);
                }
            }
            command::WRITE_DAQ_MULTIPLE => {
                let entries: Vec<_> = self.entries_of(command).collect();
                for entry in entries {
                    self.lists.write(entry);
                }
            }
            command::SET_DAQ_LIST_MODE => {
                let event = number(4);
                if let Some(list) = number(2).and_then(|daq| self.lists.list(daq)) {
                    (list.mode, list.event) = (byte(1), event);
                }
            }
            command::START_STOP_DAQ_LIST => {
                if let Some(list) = number(2).and_then(|daq| self.lists.list(daq)) {
                    list.first_pid = response.get(1).copied();
                    match byte(1) {
                        Some(0) => list.is_running = false,
                        Some(1) => list.is_running = true,
                        _ => list.is_selected = true,
                    }
                }
            }
            command::START_STOP_SYNCH => {
                for (_, list) in self.lists.all() {
                    match byte(1) {
                        Some(0) => list.is_running = false,
                        Some(1) => list.is_running |= list.is_selected,
                        Some(2) => list.is_running &= !list.is_selected,
                        _ => continue,
                    }
                    list.is_selected = false;
                }
            }
            command::GET_DAQ_PROCESSOR_INFO => self.layout.take_processor_info(&response[1..]),
            command::GET_DAQ_RESOLUTION_INFO => {
                if let Some(order) = self.order {
                    self.layout.take_resolution_info(&response[1..], order);
                }
            }
            // GET_DAQ_ID and SET_DAQ_ID of the transport layer on CAN: an identifier for a list of its own.
            0xF2 => {
                let id = match byte(1) {
                    Some(0xFE) => response.get(4..8),
                    Some(0xFD) => command.get(4..8),
                    _ => None,
                };
                if let (Some(bytes), Some(order)) = (id, self.order) {
                    let raw = order.number(bytes) as u32;
                    let is_extended = raw >> 31 != 0;
                    self.daq_id = Some(if is_extended {
                        Id::extended_truncated(raw)
                    } else {
                        Id::standard_truncated(raw)
                    });
                }
            }
            _ => {}
        }
    }

    const fn advance(&mut self, count: Option<u8>) {
        if let (Some((extension, address)), Some(count)) = (self.mta, count) {
            self.mta = Some((extension, address.wrapping_add(count as u32)));
        }
    }
}
