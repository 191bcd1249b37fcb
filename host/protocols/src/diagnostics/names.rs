//! Names for numbers: services, sub-functions, identifiers, reasons.

/// Services of ISO 14229-1:2020, table 2, and 27.
const UDS_SERVICES: [(u8, &str); 32] = [
    (0x10, "DiagnosticSessionControl"),
    (0x11, "ECUReset"),
    (0x14, "ClearDiagnosticInformation"),
    (0x19, "ReadDTCInformation"),
    (0x22, "ReadDataByIdentifier"),
    (0x23, "ReadMemoryByAddress"),
    (0x24, "ReadScalingDataByIdentifier"),
    (0x27, "SecurityAccess"),
    (0x28, "CommunicationControl"),
    (0x29, "Authentication"),
    (0x2A, "ReadDataByPeriodicIdentifier"),
    (0x2C, "DynamicallyDefineDataIdentifier"),
    (0x2E, "WriteDataByIdentifier"),
    (0x2F, "InputOutputControlByIdentifier"),
    (0x31, "RoutineControl"),
    (0x34, "RequestDownload"),
    (0x35, "RequestUpload"),
    (0x36, "TransferData"),
    (0x37, "RequestTransferExit"),
    (0x38, "RequestFileTransfer"),
    (0x3D, "WriteMemoryByAddress"),
    (0x3E, "TesterPresent"),
    // Up to ISO 14229-1:2013.
    (0x83, "AccessTimingParameter"),
    (0x84, "SecuredDataTransmission"),
    (0x85, "ControlDTCSetting"),
    (0x86, "ResponseOnEvent"),
    (0x87, "LinkControl"),
    // Reserved for whom builds the ECU.
    (0xBA, SUPPLIER),
    (0xBB, SUPPLIER),
    (0xBC, SUPPLIER),
    (0xBD, SUPPLIER),
    (0xBE, SUPPLIER),
];

const SUPPLIER: &str = "system supplier specific";

/// Services of ISO 14230-3 that are not in ISO 14229.
const KWP_SERVICES: [(u8, &str); 16] = [
    (0x12, "readFreezeFrameData"),
    (0x13, "readDiagnosticTroubleCodes"),
    (0x17, "readStatusOfDiagnosticTroubleCodes"),
    (0x18, "readDiagnosticTroubleCodesByStatus"),
    (0x1A, "readECUIdentification"),
    (0x20, "stopDiagnosticSession"),
    (0x21, "readDataByLocalIdentifier"),
    (0x26, "setDataRates"),
    (0x30, "inputOutputControlByLocalIdentifier"),
    (0x32, "stopRoutineByLocalIdentifier"),
    (0x33, "requestRoutineResultsByLocalIdentifier"),
    (0x39, "stopRoutineByAddress"),
    (0x3A, "requestRoutineResultsByAddress"),
    (0x3B, "writeDataByLocalIdentifier"),
    (0x81, "startCommunication"),
    (0x82, "stopCommunication"),
];

/// Services in both, with their names in ISO 14230-3 where those differ. 28 and 29 are from the draft of KWP2000 on CAN.
const KWP_SHARED: [(u8, &str); 13] = [
    (0x10, "startDiagnosticSession"),
    (0x14, "clearDiagnosticInformation"),
    (0x22, "readDataByCommonIdentifier"),
    (0x27, "securityAccess"),
    (0x28, "disableNormalMessageTransmission"),
    (0x29, "enableNormalMessageTransmission"),
    (0x2C, "dynamicallyDefineLocalIdentifier"),
    (0x2E, "writeDataByCommonIdentifier"),
    (0x2F, "inputOutputControlByCommonIdentifier"),
    (0x31, "startRoutineByLocalIdentifier"),
    (0x38, "startRoutineByAddress"),
    (0x3E, "testerPresent"),
    (0x83, "accessTimingParameter"),
];

/// Services of SAE J1979.
const OBD_SERVICES: [(u8, &str); 10] = [
    (0x01, "current data"),
    (0x02, "freeze frame data"),
    (0x03, "stored trouble codes"),
    (0x04, "clear trouble codes"),
    (0x05, "oxygen sensor test results"),
    (0x06, "on-board monitoring test results"),
    (0x07, "pending trouble codes"),
    (0x08, "control of on-board system"),
    (0x09, "vehicle information"),
    (0x0A, "permanent trouble codes"),
];

