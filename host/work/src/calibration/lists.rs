//! Lists of values that the ECU sends by itself.

use anyhow::{Context as _, bail, ensure};
use cantap_protocols::calibration::ByteOrder;
use cantap_protocols::ccp::codec as ccp;
use cantap_protocols::xcp::codec::command;

use super::{MOST_FRAME, Master, refusal};

/// How many lists of a slave are looked at.
const MOST_CCP_LISTS: u8 = 32;
/// The same of XCP's, where they are ready.
const MOST_READY_LISTS: u16 = 64;
/// Bits of what a list of XCP is like, and of its mode.
const LIST_PREDEFINED: u8 = 0x01;
const LIST_EVENT_FIXED: u8 = 0x02;
const LIST_DAQ: u8 = 0x04;
const LIST_STIM: u8 = 0x08;
const LIST_RUNS: u8 = 0x40;
/// CCP's session status: the lists are set up.
const CCP_LISTS_READY: u8 = 0x02;

/// Something to measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sampled {
    /// The address extension.
    pub extension: u8,
    /// The address.
    pub address: u32,
    /// Bytes.
    pub size: usize,
}

/// A list that runs.
#[derive(Clone, Debug)]
pub struct RunningList {
    /// Its number.
    pub daq: u16,
    /// What each of its packets contains, by the place among what was to be measured.
    pub packets: Vec<Vec<usize>>,
}

