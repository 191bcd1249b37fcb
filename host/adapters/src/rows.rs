//! What each kind of adapter can tell, and what it cannot.

use std::fmt;

/// Who stamps frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stamps {
    /// This computer, when a frame's bytes arrive: never early, late by whatever the line takes.
    Arrival,
    /// The adapter, with a clock of this grain, placed in this computer's time by arrivals.
    Adapter {
        /// In nanoseconds.
        grain_ns: u32,
        /// What the stamp marks.
        when: &'static str,
    },
    /// This computer's kernel, when the driver hands over a frame.
    Kernel,
    /// The controller, by its own clock, which the driver passes on without its grain, placed in this computer's time by arrivals.
    Controller,
    /// Another program, which wrote them into the trace.
    Trace,
}

/// Who counts losses before this program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Losses {
    /// Nobody.
    NotReported,
    /// The adapter, as flags: at least one frame each time.
    Flags,
    /// Some adapters, as flags; others do not notice any, and which one this is cannot be told.
    MayFlag,
    /// Nobody; but the adapter reports when its buffer was full and it stopped listening.
    Stops,
    /// The kernel exactly, and the controller's driver as far as it notices.
    Kernel,
    /// The program that wrote the trace, if it did.
    Trace,
}

impl Losses {
    /// Whether every loss before this program is counted by somebody, if only as "at least one". If not, no number is the whole.
    pub const fn are_counted(self) -> bool {
        match self {
            Self::Flags | Self::Kernel => true,
            Self::NotReported | Self::MayFlag | Self::Stops | Self::Trace => false,
        }
    }
}

/// What is known of frames that are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Confirmation {
    /// The frame was on the bus.
    OnTheBus,
    /// The adapter has accepted the frame. Whether it reached the bus is not known.
    Accepted,
    /// It was handed over, and nothing more is known.
    HandedOver,
    /// Nothing can be sent.
    CannotSend,
}

/// Whether the adapter can listen without acknowledging.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ListenOnly {
    /// It can, and confirms that it does.
    Confirmed,
    /// It can, but confirms nothing.
    Unconfirmed,
    /// It cannot: listening is refused, and `--mode normal` allows it to acknowledge.
    Never,
    /// The interface of this computer decides, whatever this program asks for.
    Interface {
        /// It is set to listen only, or has no controller.
        is_silent: bool,
    },
    /// It has no part in the bus, or its owner decides.
    Elsewhere,
}

/// One kind of adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Row {
    /// Its name in `Hello` and in `cantap info`.
    pub board: &'static str,
    /// For people.
    pub what: &'static str,
    /// Who stamps.
    pub stamps: Stamps,
    /// Who counts losses.
    pub losses: Losses,
    /// Whether it reports bus errors or the controller's state.
    pub errors: &'static str,
    /// What becomes of frames that are sent.
    pub confirmation: Confirmation,
    /// Whether it can be silent.
    pub listen_only: ListenOnly,
    /// Whether a bit rate is known and set; otherwise the one given is used for figures only.
    pub sets_bit_rate: bool,
    /// What of a bus's frames it does not show at all, if there is anything.
    pub limits: Option<&'static str>,
}