/// Negative response codes: ISO 14229-1:2020, table A.1; those of ISO 14230-3 agree where they are in both.
const REASONS: [(u8, &str); 58] = [
    (0x10, "generalReject"),
    (0x11, "serviceNotSupported"),
    (0x12, "subFunctionNotSupported"),
    (0x13, "incorrectMessageLengthOrInvalidFormat"),
    (0x14, "responseTooLong"),
    (0x21, "busyRepeatRequest"),
    (0x22, "conditionsNotCorrect"),
    (0x23, "routineNotComplete"),
    (0x24, "requestSequenceError"),
    (0x25, "noResponseFromSubnetComponent"),
    (0x26, "failurePreventsExecutionOfRequestedAction"),
    (0x31, "requestOutOfRange"),
    (0x33, "securityAccessDenied"),
    (0x34, "authenticationRequired"),
    (0x35, "invalidKey"),
    (0x36, "exceededNumberOfAttempts"),
    (0x37, "requiredTimeDelayNotExpired"),
    (0x38, "secureDataTransmissionRequired"),
    (0x39, "secureDataTransmissionNotAllowed"),
    (0x3A, "secureDataVerificationFailed"),
    (0x50, "certificateVerificationFailed: invalidTimePeriod"),
    (0x51, "certificateVerificationFailed: invalidSignature"),
    (0x52, "certificateVerificationFailed: invalidChainOfTrust"),
    (0x53, "certificateVerificationFailed: invalidType"),
    (0x54, "certificateVerificationFailed: invalidFormat"),
    (0x55, "certificateVerificationFailed: invalidContent"),
    (0x56, "certificateVerificationFailed: invalidScope"),
    (0x57, "certificateVerificationFailed: invalidCertificate"),
    (0x58, "ownershipVerificationFailed"),
    (0x59, "challengeCalculationFailed"),
    (0x5A, "settingAccessRightsFailed"),
    (0x5B, "sessionKeyCreationOrDerivationFailed"),
    (0x5C, "configurationDataUsageFailed"),
    (0x5D, "deAuthenticationFailed"),
    (0x70, "uploadDownloadNotAccepted"),
    (0x71, "transferDataSuspended"),
    (0x72, "generalProgrammingFailure"),
    (0x73, "wrongBlockSequenceCounter"),
    (0x78, "requestCorrectlyReceived-ResponsePending"),
    (0x7E, "subFunctionNotSupportedInActiveSession"),
    (0x7F, "serviceNotSupportedInActiveSession"),
    (0x80, "serviceNotSupportedInActiveDiagnosticMode"),
    (0x81, "rpmTooHigh"),
    (0x82, "rpmTooLow"),
    (0x83, "engineIsRunning"),
    (0x84, "engineIsNotRunning"),
    (0x85, "engineRunTimeTooLow"),
    (0x86, "temperatureTooHigh"),
    (0x87, "temperatureTooLow"),
    (0x88, "vehicleSpeedTooHigh"),
    (0x89, "vehicleSpeedTooLow"),
    (0x8A, "throttle/PedalTooHigh"),
    (0x8B, "throttle/PedalTooLow"),
    (0x8C, "transmissionRangeNotInNeutral"),
    (0x8D, "transmissionRangeNotInGear"),
    (0x8F, "brakeSwitch(es)NotClosed"),
    (0x90, "shifterLeverNotInPark"),
    (0x91, "torqueConverterClutchLocked"),
];

/// Identifiers defined in ISO 14229-1 (table C.1).
const DATA_IDENTIFIERS: [(u16, &str); 34] = [
    (0xF180, "boot software identification"),
    (0xF181, "application software identification"),
    (0xF182, "application data identification"),
    (0xF183, "boot software fingerprint"),
    (0xF184, "application software fingerprint"),
    (0xF185, "application data fingerprint"),
    (0xF186, "active diagnostic session"),
    (0xF187, "spare part number"),
    (0xF188, "ECU software number"),
    (0xF189, "ECU software version number"),
    (0xF18A, "system supplier"),
    (0xF18B, "ECU manufacturing date"),
    (0xF18C, "ECU serial number"),
    (0xF18D, "supported functional units"),
    (0xF18E, "kit assembly part number"),
    (0xF18F, "regulation X software identification numbers"),
    (0xF190, "VIN"),
    (0xF191, "ECU hardware number"),
    (0xF192, "supplier's ECU hardware number"),
    (0xF193, "supplier's ECU hardware version"),
    (0xF194, "supplier's ECU software number"),
    (0xF195, "supplier's ECU software version"),
    (0xF196, "exhaust regulation or type approval number"),
    (0xF197, "system name or engine type"),
    (0xF198, "repair shop code or tester serial number"),
    (0xF199, "programming date"),
    (0xF19A, "calibration repair shop code or equipment serial number"),
    (0xF19B, "calibration date"),
    (0xF19C, "calibration equipment software number"),
    (0xF19D, "ECU installation date"),
    (0xF19E, "ODX file"),
    (0xF19F, "entity"),
    (0xFF00, "UDS version"),
    (0xFF01, "reserved for ISO 15765-5"),
];