impl Master<'_> {
    /// Sets up a list of these values, a new one or one that the slave has ready, and starts it.
    ///
    /// # Errors
    ///
    /// The slave does not answer or refuses, has no list with room for them, or a value is longer than a packet.
    pub fn start_list(&mut self, values: &[Sampled], event: u16) -> anyhow::Result<RunningList> {
        if self.is_ccp() {
            return self.start_ccp_list(values, event);
        }
        let state = self.state()?;
        let info = self.ask(vec![command::GET_DAQ_PROCESSOR_INFO], 0, true)?;
        let &[properties, first, second, third, fourth, predefined, key, ..] = &info[..] else {
            bail!("the ECU's answer about its lists has {} bytes; it has to have 7", info.len());
        };
        ensure!(key >> 6 == 0, "the ECU identifies its packets in a way that is not supported; use poll");
        let events = state.order.number(&[third, fourth]);
        ensure!(
            u64::from(event) < events || events == 0,
            "the ECU has the events 0 to {}",
            events.max(1) - 1
        );
        let has_stamps = properties & 0x10 != 0;
        let room = state.max_dto.min(MOST_FRAME) - 1;
        let mut limits = Limits { stamp: 0, room, largest: room, entries: usize::MAX };
        if let Ok(resolution) = self.ask_whether(vec![command::GET_DAQ_RESOLUTION_INFO], 0, true)? {
            let step = resolution.first().map_or(1, |step| usize::from(*step).max(1));
            if let Some(value) = values.iter().find(|value| !value.size.is_multiple_of(step)) {
                bail!(
                    "{:08X} has {} bytes, and the ECU measures multiples of {step}; poll it",
                    value.address,
                    value.size
                );
            }
            limits.largest = resolution.get(1).map_or(room, |size| usize::from(*size).min(room)).max(1);
            let mode = resolution.get(4).copied().unwrap_or_default();
            limits.stamp = if has_stamps { usize::from(mode & 7) } else { 0 };
        }
        let (daq, packets) = if properties & 1 == 0 {
            let lists = state.order.number(&[first, second]) as u16;
            self.ready_list(values, event, lists, limits)?
        } else {
            self.made_list(values, predefined, limits)?
        };
        let list = self.number(daq.into(), 2);
        for (odt, entries) in packets.iter().enumerate() {
            self.ask([&[command::SET_DAQ_PTR, 0][..], &list, &[odt as u8, 0]].concat(), 0, true)?;
            for Sampled { extension, address, size } in entries.iter().map(|place| values[*place]) {
                let address = self.number(address.into(), 4);
                let size = (size / state.unit) as u8;
                let command = [&[command::WRITE_DAQ, 0xFF, size, extension][..], &address].concat();
                self.ask(command, 0, false)?;
            }
        }
        let mode = if limits.stamp > 0 { 0x10 } else { 0 };
        let event = self.number(event.into(), 2);
        self.ask([&[command::SET_DAQ_LIST_MODE, mode][..], &list, &event, &[1, 0]].concat(), 0, true)?;
        self.ask([&[command::START_STOP_DAQ_LIST, 2][..], &list].concat(), 0, true)?;
        self.ask(vec![command::START_STOP_SYNCH, 1], 0, true)?;
        Ok(RunningList { daq, packets })
    }

    /// Makes a list behind those that are ready.
    fn made_list(
        &mut self,
        values: &[Sampled],
        predefined: u8,
        limits: Limits,
    ) -> anyhow::Result<(u16, Vec<Vec<usize>>)> {
        let packets = packets(values, limits)?;
        let daq = u16::from(predefined);
        let list = self.number(daq.into(), 2);
        self.ask(vec![command::FREE_DAQ], 0, true)?;
        self.ask([&[command::ALLOC_DAQ, 0][..], &self.number(1, 2)].concat(), 0, false)?;
        let count = u8::try_from(packets.len()).context("more than 255 packets")?;
        self.ask([&[command::ALLOC_ODT, 0][..], &list, &[count]].concat(), 0, false)?;
        for (odt, entries) in packets.iter().enumerate() {
            let numbers = [odt as u8, entries.len() as u8];
            self.ask([&[command::ALLOC_ODT_ENTRY, 0][..], &list, &numbers].concat(), 0, false)?;
        }
        Ok((daq, packets))
    }

    /// Takes the first of the slave's own (static) lists that has room for these values, sends with this event, and is not in use.
    fn ready_list(
        &mut self,
        values: &[Sampled],
        event: u16,
        lists: u16,
        limits: Limits,
    ) -> anyhow::Result<(u16, Vec<Vec<usize>>)> {
        let mut refused = Vec::new();
        for daq in 0..lists.min(MOST_READY_LISTS) {
            let list = self.number(daq.into(), 2);
            let info =
                match self.ask_whether([&[command::GET_DAQ_LIST_INFO, 0][..], &list].concat(), 0, true)? {
                    Ok(info) => info,
                    Err((name, code)) if daq == 0 => {
                        bail!("the ECU refused {name}: {}", refusal(false, code))
                    }
                    Err(_) => break,
                };
            let &[properties, odts, entries, low, high, ..] = &info[..] else {
                bail!("the ECU's answer about list {daq} has {} bytes; it has to have 5", info.len());
            };
            let fixed = self.order().unwrap_or(ByteOrder::Little).number(&[low, high]);
            let kinds = properties & (LIST_DAQ | LIST_STIM);
            let why = if properties & LIST_PREDEFINED != 0 {
                "has contents that do not change".to_owned()
            } else if kinds == LIST_STIM {
                "is for stimulation".to_owned()
            } else if properties & LIST_EVENT_FIXED != 0 && fixed != u64::from(event) {
                format!("has event {fixed}")
            } else {
                let limits = Limits { entries: entries.into(), ..limits };
                match packets(values, limits) {
                    Ok(packets) if packets.len() <= usize::from(odts) => {
                        let mode = [&[command::GET_DAQ_LIST_MODE, 0][..], &list].concat();
                        let mode = self.ask_whether(mode, 0, true)?.ok();
                        if mode
                            .and_then(|mode| mode.first().copied())
                            .is_none_or(|mode| mode & LIST_RUNS == 0)
                        {
                            self.ask([&[command::CLEAR_DAQ_LIST, 0][..], &list].concat(), 0, true)?;
                            return Ok((daq, packets));
                        }
                        "is running already".to_owned()
                    }
                    Ok(packets) => {
                        format!("has {odts} packets of {entries} values, and {} are needed", packets.len())
                    }
                    Err(error) => error.to_string(),
                }
            };
            refused.push(format!("list {daq} {why}"));
        }
        bail!(
            "none of the ECU's lists can send this with event {event}: {}; measure less at once, or poll",
            refused.join(", ")
        )
    }

    /// The same by CCP: in the first of the slave's lists that is large enough.
    fn start_ccp_list(&mut self, values: &[Sampled], event: u16) -> anyhow::Result<RunningList> {
        let event = u8::try_from(event).context("CCP has the events 0 to 255")?;
        for value in values {
            let Sampled { address, size, .. } = value;
            ensure!(
                matches!(size, 1 | 2 | 4),
                "CCP measures 1, 2 or 4 bytes at once, and {address:08X} has {size}; poll it"
            );
        }
        let room = MOST_FRAME - 1;
        let packets = packets(values, Limits { stamp: 0, room, largest: room, entries: usize::MAX })?;
        let slave = self.options.parties.slave;
        let id = u64::from(slave.raw()) | if slave.is_extended() { 1 << 31 } else { 0 };
        let id = self.number(id, 4);
        let (mut largest, mut found) = (0, None);
        for list in 0..MOST_CCP_LISTS {
            // This also empties the list.
            let command = [&[ccp::command::GET_DAQ_SIZE, list, 0][..], &id].concat();
            let size = match self.ask_whether(command, 2, true)? {
                Ok(answer) => usize::from(answer[0]),
                // The first refusal says why; a later one that there are no more lists.
                Err((name, code)) if list == 0 => bail!("the ECU refused {name}: {}", refusal(true, code)),
                Err(_) => break,
            };
            if size == 0 {
                break;
            }
            largest = largest.max(size);
            if size >= packets.len() {
                found = Some(list);
                break;
            }
        }
        let list = found.with_context(|| {
            format!(
                "the ECU's lists have up to {largest} packets, and {} are needed; measure less at once",
                packets.len()
            )
        })?;
        for (odt, entries) in packets.iter().enumerate() {
            for (entry, Sampled { extension, address, size }) in
                entries.iter().map(|place| values[*place]).enumerate()
            {
                self.ask(vec![ccp::command::SET_DAQ_PTR, list, odt as u8, entry as u8], 0, true)?;
                let address = self.number(address.into(), 4);
                self.ask(
                    [&[ccp::command::WRITE_DAQ, size as u8, extension][..], &address].concat(),
                    0,
                    false,
                )?;
            }
        }
        // Some want to be told; what else the status says stays.
        if let Ok(answer) = self.ask_whether(vec![ccp::command::GET_S_STATUS], 1, true)? {
            let status = answer[0] | CCP_LISTS_READY;
            self.ask_whether(vec![ccp::command::SET_S_STATUS, status], 0, true)?.ok();
        }
        let last = (packets.len() - 1) as u8;
        let command = [&[ccp::command::START_STOP, 1, list, last, event][..], &self.number(1, 2)].concat();
        self.ask(command, 0, true)?;
        Ok(RunningList { daq: list.into(), packets })
    }
}