/// All kinds.
pub const ROWS: [Row; 35] = [
    Row {
        board: "slcan",
        what: "an slcan adapter that answers (Lawicel's protocol)",
        stamps: Stamps::Arrival,
        losses: Losses::Flags,
        errors: "state and the fact of errors, once a second",
        confirmation: Confirmation::Accepted,
        listen_only: ListenOnly::Confirmed,
        sets_bit_rate: true,
        limits: None,
    },
    Row {
        board: "slcan-normal",
        what: "an slcan adapter that cannot only listen",
        stamps: Stamps::Arrival,
        losses: Losses::Flags,
        errors: "state and the fact of errors, once a second",
        confirmation: Confirmation::Accepted,
        listen_only: ListenOnly::Never,
        sets_bit_rate: true,
        limits: None,
    },
    Row {
        board: "slcan-canable",
        what: "an slcan adapter that answers nothing (CANable's firmware)",
        stamps: Stamps::Arrival,
        losses: Losses::NotReported,
        errors: "not reported",
        confirmation: Confirmation::HandedOver,
        listen_only: ListenOnly::Unconfirmed,
        sets_bit_rate: true,
        limits: None,
    },
    usb_can_a("usb-can-a", TOLD_STANDARD),
    usb_can_a("usb-can-a-extended", TOLD_EXTENDED),
    Row {
        board: "canalyst-ii",
        what: "a CANalyst-II",
        stamps: Stamps::Adapter { grain_ns: 100_000, when: "its receiving the frame" },
        losses: Losses::NotReported,
        errors: "not reported",
        confirmation: Confirmation::HandedOver,
        listen_only: ListenOnly::Never,
        sets_bit_rate: true,
        limits: None,
    },
    gvret("gvret", None),
    gvret("gvret-fd", Some(FLAGS_BY_ADDRESS)),
    Row {
        board: "pcan",
        what: "an adapter of PEAK's, through PCAN-Basic",
        stamps: Stamps::Adapter {
            grain_ns: 1_000,
            when: "its receiving the frame, as its driver reports it",
        },
        losses: Losses::Flags,
        errors: "states, and error frames with a stuff or form error's kind",
        confirmation: Confirmation::Accepted,
        listen_only: ListenOnly::Confirmed,
        sets_bit_rate: true,
        limits: None,
    },
    Row {
        board: "kvaser",
        what: "an adapter of Kvaser's, through CANlib",
        stamps: Stamps::Adapter {
            grain_ns: 1_000,
            when: "its receiving the frame, as its driver reports it",
        },
        losses: Losses::Flags,
        errors: "states and counters, and each error frame",
        confirmation: Confirmation::OnTheBus,
        listen_only: ListenOnly::Confirmed,
        sets_bit_rate: true,
        limits: None,
    },
    Row {
        board: "socketcand",
        what: "an interface of a socketcand server",
        stamps: Stamps::Adapter { grain_ns: 1_000, when: "the server's receiving it" },
        losses: Losses::NotReported,
        errors: "that there was one",
        confirmation: Confirmation::HandedOver,
        listen_only: ListenOnly::Elsewhere,
        sets_bit_rate: false,
        limits: None,
    },
    cannelloni("cannelloni", "the other end of a cannelloni tunnel"),
    cannelloni("cannelloni-tcp", "the other end of a cannelloni tunnel over TCP"),
    Row {
        board: "trace-pipe",
        what: "a trace that another program writes into a pipe",
        stamps: Stamps::Trace,
        losses: Losses::Trace,
        errors: "as in the trace",
        confirmation: Confirmation::CannotSend,
        listen_only: ListenOnly::Elsewhere,
        sets_bit_rate: false,
        limits: None,
    },
    interface("socketcan", Stamps::Kernel, Confirmation::OnTheBus, false),
    interface("socketcan-silent", Stamps::Kernel, Confirmation::CannotSend, true),
    interface("socketcan-hw", Stamps::Controller, Confirmation::OnTheBus, false),
    interface("socketcan-hw-silent", Stamps::Controller, Confirmation::CannotSend, true),
    interface("socketcan-no-echo", Stamps::Kernel, Confirmation::Accepted, false),
    interface("socketcan-hw-no-echo", Stamps::Controller, Confirmation::Accepted, false),
    Row {
        what: "a CAN interface of Linux without a bit rate, such as a virtual one",
        errors: "those that other programs write",
        sets_bit_rate: false,
        ..interface("socketcan-virtual", Stamps::Kernel, Confirmation::Accepted, true)
    },
    gs_usb("gs_usb", true, true),
    gs_usb("gs_usb-normal", true, false),
    gs_usb("gs_usb-arrival", false, true),
    gs_usb("gs_usb-arrival-normal", false, false),
    cannectivity("gs_usb-confirmed", true),
    cannectivity("gs_usb-arrival-confirmed", false),
    elm327("elm327", true, Some(NO_LENGTHS)),
    elm327("elm327-normal", false, Some(NO_LENGTHS)),
    elm327("elm327-standard", true, Some(STANDARD_ONLY)),
    elm327("elm327-standard-normal", false, Some(STANDARD_ONLY)),
    elm327("elm327-extended", true, Some(EXTENDED_ONLY)),
    elm327("elm327-extended-normal", false, Some(EXTENDED_ONLY)),
    Row { what: "an STN chip (OBDLink)", ..elm327("stn", true, None) },
    Row { what: "an STN chip (OBDLink) that cannot only listen", ..elm327("stn-normal", false, None) },
];

