//! What the driver's control transfers are for.

/// What a control transfer is for; enumeration goes through them in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Purpose {
    FirstLook,
    Address,
    DeviceDescriptor,
    Qualifier,
    ObjectStore,
    ConfigurationHead,
    Configuration,
    Languages,
    Text(usize),
    Configure,
    PutCoding,
    GetCoding,
    Lines,
    /// The driver found a bulk pipe halted; its address.
    ClearHalt(u8),
    User,
}