/// What packets have room for, in bytes.
#[derive(Clone, Copy, Debug)]
struct Limits {
    /// A stamp in the first packet.
    stamp: usize,
    /// A packet, behind its identifier.
    room: usize,
    /// A value.
    largest: usize,
    /// Values of a packet, not bytes.
    entries: usize,
}

/// Puts values into as few packets as they fit in, in their order.
fn packets(values: &[Sampled], limits: Limits) -> anyhow::Result<Vec<Vec<usize>>> {
    let Limits { stamp, room, largest, entries } = limits;
    let (mut packets, mut left) = (vec![Vec::new()], room.saturating_sub(stamp));
    for (place, value) in values.iter().enumerate() {
        ensure!(
            value.size <= room.min(largest),
            "{:08X} has {} bytes, of which a packet has room for {}; read or poll it",
            value.address,
            value.size,
            room.min(largest)
        );
        if value.size > left || packets.last().is_some_and(|packet| packet.len() >= entries) {
            packets.push(Vec::new());
            left = room;
        }
        left -= value.size;
        if let Some(packet) = packets.last_mut() {
            packet.push(place);
        }
    }
    // A stamp alone would be a packet that nothing is in.
    ensure!(!packets[0].is_empty(), "its first value has no room beside the stamp; name a shorter one first");
    Ok(packets)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sizes(sizes: &[usize]) -> Vec<Sampled> {
        sizes.iter().map(|size| Sampled { extension: 0, address: 0, size: *size }).collect()
    }

    fn limits(stamp: usize) -> Limits {
        Limits { stamp, room: 7, largest: 7, entries: usize::MAX }
    }

    #[test]
    fn values_are_packed_in_their_order() {
        let packed = packets(&sizes(&[2, 1, 4, 2, 1]), limits(4)).unwrap();
        assert_eq!(packed, [vec![0, 1], vec![2, 3, 4]]);
        let packed = packets(&sizes(&[1, 1, 1]), Limits { entries: 2, ..limits(0) }).unwrap();
        assert_eq!(packed, [vec![0, 1], vec![2]], "no more values than a ready list has room for");
        assert!(packets(&sizes(&[8]), limits(0)).is_err(), "longer than a packet");
        assert!(packets(&sizes(&[4]), limits(4)).is_err(), "the stamp is there");
    }
}
