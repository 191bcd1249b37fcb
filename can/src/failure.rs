//! What happens to frames that do not arrive, and to frames that are not sent.

/// Where frames were lost on their way.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum LossStage {
    /// The controller's hardware FIFO overran. It cannot tell how many frames it dropped.
    Controller,
    /// The device's record queue was full.
    Queue,
    /// Between device and host. The host computes it from sequence numbers.
    Link,
    /// In the host: a consumer did not keep up.
    Host,
    /// In a gateway: received on the other channel, to be sent on this one, and dropped, because more came than this bus took.
    Gateway,
}

impl LossStage {
    /// All of them: those on the way to the host in the order in which frames pass them, then a gateway's.
    pub const ALL: [Self; 5] = [Self::Controller, Self::Queue, Self::Link, Self::Host, Self::Gateway];

    /// Its name in texts, JSON and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Controller => "controller",
            Self::Queue => "queue",
            Self::Link => "link",
            Self::Host => "host",
            Self::Gateway => "gateway",
        }
    }

    /// The stage of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|stage| stage.name() == name)
    }
}

/// Tags of transmissions from here up belong to frames that a device sends on its own.
pub const DEVICE_TAG: u32 = 0xFFFF_0000;

/// Why a frame was not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum TransmitFailure {
    /// One-shot mode, and arbitration was lost.
    ArbitrationLost,
    /// One-shot mode, and an error hit the frame.
    BusError,
    /// The host asked for it.
    Aborted,
    /// The channel was closed.
    Closed,
    /// The controller went bus-off and recovery is manual.
    BusOff,
    /// A periodic frame's next periods began before the bus took it. The frame still waits, and its end is reported once.
    Overtaken {
        /// How many, since the entry's last such record.
        periods: u32,
    },
    /// A gateway has ended, since both its channels are on one bus. This stands for no frame; the tag is that of the rule that sent last.
    Loop,
}

impl TransmitFailure {
    /// One of each kind; that with a number has 1.
    pub const ALL: [Self; 7] = [
        Self::ArbitrationLost,
        Self::BusError,
        Self::Aborted,
        Self::Closed,
        Self::BusOff,
        Self::Overtaken { periods: 1 },
        Self::Loop,
    ];

    /// Its name in texts, JSON and tables, without its number.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ArbitrationLost => "arbitration-lost",
            Self::BusError => "bus-error",
            Self::Aborted => "aborted",
            Self::Closed => "closed",
            Self::BusOff => "bus-off",
            Self::Overtaken { .. } => "overtaken",
            Self::Loop => "loop",
        }
    }

    /// The failure of that name. `periods` is for [`Self::Overtaken`], which does without it as little as the others do with one.
    pub fn from_name(name: &str, periods: Option<u32>) -> Option<Self> {
        let failure = Self::ALL.into_iter().find(|failure| failure.name() == name)?;
        match (failure, periods) {
            (Self::Overtaken { .. }, periods) => Some(Self::Overtaken { periods: periods? }),
            (failure, None) => Some(failure),
            (_, Some(_)) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_is_that_of_one() {
        for stage in LossStage::ALL {
            assert_eq!(LossStage::from_name(stage.name()), Some(stage));
        }
        for failure in TransmitFailure::ALL {
            let periods = matches!(failure, TransmitFailure::Overtaken { .. }).then_some(1);
            assert_eq!(TransmitFailure::from_name(failure.name(), periods), Some(failure));
            assert_eq!(TransmitFailure::from_name(failure.name(), periods.xor(Some(1))), None);
        }
        assert_eq!((LossStage::from_name("bus"), TransmitFailure::from_name("", None)), (None, None));
    }
}