/// Sub-functions by service.
const SUB_FUNCTIONS: [(u8, u8, &str); 85] = [
    (0x10, 1, "default"),
    (0x10, 2, "programming"),
    (0x10, 3, "extended"),
    (0x10, 4, "safety system"),
    (0x11, 1, "hard reset"),
    (0x11, 2, "key off on"),
    (0x11, 3, "soft reset"),
    (0x11, 4, "enable rapid power shutdown"),
    (0x11, 5, "disable rapid power shutdown"),
    (0x19, 0x01, "number of DTCs by status mask"),
    (0x19, 0x02, "DTCs by status mask"),
    (0x19, 0x03, "snapshot identification"),
    (0x19, 0x04, "snapshot by DTC number"),
    (0x19, 0x05, "stored data by record number"),
    (0x19, 0x06, "extended data by DTC number"),
    (0x19, 0x07, "number of DTCs by severity mask"),
    (0x19, 0x08, "DTCs by severity mask"),
    (0x19, 0x09, "severity of DTC"),
    (0x19, 0x0A, "supported DTCs"),
    (0x19, 0x0B, "first test failed DTC"),
    (0x19, 0x0C, "first confirmed DTC"),
    (0x19, 0x0D, "most recent test failed DTC"),
    (0x19, 0x0E, "most recent confirmed DTC"),
    (0x19, 0x0F, "mirror memory DTCs by status mask"),
    (0x19, 0x10, "mirror memory extended data by DTC number"),
    (0x19, 0x11, "number of mirror memory DTCs by status mask"),
    (0x19, 0x12, "number of emissions DTCs by status mask"),
    (0x19, 0x13, "emissions DTCs by status mask"),
    (0x19, 0x14, "DTC fault detection counters"),
    (0x19, 0x15, "DTCs with permanent status"),
    (0x19, 0x16, "extended data by record number"),
    (0x19, 0x17, "user-defined memory DTCs by status mask"),
    (0x19, 0x18, "user-defined memory snapshot by DTC number"),
    (0x19, 0x19, "user-defined memory extended data by DTC number"),
    (0x19, 0x1A, "supported extended data record"),
    (0x19, 0x42, "WWH-OBD DTCs by mask record"),
    (0x19, 0x55, "WWH-OBD DTCs with permanent status"),
    (0x19, 0x56, "DTCs by readiness group"),
    (0x28, 0, "enable receiving and sending"),
    (0x28, 1, "enable receiving, disable sending"),
    (0x28, 2, "disable receiving, enable sending"),
    (0x28, 3, "disable receiving and sending"),
    (0x28, 4, "enable receiving, disable sending, with enhanced addresses"),
    (0x28, 5, "enable receiving and sending, with enhanced addresses"),
    (0x29, 0, "deauthenticate"),
    (0x29, 1, "verify certificate unidirectional"),
    (0x29, 2, "verify certificate bidirectional"),
    (0x29, 3, "proof of ownership"),
    (0x29, 4, "transmit certificate"),
    (0x29, 5, "request challenge"),
    (0x29, 6, "verify proof of ownership unidirectional"),
    (0x29, 7, "verify proof of ownership bidirectional"),
    (0x29, 8, "authentication configuration"),
    (0x2C, 1, "define by identifier"),
    (0x2C, 2, "define by memory address"),
    (0x2C, 3, "clear"),
    (0x31, 1, "start"),
    (0x31, 2, "stop"),
    (0x31, 3, "results"),
    (0x38, 1, "add file"),
    (0x38, 2, "delete file"),
    (0x38, 3, "replace file"),
    (0x38, 4, "read file"),
    (0x38, 5, "read folder"),
    (0x38, 6, "resume file"),
    (0x3E, 0, "zero"),
    (0x83, 1, "read extended timing"),
    (0x83, 2, "set default timing"),
    (0x83, 3, "read active timing"),
    (0x83, 4, "set timing"),
    (0x85, 1, "on"),
    (0x85, 2, "off"),
    (0x86, 0, "stop"),
    (0x86, 1, "on DTC status change"),
    (0x86, 2, "on timer interrupt"),
    (0x86, 3, "on change of data identifier"),
    (0x86, 4, "report activated events"),
    (0x86, 5, "start"),
    (0x86, 6, "clear"),
    (0x86, 7, "on comparison of values"),
    (0x86, 8, "report most recent DTC on status change"),
    (0x86, 9, "report DTC record on status change"),
    (0x87, 1, "verify mode transition with fixed parameter"),
    (0x87, 2, "verify mode transition with specific parameter"),
    (0x87, 3, "transition mode"),
];

