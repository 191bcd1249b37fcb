//! The control transfers: which there are, and in what order.

use super::super::control::{
    CLEAR_FEATURE, ENDPOINT_HALT, Outcome, Request, SET_CONFIGURATION, SET_INTERFACE, Transfer,
};
use super::super::descriptors;
use super::super::enumeration_error::EnumerationError;
use super::purpose::Purpose;
use super::{Driver, Identity, LineCoding, Pending};

const GET_DESCRIPTOR: u8 = 6;
const SET_ADDRESS: u8 = 5;
const SET_LINE_CODING: u8 = 0x20;
const GET_LINE_CODING: u8 = 0x21;
const SET_CONTROL_LINE_STATE: u8 = 0x22;
/// bmRequestType: standard requests to the device, class requests to an interface.
const FROM_DEVICE: u8 = 0x80;
const TO_DEVICE: u8 = 0x00;
const CLASS_IN: u8 = 0xA1;
const CLASS_OUT: u8 = 0x21;

/// Milliseconds that a device has to take its address (USB 2.0, 9.2.6.3: 2 ms; Linux waits 10).
const ADDRESS_PAUSE_MS: u64 = 10;

impl Purpose {
    fn name(self) -> &'static str {
        match self {
            Self::FirstLook => "the first GET_DESCRIPTOR(device)",
            Self::Address => "SET_ADDRESS",
            Self::DeviceDescriptor => "GET_DESCRIPTOR(device)",
            Self::Qualifier => "GET_DESCRIPTOR(device qualifier)",
            Self::ObjectStore => "GET_DESCRIPTOR(BOS)",
            Self::ConfigurationHead | Self::Configuration => "GET_DESCRIPTOR(configuration)",
            Self::Languages | Self::Text(_) => "GET_DESCRIPTOR(string)",
            Self::Configure => "SET_CONFIGURATION",
            Self::PutCoding => "SET_LINE_CODING",
            Self::GetCoding => "GET_LINE_CODING",
            Self::Lines => "SET_CONTROL_LINE_STATE",
            Self::ClearHalt(_) => "CLEAR_FEATURE(ENDPOINT_HALT)",
            Self::User => "a test's request",
        }
    }
}

impl Driver {
    pub(super) fn begin(&mut self, purpose: Purpose) {
        let descriptor = |kind: u16, index: u16, language: u16, length: u16| {
            Request::new(FROM_DEVICE, GET_DESCRIPTOR, kind << 8 | index, language, length)
        };
        let interface = self.acm.map_or(0, |acm| u16::from(acm.control_interface));
        let request = match purpose {
            Purpose::FirstLook => descriptor(1, 0, 0, 64),
            Purpose::Address => {
                self.last_address = self.last_address % 127 + 1;
                Request::new(TO_DEVICE, SET_ADDRESS, u16::from(self.last_address), 0, 0)
            }
            Purpose::DeviceDescriptor => descriptor(1, 0, 0, 18),
            Purpose::Qualifier => descriptor(6, 0, 0, 10),
            Purpose::ObjectStore => descriptor(15, 0, 0, 5),
            Purpose::ConfigurationHead => descriptor(2, 0, 0, 9),
            Purpose::Configuration => descriptor(2, 0, 0, self.configuration_length),
            Purpose::Languages => descriptor(3, 0, 0, 255),
            Purpose::Text(which) => {
                let index = self.device.map_or(0, |device| device.strings[which]);
                descriptor(3, u16::from(index), self.language, 255)
            }
            Purpose::Configure => {
                let value = self.acm.map_or(0, |acm| u16::from(acm.configuration));
                Request::new(TO_DEVICE, SET_CONFIGURATION, value, 0, 0)
            }
            Purpose::PutCoding => {
                let coding = LineCoding::default().0.to_vec();
                Request::with_data(CLASS_OUT, SET_LINE_CODING, 0, interface, coding)
            }
            Purpose::GetCoding => Request::new(CLASS_IN, GET_LINE_CODING, 0, interface, 7),
            Purpose::Lines => {
                // DTR and RTS.
                self.lines_sent = self.port_wanted;
                let lines = if self.port_wanted { 3 } else { 0 };
                Request::new(CLASS_OUT, SET_CONTROL_LINE_STATE, lines, interface, 0)
            }
            Purpose::ClearHalt(address) => Request::clear_halt(address),
            Purpose::User => match self.user.pop_front() {
                Some(request) => request,
                None => return,
            },
        };
        self.pending =
            Some(Pending { purpose, transfer: Transfer::new(request.clone()), request, started: None });
    }