const NO_LENGTHS: &str = "a remote frame's length is not reported, and shown as 0";
const STANDARD_ONLY: &str = "extended frames are not received (?ids=extended receives only them); a remote frame's length is shown as 0";
const EXTENDED_ONLY: &str = "standard frames are not received (?ids=standard receives only them); a remote frame's length is shown as 0";

const TOLD_STANDARD: &str = "it is told to receive standard frames (?ids=extended: extended ones); whether it receives the others then, its maker does not say";
const TOLD_EXTENDED: &str = "it is told to receive extended frames (?ids=standard: standard ones); whether it receives the others then, its maker does not say";

/// What the protocol of GVRET does not tell of frames on a bus with CAN FD.
const FLAGS_BY_ADDRESS: &str = "on a bus with CAN FD neither a frame's flags are reported nor whether one of up to 8 bytes is classical: each is shown as a CAN FD frame that switches its bit rate";

/// A row of the ends of cannelloni's tunnels.
const fn cannelloni(board: &'static str, what: &'static str) -> Row {
    Row {
        board,
        what,
        stamps: Stamps::Arrival,
        losses: Losses::NotReported,
        errors: "that there was one",
        confirmation: Confirmation::HandedOver,
        listen_only: ListenOnly::Elsewhere,
        sets_bit_rate: false,
        limits: None,
    }
}

/// A row of adapters with the protocol of Waveshare's USB-CAN-A.
const fn usb_can_a(board: &'static str, limits: &'static str) -> Row {
    Row {
        board,
        what: "a USB-CAN-A adapter (Waveshare, Seeed Studio)",
        stamps: Stamps::Arrival,
        losses: Losses::NotReported,
        errors: "error counters, once a second, if it answers",
        confirmation: Confirmation::HandedOver,
        listen_only: ListenOnly::Unconfirmed,
        sets_bit_rate: true,
        limits: Some(limits),
    }
}

/// A row of GVRET adapters.
const fn gvret(board: &'static str, limits: Option<&'static str>) -> Row {
    Row {
        board,
        what: "a GVRET adapter (ESP32RET, Macchina)",
        stamps: Stamps::Adapter { grain_ns: 1_000, when: "the frame's way out of the adapter, not the bus" },
        losses: Losses::NotReported,
        errors: "not reported",
        confirmation: Confirmation::HandedOver,
        listen_only: ListenOnly::Confirmed,
        sets_bit_rate: true,
        limits,
    }
}

/// A row of ELM327 chips and those that speak as they do.
const fn elm327(board: &'static str, can_listen: bool, limits: Option<&'static str>) -> Row {
    Row {
        board,
        what: if can_listen { "an ELM327" } else { "an ELM327 that does not confirm that it only listens" },
        stamps: Stamps::Arrival,
        losses: Losses::Stops,
        errors: "that there was one, if the adapter reports it",
        confirmation: Confirmation::CannotSend,
        listen_only: if can_listen { ListenOnly::Confirmed } else { ListenOnly::Never },
        sets_bit_rate: true,
        limits,
    }
}