fn find<K: PartialEq, N: Copy>(table: &[(K, N)], key: &K) -> Option<N> {
    table.iter().find(|(known, _)| known == key).map(|(_, name)| *name)
}

/// A service of UDS.
pub fn uds_service(sid: u8) -> Option<&'static str> {
    find(&UDS_SERVICES, &sid)
}

/// A service that only KWP2000 has.
pub fn kwp_only_service(sid: u8) -> Option<&'static str> {
    find(&KWP_SERVICES, &sid)
}

/// A service of KWP2000.
pub fn kwp_service(sid: u8) -> Option<&'static str> {
    kwp_only_service(sid).or_else(|| find(&KWP_SHARED, &sid)).or_else(|| uds_service(sid))
}

/// A service of OBD-II.
pub fn obd_service(sid: u8) -> Option<&'static str> {
    find(&OBD_SERVICES, &sid)
}

/// Whether a standard has this reason for a refusal.
pub fn is_reason(nrc: u8) -> bool {
    find(&REASONS, &nrc).is_some()
}

/// Why a request was refused.
pub fn reason(nrc: u8) -> &'static str {
    find(&REASONS, &nrc).unwrap_or(match nrc {
        0x38..=0x4F => "reserved for extended data link security",
        0x92 => "voltageTooHigh",
        0x93 => "voltageTooLow",
        0x94 => "resourceTemporarilyNotAvailable",
        0xF0..=0xFE => "specific to the vehicle manufacturer",
        _ => "reserved",
    })
}

/// A data identifier.
pub fn data_identifier(did: u16) -> Option<&'static str> {
    find(&DATA_IDENTIFIERS, &did).or(match did {
        0xF200..=0xF2FF => Some("periodic"),
        0xF300..=0xF3FF => Some("dynamically defined"),
        0xF400..=0xF5FF => Some("OBD PID"),
        0xF600..=0xF6FF => Some("OBD monitor"),
        0xF800..=0xF8FF => Some("OBD vehicle information"),
        _ => None,
    })
}

/// Events that are stored.
const STORED_EVENTS: [&str; 10] = [
    "stop, stored",
    "on DTC status change, stored",
    "on timer interrupt, stored",
    "on change of data identifier, stored",
    "report activated events, stored",
    "start, stored",
    "clear, stored",
    "on comparison of values, stored",
    "report most recent DTC on status change, stored",
    "report DTC record on status change, stored",
];

/// A service's sub-function, without the bit that suppresses the response.
pub fn sub_function(sid: u8, sub: u8) -> Option<&'static str> {
    let named = SUB_FUNCTIONS.iter().find(|(of, number, _)| (*of, *number) == (sid, sub));
    named.map(|(.., name)| *name).or(match (sid, sub) {
        // A bit says that the event outlasts a reset.
        (0x86, 0x40..=0x7F) => return STORED_EVENTS.get(usize::from(sub & 0x3F)).copied(),
        (0x27, 1..=0x7E) if sub % 2 == 1 => Some("request seed"),
        (0x27, 1..=0x7E) => Some("send key"),
        _ => None,
    })
}

/// Whether the service's second byte is a sub-function whose highest bit suppresses the response.
pub const fn has_sub_function(sid: u8) -> bool {
    matches!(sid, 0x10 | 0x11 | 0x19 | 0x27 | 0x28 | 0x29 | 0x2C | 0x31 | 0x3E | 0x83 | 0x85 | 0x86 | 0x87)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_have_each_number_once() {
        let unique = |mut keys: Vec<u32>| {
            let all = keys.len();
            keys.sort_unstable();
            keys.dedup();
            keys.len() == all
        };
        assert!(unique(UDS_SERVICES.iter().chain(&KWP_SERVICES).map(|(sid, _)| (*sid).into()).collect()));
        assert!(unique(REASONS.iter().map(|(nrc, _)| (*nrc).into()).collect()));
        assert!(unique(DATA_IDENTIFIERS.iter().map(|(did, _)| (*did).into()).collect()));
        assert!(unique(
            SUB_FUNCTIONS.iter().map(|(sid, sub, _)| u32::from(*sid) << 8 | u32::from(*sub)).collect()
        ));
    }
}
