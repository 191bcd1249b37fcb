//! What a description of the ECU (ODX) says of an exchange: names and values in place of bytes.

use std::sync::Arc;

use super::reports;
use crate::iso_tp::{Endpoint, Transfer};
use crate::odx::{Decoded, Described, Descriptions, Ecu, Internal, Physical, Reading};
use crate::{Bytes, Event, Field, Value};

/// Fields that say which message this is, which a description does not replace.
const KEPT: [&str; 8] = ["sid", "did", "sub_function", "routine", "control", "group", "nrc", "request"];
/// So many trouble codes of a report get a field with their text.
const MOST_CODES: usize = 256;

/// The fields of an event, apart by what they are of.
pub struct Parts {
    /// How many there were before those of the request.
    pub before: usize,
    /// How many there were before those of the response.
    pub request_end: usize,
}

/// Adds what the ECU's description says to an event: its name, the service's, and the values of request and response in place of their bytes.
pub fn describe(
    descriptions: &Descriptions,
    request: Option<&Transfer>,
    response: Option<&Transfer>,
    parts: &Parts,
    event: &mut Event,
) {
    let is_to_one = request.and_then(|request| request.to).is_some();
    let asks = request.filter(|_| is_to_one || response.is_none()).map(|request| request.from);
    let answers: Option<Endpoint> =
        response.map(|response| response.from).or_else(|| request.and_then(|request| request.to));
    let Some(ecu) = descriptions.of(asks, answers) else { return };
    let (request, response) =
        (request.map(|request| &request.data[..]), response.map(|response| &response.data[..]));
    let response_fields = event.fields.split_off(parts.request_end);
    let request_fields = event.fields.split_off(parts.before);
    event.fields.push(Field::text("ecu", ecu.name().to_owned()));
    let described = described(ecu, request, response);
    let described = described.unwrap_or_default();
    if !described.service.is_empty() {
        let long_name = Some(described.long_name.clone()).filter(|name| !name.is_empty());
        event.fields.push(Field::text("service", described.service.clone()).meaning(long_name));
    }
    merge(request_fields, described.request.as_ref(), &mut event.fields);
    let codes = response.map(reports::codes).unwrap_or_default();
    if codes.is_empty() {
        merge(response_fields, described.response.as_ref(), &mut event.fields);
    } else {
        // A report is read by the standard; the description has the texts of its codes.
        event.fields.extend(response_fields);
        event.fields.extend(codes.iter().take(MOST_CODES).filter_map(|code| code_text(ecu, *code)));
    }
}

fn described(ecu: &Arc<Ecu>, request: Option<&[u8]>, response: Option<&[u8]>) -> Option<Described> {
    let described = ecu.describe(request, response);
    let asks_for_more = |described: &Described| {
        described.request.as_ref().is_some_and(|request| !request.undescribed.is_empty())
    };
    if let Some([0x22, dids @ ..]) = request
        && dids.len() > 2
        && described.as_ref().is_none_or(asks_for_more)
    {
        return several(ecu, dids);
    }
    described.or_else(|| {
        // The bit that suppresses the response is not in a description.
        let mut request = request?.to_vec();
        *request.get_mut(1)? &= 0x7F;
        super::uds::is_response_suppressed(&[request[0], 0x80])
            .then(|| ecu.describe(Some(&request), response))?
    })
}

/// A request for several identifiers: nobody says where the value of one ends, unless a service describes just these, so only the names are
/// known.
fn several(ecu: &Ecu, dids: &[u8]) -> Option<Described> {
    let services = dids.chunks_exact(2).filter_map(|did| ecu.describe(Some(&[0x22, did[0], did[1]]), None));
    let names: Vec<_> = services.map(|described| described.service).collect();
    (!names.is_empty()).then(|| Described { service: names.join(", "), ..Described::default() })
}

fn code_text(ecu: &Ecu, code: [u8; 3]) -> Option<Field> {
    let number = u32::from_be_bytes([0, code[0], code[1], code[2]]);
    ecu.trouble_code(number).map(|text| Field::text("dtc", reports::code(&code)).meaning(Some(text)))
}

/// The fields of a message: those of the standard, or those of the description that say more. Where it does not describe all, both.
fn merge(standard: Vec<Field>, reading: Option<&Reading>, out: &mut Vec<Field>) {
    let Some(reading) = reading else { return out.extend(standard) };
    let values: Vec<_> = reading.values.iter().filter(|decoded| !decoded.is_constant).collect();
    let is_whole = reading.stop.is_none();
    let replaces = is_whole && (!values.is_empty() || reading.undescribed.is_empty());
    out.extend(
        standard.into_iter().filter(|field| !replaces || values.is_empty() || KEPT.contains(&&*field.name)),
    );
    out.extend(values.into_iter().map(field));
    if is_whole && !reading.undescribed.is_empty() && replaces {
        out.push(Field::bytes("undescribed", &reading.undescribed));
    }
    if let Some((path, stop)) = &reading.stop {
        let at = if path.is_empty() { String::new() } else { format!(" at {path}") };
        out.push(Field::text("not_described", format!("{stop}{at}")));
    }
}

fn field(decoded: &Decoded) -> Field {
    let name = decoded.path.clone();
    let hex = |number: i128| Some((u64::try_from(number).ok()?, decoded.hex_digits?));
    let number = |number: i128| match (hex(number), i64::try_from(number)) {
        (Some((number, digits)), _) => Value::Hex(number, digits),
        (None, Ok(number)) => Value::Number(number),
        // A type of 64 bits without a sign.
        (None, Err(_)) => {
            u64::try_from(number).map_or(Value::Real(number as f64), |number| Value::Hex(number, 16))
        }
    };
    let plain = |internal: &Internal| match internal {
        Internal::Int(value) => number(*value),
        Internal::Real(value) => Value::Real(*value),
        Internal::Text(text) => Value::Text(text.clone().into()),
        Internal::Bytes(bytes) => Value::Bytes(Bytes::from_slice(bytes)),
    };
    let (value, text) = match &decoded.value {
        Physical::Int(value) => (number(*value), None),
        Physical::Real(value) => (Value::Real(*value), None),
        Physical::Text(text) => (Value::Text(text.clone().into()), None),
        Physical::Bytes(bytes) => (Value::Bytes(Bytes::from_slice(bytes)), None),
        Physical::Meaning(internal, text) => (plain(internal), Some(text.clone())),
    };
    let text = decoded.note.clone().or(text).map(Into::into);
    Field { name: name.into(), value, unit: decoded.unit.to_string().into(), text }
}