/// A row of gs_usb adapters. candleLight's firmware, the most common, returns a sent frame when its controller has it, and notices no frame that
/// its controller or it had no room for (`CAN_SendFrame`, `can_receive`); which firmware it is cannot be told.
const fn gs_usb(board: &'static str, has_stamps: bool, can_listen: bool) -> Row {
    const CLOCK: Stamps = Stamps::Adapter { grain_ns: 1_000, when: "its firmware's taking the frame" };
    Row {
        board,
        what: if can_listen { "a gs_usb adapter" } else { "a gs_usb adapter that cannot only listen" },
        stamps: if has_stamps { CLOCK } else { Stamps::Arrival },
        losses: Losses::MayFlag,
        errors: "states, and each error if the adapter reports it",
        confirmation: Confirmation::Accepted,
        listen_only: if can_listen { ListenOnly::Unconfirmed } else { ListenOnly::Never },
        sets_bit_rate: true,
        limits: None,
    }
}

/// A row of adapters with CANnectivity, which returns a frame once it was sent (`gs_usb_can_tx_callback`), known by its own product number.
const fn cannectivity(board: &'static str, has_stamps: bool) -> Row {
    Row {
        what: "a gs_usb adapter with CANnectivity",
        confirmation: Confirmation::OnTheBus,
        ..gs_usb(board, has_stamps, true)
    }
}

/// A row of Linux's CAN interfaces.
const fn interface(board: &'static str, stamps: Stamps, confirmation: Confirmation, is_silent: bool) -> Row {
    Row {
        board,
        what: "a CAN interface of Linux",
        stamps,
        losses: Losses::Kernel,
        errors: "states, and each error if the driver reports it (berr-reporting on)",
        confirmation,
        listen_only: ListenOnly::Interface { is_silent },
        sets_bit_rate: true,
        limits: None,
    }
}

/// The row of the adapter that answers `Hello` with this board's name; `None` for a board of ours.
pub fn row(board: &str) -> Option<&'static Row> {
    ROWS.iter().find(|row| row.board == board)
}

impl Row {
    /// The sentence that a summary of received frames needs.
    pub const fn losses_before(&self) -> &'static str {
        match self.losses {
            Losses::NotReported => "losses before this program: not reported by this adapter",
            Losses::Flags => {
                "losses before this program: the adapter reports that there were some, not how many"
            }
            Losses::MayFlag => {
                "losses before this program: some adapters of this kind report that there were some, others (candleLight's firmware) none"
            }
            Losses::Stops => {
                "losses before this program: the adapter reports when its buffer was full, not how many frames that cost, and nothing of others"
            }
            Losses::Kernel => {
                "losses before this program: counted by the kernel, and by the controller's driver as far as it notices"
            }
            Losses::Trace => "losses before this program: as far as the trace reports them",
        }
    }
}

impl fmt::Display for Stamps {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Arrival => f.write_str("this computer's, at a frame's arrival"),
            Self::Adapter { grain_ns, when } => {
                write!(f, "the adapter's, to {} us, of {when}", f64::from(*grain_ns) / 1e3)
            }
            Self::Kernel => f.write_str("this computer's kernel's, when the driver hands a frame over"),
            Self::Controller => f.write_str("the controller's hardware clock's, of unknown grain"),
            Self::Trace => f.write_str("the trace's"),
        }
    }
}

impl fmt::Display for Confirmation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::OnTheBus => "confirmed once a frame was on the bus",
            Self::Accepted => "accepted by the adapter; whether a frame reached the bus is not known",
            Self::HandedOver => "handed over; what became of a frame is not known",
            Self::CannotSend => "nothing can be sent",
        })
    }
}

impl fmt::Display for ListenOnly {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Confirmed => "yes, confirmed by the adapter",
            Self::Unconfirmed => "yes, but not confirmed by the adapter",
            Self::Never => "no: open it with --mode normal, and it acknowledges frames",
            Self::Interface { is_silent: true } => "yes: the interface acknowledges nothing",
            Self::Interface { is_silent: false } => {
                "no: the interface is in normal mode, and acknowledges frames while it is up"
            }
            Self::Elsewhere => "decided elsewhere: this program has no influence on it",
        })
    }
}