    pub(super) fn ended(&mut self, outcome: Outcome) {
        let Some(Pending { purpose, request, .. }) = self.pending.take() else {
            return;
        };
        if matches!(outcome, Outcome::Done(_)) {
            self.follow(&request);
        }
        if purpose == Purpose::User {
            self.outcomes.push_back(outcome);
            return;
        }
        let result = match outcome {
            Outcome::Done(bytes) => self.advance(purpose, &bytes),
            // A full-speed device has no other speed to describe.
            Outcome::Stalled if purpose == Purpose::Qualifier => {
                self.after_device_descriptor();
                Ok(())
            }
            Outcome::Stalled => Err(EnumerationError::Refused(purpose.name())),
            Outcome::Failed(how) => Err(EnumerationError::Transfer { what: purpose.name(), how }),
        };
        if let Err(error) = result {
            self.configured = false;
            self.failure = Some(error);
        }
    }

    fn after_device_descriptor(&mut self) {
        // The binary object store exists from USB 2.01 on.
        self.begin(if self.usb_version > 0x0200 { Purpose::ObjectStore } else { Purpose::ConfigurationHead });
    }

    /// Uses the result of a control transfer and begins the next.
    fn advance(&mut self, purpose: Purpose, bytes: &[u8]) -> Result<(), EnumerationError> {
        let short = |what: &str| Err(EnumerationError::Descriptor(what.to_owned()));
        match purpose {
            Purpose::FirstLook => {
                let Some(&packet) = bytes.get(7) else {
                    return short("fewer than 8 bytes of the device descriptor");
                };
                self.ep0_packet = usize::from(packet);
                if self.second_wanted {
                    self.reset_request = true;
                } else {
                    self.begin(Purpose::Address);
                }
            }
            Purpose::Address => {
                self.address = self.last_address;
                self.pause = Some(ADDRESS_PAUSE_MS);
                self.begin(Purpose::DeviceDescriptor);
            }
            Purpose::DeviceDescriptor => {
                self.device = Some(descriptors::device(bytes)?);
                self.usb_version = u16::from_le_bytes([bytes[2], bytes[3]]);
                self.begin(Purpose::Qualifier);
            }
            Purpose::Qualifier => return short("a full-speed device has a device qualifier"),
            Purpose::ObjectStore => {
                if bytes.len() != 5 || bytes[0] != 5 || bytes[1] != 15 {
                    return short("the binary object store is malformed");
                }
                self.begin(Purpose::ConfigurationHead);
            }
            Purpose::ConfigurationHead => {
                self.configuration_length = descriptors::configuration_length(bytes)?;
                self.begin(Purpose::Configuration);
            }
            Purpose::Configuration => {
                self.acm = Some(descriptors::cdc_acm(bytes)?);
                self.begin(Purpose::Languages);
            }
            Purpose::Languages => {
                self.language = descriptors::language(bytes)?;
                self.begin_text(0);
            }
            Purpose::Text(which) => {
                self.strings[which] = descriptors::string(bytes)?;
                self.begin_text(which + 1);
            }
            Purpose::Configure => self.configured(),
            Purpose::PutCoding => self.begin(Purpose::GetCoding),
            Purpose::GetCoding => {
                if bytes != LineCoding::default().0 {
                    return short("GET_LINE_CODING does not give what SET_LINE_CODING set");
                }
                self.coding_set = true;
            }
            Purpose::Lines => self.port_open = self.lines_sent,
            Purpose::ClearHalt(_) | Purpose::User => {}
        }
        Ok(())
    }

    /// Requests the device's next string, or continues after the last.
    fn begin_text(&mut self, from: usize) {
        let strings = self.device.map_or([0; 3], |device| device.strings);
        let next = (from..strings.len()).find(|which| strings[*which] != 0);
        self.begin(next.map_or(Purpose::Configure, Purpose::Text));
    }

    /// Applies a completed request to the host's side of the pipes: where the device begins with DATA0, so does the host (USB 2.0,
    /// 9.1.1.5 and 9.4.5), and a configuration closes a port that a program had open, unless the driver keeps it.
    fn follow(&mut self, request: &Request) {
        let Some(acm) = self.acm else { return };
        match (request.kind, request.request) {
            (TO_DEVICE, SET_CONFIGURATION) => {
                (self.in_data1, self.out_data1, self.notify_data1) = (false, false, false);
                self.bound = request.value != 0;
                self.stalled = None;
                self.partial.clear();
                if !self.keeps_port {
                    self.port_open = false;
                    self.output.clear();
                }
            }
            (0x01, SET_INTERFACE) if request.index == u16::from(acm.data_interface) => {
                (self.in_data1, self.out_data1) = (false, false);
            }
            (0x01, SET_INTERFACE) => self.notify_data1 = false,
            (0x02, CLEAR_FEATURE) if request.value == ENDPOINT_HALT => {
                let address = request.index as u8;
                if address == acm.input.number | 0x80 {
                    self.in_data1 = false;
                } else if address == acm.output.number {
                    self.out_data1 = false;
                } else {
                    self.notify_data1 = false;
                }
            }
            _ => {}
        }
    }

    fn configured(&mut self) {
        self.configured = true;
        self.enumerations += 1;
        if let (Some(device), Some(acm)) = (self.device, self.acm) {
            self.identity = Some(Identity { device, acm, strings: self.strings.clone() });
        }
    }
}
