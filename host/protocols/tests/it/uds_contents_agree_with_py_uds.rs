//! The contents of UDS messages, part by part, as the Python package py-uds reads them.
//!
//! The Python that has it is `CANTAP_PYTHON`, otherwise `python3`. If it is missing, that is said and the test passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.

use cantap_testing::peers;

use std::process::Command;

use cantap_protocols::{Event, Options, Protocol, Reader, Value};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/uds_contents_peer.py");
/// Rounds of 31 messages.
const ROUNDS: u32 = 60;

/// Our names of py-uds' parts.
const NAMES: [(&str, &str); 53] = [
    ("SubFunction", "sub_function"),
    ("modeOfOperation", "sub_function"),
    ("DID", "did"),
    ("dynamicallyDefinedDataIdentifier", "did"),
    ("sourceDataIdentifier", "source"),
    ("positionInSourceDataRecord", "position"),
    ("memorySize", "size"),
    ("memoryAddress", "address"),
    ("data", "parameters"),
    ("communicationType", "communication_type"),
    ("nodeIdentificationNumber", "node"),
    ("transmissionMode", "mode"),
    ("inputOutputControlParameter", "control"),
    ("blockSequenceCounter", "block"),
    ("transferResponseParameter", "parameters"),
    ("powerDownTime", "power_down_time"),
    ("linkControlModeIdentifier", "link_mode"),
    ("linkRecord", "bit_rate"),
    ("dataFormatIdentifier", "data_format"),
    ("maxNumberOfBlockLength", "block_length"),
    ("filePathAndName", "file"),
    ("fileSizeUnCompressed", "size_uncompressed"),
    ("fileSizeCompressed", "size_compressed"),
    ("filePosition", "file_position"),
    ("communicationConfiguration", "communication_configuration"),
    ("certificateClient", "certificate_client"),
    ("certificateServer", "certificate_server"),
    ("challengeClient", "challenge_client"),
    ("challengeServer", "challenge_server"),
    ("proofOfOwnershipClient", "proof_of_ownership_client"),
    ("proofOfOwnershipServer", "proof_of_ownership_server"),
    ("ephemeralPublicKeyClient", "ephemeral_public_key_client"),
    ("ephemeralPublicKeyServer", "ephemeral_public_key_server"),
    ("sessionKeyInfo", "session_key_information"),
    ("additionalParameter", "additional_parameter"),
    ("neededAdditionalParameter", "needed_additional_parameter"),
    ("algorithmIndicator", "algorithm"),
    ("authenticationReturnParameter", "result"),
    ("Administrative Parameter", "administrative"),
    ("Signature/Encryption Calculation", "signature_encryption"),
    ("Signature Length", "signature_length"),
    ("Anti-replay Counter", "anti_replay_counter"),
    ("Internal Message Service Request ID", "service"),
    ("Internal Message Service Response ID", "service"),
    ("Signature/MAC", "signature"),
    ("eventWindowTime", "event_window"),
    ("numberOfIdentifiedEvents", "identified_events"),
    ("DTCStatusMask", "status_mask"),
    ("Timer schedule", "schedule"),
    ("Comparison logic", "comparison"),
    ("Compare Value", "compared_with"),
    ("Hysteresis Value", "hysteresis"),
    ("Localization", "localization"),
];

/// Its parts of numbers that we show as a whole, or with their text.
const PARTS_OF_OURS: [&str; 47] = [
    "SID",
    "RSID",
    "suppressPosRspMsgIndicationBit",
    "definitionType",
    "reserved",
    "reserved-9bits",
    "memorySizeLength",
    "memoryAddressLength",
    "addressAndLengthFormatIdentifier",
    "storageState",
    "eventType",
    "event",
    "eventTypeRecord",
    "type",
    "numberOfBytesOfParameter",
    "encryptingMethod",
    "compressionMethod",
    "resetType",
    "networks",
    "messagesType",
    "linkControlType",
    "controlType",
    "controlState",
    "authenticationTask",
    "Signature on the response is requested.",
    "Message is signed.",
    "Message is request message.",
    "Message is encrypted.",
    "A pre-established key is used.",
    "lengthFormatIdentifier",
    "maxNumberOfBlockLengthBytesNumber",
    "transferRequestParameter",
    "serviceToRespondToRecord",
    "Service Specific Parameters",
    "Response Specific Parameters",
    "Periodic DID",
    "Data from Memory",
    "Data from DID",
    "fileSizeParameterLength",
    "fileSizeOrDirInfoParameterLength",
    "filePathAndNameLength",
    "Exponent",
    "Mantissa",
    "Compare Sign",
    "Bits Number",
    "Bit Offset",
    "validityMask",
];

