//! Signs of the protocols that share no bus with others as a rule, on one channel.

use cantap_trace::{TraceFrame, TraceRecord};

use crate::calibration::finding::ConnectionSigns;
use crate::canopen::CanOpenSigns;
use crate::ccp::signs::SessionFinder;
use crate::devicenet::DeviceNetSigns;
use crate::j1939::{self, Header};
use crate::uavcan::UavcanSigns;
use crate::xcp::signs::ConnectFinder;
use crate::{Event, Party, Protocol, nmea2000};

/// Counts on one channel.
#[derive(Clone, Debug, Default)]
pub(crate) struct Signs {
    pub extended: ExtendedSigns,
    pub canopen: CanOpenSigns,
    pub devicenet: DeviceNetSigns,
    pub xcp: ConnectionSigns<ConnectFinder>,
    pub ccp: ConnectionSigns<SessionFinder>,
    pub uavcan: UavcanSigns,
}

/// Numbers of data frames with 29 bits.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ExtendedSigns {
    all: u32,
    /// Those with the bit that both reserve.
    reserved: u32,
    /// Those of the second page, where NMEA 2000's groups are.
    second: u32,
    /// With a group that only NMEA 2000 has.
    marine: u32,
    /// With one of J1939's.
    vehicle: u32,
    /// With one of J1939's that NMEA 2000 does not have.
    vehicle_only: u32,
}

impl Signs {
    /// Takes a record, for these protocols only, and returns those whose identifiers it has.
    pub fn take(&mut self, record: &TraceRecord, wanted: u16) -> u16 {
        let Some(frame) = record.frame() else { return 0 };
        let mut of = 0;
        if frame.id().is_extended() {
            if wanted & FAMILY != 0 && !frame.is_remote() {
                of |= self.extended.take(frame, wanted);
            }
            // Always, since they show that frames are not the family's.
            if !frame.is_remote() {
                of |= self.uavcan.take(frame) & wanted;
            }
        } else if wanted & Protocol::CanOpen.bit() != 0 && self.canopen.take(frame) {
            of |= Protocol::CanOpen.bit();
        }
        if wanted & Protocol::DeviceNet.bit() != 0 && self.devicenet.take(record.time_ns, frame) {
            of |= Protocol::DeviceNet.bit();
        }
        if wanted & Protocol::CALIBRATION != 0 && !frame.is_remote() {
            of |= self.take_calibration(record, frame, wanted);
        }
        of
    }

    fn take_calibration(&mut self, record: &TraceRecord, frame: &TraceFrame, wanted: u16) -> u16 {
        let (id, data) = (frame.id(), frame.data());
        let mut of = 0;
        if wanted & Protocol::Xcp.bit() != 0 && self.xcp.take(record, id, data) {
            of |= Protocol::Xcp.bit();
        }
        if wanted & Protocol::Ccp.bit() != 0 && self.ccp.take(record, id, data) {
            of |= Protocol::Ccp.bit();
        }
        of
    }

    /// Whether an event is about the frames of a connection of XCP or CCP, which may look like transfers of ISO 15765-2.
    pub fn is_calibration(&self, event: &Event) -> bool {
        let has = |party: Party| match party {
            Party::Id(id) | Party::Addressed(id, _) => self.xcp.has(id) || self.ccp.has(id),
            _ => false,
        };
        has(event.from) || has(event.to)
    }

    /// Forgets the counts of what other traffic contradicts, and of what there was nothing of; returns whether any are left.
    pub fn keep_plausible(&mut self) -> bool {
        let Self { extended, canopen, devicenet, xcp, ccp, uavcan } = self;
        let known = extended.marine + extended.vehicle;
        if known == 0 || known <= extended.all / 10 {
            *extended = ExtendedSigns::default();
        }
        if canopen.count() == 0 {
            *canopen = CanOpenSigns::default();
        }
        if devicenet.count() == 0 {
            *devicenet = DeviceNetSigns::default();
        }
        if uavcan.is_empty() {
            *uavcan = UavcanSigns::default();
        }
        let counts = [extended.all, canopen.count(), devicenet.count(), xcp.count(), ccp.count()];
        counts.into_iter().any(|count| count > 0) || !uavcan.is_empty()
    }

    /// The protocols, with the number of messages that indicate them. Some are known already.
    pub fn found(&self, known: u16) -> impl Iterator<Item = (Protocol, u32)> + use<> {
        let canopen = self.canopen.count();
        let is_canopen = canopen > 0 || known & Protocol::CanOpen.bit() != 0;
        // CANopen's SDO servers and PDOs use identifiers that also occur in DeviceNet. A channel may have been connected to another bus.
        let devicenet = match self.devicenet.count() {
            count if is_canopen && (canopen > 0 || count < CONVINCING_BESIDE_CANOPEN) => 0,
            count => count,
        };
        let [dronecan, cyphal] = self.uavcan.found();
        let is_uavcan = dronecan.1 + cyphal.1 > 0;
        let [marine, vehicle] = if is_uavcan { [0, 0] } else { self.extended.found(known) };
        [
            (Protocol::J1939, vehicle),
            (Protocol::Nmea2000, marine),
            (Protocol::CanOpen, canopen),
            (Protocol::DeviceNet, devicenet),
            (Protocol::Xcp, self.xcp.count()),
            (Protocol::Ccp, self.ccp.count()),
            dronecan,
            cyphal,
        ]
        .into_iter()
        .filter(move |(protocol, count)| *count > 0 && known & protocol.bit() == 0)
    }
}

/// So many messages of DeviceNet show it on a channel that had CANopen.
const CONVINCING_BESIDE_CANOPEN: u32 = 5;

/// Both use the same frames.
pub(crate) const FAMILY: u16 = Protocol::J1939.bit() | Protocol::Nmea2000.bit();

impl ExtendedSigns {
    fn take(&mut self, frame: &TraceFrame, wanted: u16) -> u16 {
        let Some(header) = Header::of(frame.id()) else { return 0 };
        self.all += 1;
        self.reserved += header.pgn >> 17;
        let mut of = 0;
        if header.pgn >= 0x1_0000 {
            self.second += 1;
            if wanted & Protocol::Nmea2000.bit() != 0 && nmea2000::is_known(header.pgn) {
                self.marine += 1;
                of |= Protocol::Nmea2000.bit();
            }
        } else if wanted & Protocol::J1939.bit() != 0 && j1939::is_known(header.pgn, frame.data().len()) {
            self.vehicle += 1;
            self.vehicle_only += u32::from(!nmea2000::has(header.pgn));
            of |= Protocol::J1939.bit();
        }
        of
    }

    /// The numbers of messages that indicate NMEA 2000 and J1939; zero for what is not there.
    fn found(&self, known: u16) -> [u32; 2] {
        // Identifiers without any rule have that bit half the time.
        if self.reserved > self.all / 4 {
            return [0, 0];
        }
        // Other 29-bit traffic occasionally matches a known number.
        let enough = |some: u32, all: u32| if some > 1 && some > all / 10 { some } else { 0 };
        // Beside one of the two, the other may be rare.
        let is_vehicle = known & Protocol::J1939.bit() != 0 || enough(self.vehicle, self.all) > 0;
        let marine = enough(self.marine, if is_vehicle { self.second } else { self.all });
        let is_boat = known & Protocol::Nmea2000.bit() != 0 || marine > 0;
        let vehicle = if is_boat {
            enough(self.vehicle_only, self.all - self.second)
        } else {
            enough(self.vehicle, self.all)
        };
        [marine, vehicle]
    }
}