/// The event of one message.
fn event(message: &str, time_ns: i64) -> Event {
    let sid = u8::from_str_radix(&message[..2], 16).unwrap();
    let from = if sid & 0x40 == 0 { "7E0" } else { "7E8" };
    let length = message.len() / 2;
    let full = [8, 12, 16, 20, 24, 32, 48, 64].into_iter().find(|full| *full >= length + 2).unwrap();
    let control = if full == 8 { format!("{length:02X}") } else { format!("00{length:02X}") };
    let frame = format!("{from}##1{control}{message}");
    let frame = format!("{frame:C<width$}", width = from.len() + 3 + 2 * full);
    let event = TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
    let protocols = vec![Protocol::IsoTp, Protocol::Uds, Protocol::Kwp2000, Protocol::Obd];
    let mut reader = Reader::new(Options { protocols, ..Options::default() });
    let mut events = Vec::new();
    reader.push(&TraceRecord { time_ns, device_ns: None, channel: 1, event }, &mut events);
    reader.finish(&mut events);
    let said: Vec<_> = events.iter().map(ToString::to_string).collect();
    assert_eq!(events.len(), 1, "{message}: {said:?}");
    events.remove(0)
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat()
}

/// Whether a field with this name has this value.
fn has(event: &Event, name: &str, theirs: &serde_json::Value) -> bool {
    event.fields.iter().filter(|field| field.name == name).any(|field| match &field.value {
        Value::Hex(ours, _) => theirs.as_u64() == Some(*ours),
        Value::Number(ours) => theirs.as_i64() == Some(*ours),
        Value::Text(ours) => theirs.as_str() == Some(&hex(ours.as_bytes())),
        Value::Bytes(ours) => {
            theirs.as_str() == Some(&hex(ours)) || theirs.as_u64().is_some_and(|one| ours[..] == [one as u8])
        }
        Value::Missing => theirs.as_u64() == Some(0xFF),
        Value::Real(_) => false,
    })
}

#[test]
fn every_part_of_a_message_is_there() {
    let Some(python) = peers::python_with("uds.translator") else { return };
    let seed = fastrand::u32(..);
    eprintln!("seed {seed}");
    let output =
        Command::new(python).args([SCRIPT, &seed.to_string(), &ROUNDS.to_string()]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let (mut compared, mut wrong) = (0, Vec::new());
    for line in String::from_utf8(output.stdout).unwrap().lines() {
        let theirs: serde_json::Value = serde_json::from_str(line).unwrap();
        let message = theirs["data"].as_str().unwrap();
        let ours = event(message, 0);
        for part in theirs["parts"].as_array().unwrap() {
            // `scalingByte#2` and `C0#2` are the second ones.
            let name = part[0].as_str().unwrap().split('#').next().unwrap();
            let name = match name {
                "fileSizeUncompressedOrDirInfoLength" if message.starts_with("7805") => "folder_length",
                "fileSizeUncompressedOrDirInfoLength" => "size_uncompressed",
                "scalingByte" => "scaling",
                "formulaIdentifier" => "formula",
                "unit/format" => "unit",
                name => NAMES.iter().find(|(their, _)| *their == name).map_or(name, |(_, our)| our),
            };
            let is_part = PARTS_OF_OURS.contains(&name)
                || name.starts_with("lengthOf")
                || name.starts_with("scalingByteExtension")
                || matches!(name, "C0" | "C1" | "C2")
                || name.starts_with("test")
                || matches!(name, "confirmedDTC" | "pendingDTC" | "warningIndicatorRequested");
            if is_part {
                continue;
            }
            compared += 1;
            if !has(&ours, name, &part[1]) {
                wrong.push(format!("{message}: {part}, ours is {ours}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{} of {compared}:\n{}", wrong.len(), wrong.join("\n"));
    assert!(compared > 80 * ROUNDS, "{compared}");
}
