//! Units, where a definition names them: in the comment behind a field, or at the end of its name.

/// As definitions write them, in lower case.
const WRITTEN: &[(&str, &str)] = &[
    ("v", "V"),
    ("volt", "V"),
    ("a", "A"),
    ("amp", "A"),
    ("ampere", "A"),
    ("ah", "Ah"),
    ("w", "W"),
    ("watt", "W"),
    ("wh", "Wh"),
    ("watt hours", "Wh"),
    ("k", "K"),
    ("kelvin", "K"),
    ("kelvin^2", "K²"),
    ("c", "°C"),
    ("°c", "°C"),
    ("celsius", "°C"),
    ("degc", "°C"),
    ("m", "m"),
    ("meter", "m"),
    ("meters", "m"),
    ("meters above sea level", "m"),
    ("mm", "mm"),
    ("millimeters", "mm"),
    ("1 lsb = 10 mm", "cm"),
    ("cm", "cm"),
    ("centimeter^3", "cm³"),
    ("cm³", "cm³"),
    ("m/s", "m/s"),
    ("meter/second", "m/s"),
    ("meters per second", "m/s"),
    ("cm/s", "cm/s"),
    ("(m/s)^2", "m²/s²"),
    ("m²/s²", "m²/s²"),
    ("m/s²", "m/s²"),
    ("meter/(second^2)", "m/s²"),
    ("rad", "rad"),
    ("radian", "rad"),
    ("radians", "rad"),
    ("rad²", "rad²"),
    ("radians^2", "rad²"),
    ("rad/s", "rad/s"),
    ("radian/second", "rad/s"),
    ("deg", "deg"),
    ("degrees", "deg"),
    ("degrees in body frame", "deg"),
    ("centi-deg", "0.01 deg"),
    ("0.01 deg", "0.01 deg"),
    ("dege7", "1e-7 deg"),
    ("1e-7 deg", "1e-7 deg"),
    ("1 lsb = 1e-7 deg", "1e-7 deg"),
    ("1e-8 deg", "1e-8 deg"),
    ("pa", "Pa"),
    ("pascal", "Pa"),
    ("pascal^2", "Pa²"),
    ("pa²", "Pa²"),
    ("hz", "Hz"),
    ("s", "s"),
    ("sec", "s"),
    ("second", "s"),
    ("seconds", "s"),
    ("microseconds", "µs"),
    ("µs", "µs"),
    ("minutes", "min"),
    ("min", "min"),
    ("hours", "h"),
    ("h", "h"),
    ("hours^2", "h²"),
    ("h²", "h²"),
    ("k²", "K²"),
    ("percent", "%"),
    ("%", "%"),
    ("n", "N"),
    ("newton", "N"),
    ("0.1v", "0.1 V"),
    ("0.1 v", "0.1 V"),
    ("0.1a", "0.1 A"),
    ("0.1 a", "0.1 A"),
];

/// The ends of names, the longest first.
const ENDS: &[(&str, &str)] = &[
    ("_deg_1e8", "1e-8 deg"),
    ("_deg_1e7", "1e-7 deg"),
    ("_percent", "%"),
    ("_degC", "°C"),
    ("_usec", "µs"),
    ("_msec", "ms"),
    ("_sec", "s"),
    ("_pct", "%"),
    ("_hpa", "hPa"),
    ("_cm3", "cm³"),
    ("_wh", "Wh"),
    ("_mm", "mm"),
    ("_cm", "cm"),
    ("_ms", "ms"),
];

/// Cyphal's standard types of quantities (`uavcan.si`) name their fields by their units.
const QUANTITIES: &[(&str, &str)] = &[
    ("ampere", "A"),
    ("ampere_per_meter", "A/m"),
    ("candela_per_square_meter", "cd/m²"),
    ("coulomb", "C"),
    ("cubic_meter", "m³"),
    ("cubic_meter_per_second", "m³/s"),
    ("hertz", "Hz"),
    ("joule", "J"),
    ("kelvin", "K"),
    ("kilogram", "kg"),
    ("meter", "m"),
    ("meter_per_second", "m/s"),
    ("meter_per_second_per_second", "m/s²"),
    ("newton", "N"),
    ("newton_meter", "N m"),
    ("pascal", "Pa"),
    ("radian", "rad"),
    ("radian_per_second", "rad/s"),
    ("radian_per_second_per_second", "rad/s²"),
    ("second", "s"),
    ("tesla", "T"),
    ("volt", "V"),
    ("watt", "W"),
];

/// The unit in a comment; empty if it names none, or several.
pub fn of_comment(comment: &str) -> &'static str {
    let comment = comment.trim().to_lowercase();
    if let Some((unit, _)) = comment.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        return written(unit);
    }
    let found = written(&comment);
    if !found.is_empty() {
        return found;
    }
    // `Unit: percent, from 0%`, `Longitude in meters. May be negative`, `meters, use -1000 if unknown`.
    let pieces = comment.split([',', ':', ';']).flat_map(|piece| piece.split(". "));
    let units = pieces.map(|piece| {
        let piece = piece.trim().trim_end_matches('.');
        let behind = piece
            .rsplit_once("in ")
            .map_or("", |(before, unit)| if before.is_empty() || before.ends_with(' ') { unit } else { "" });
        [piece, behind].into_iter().map(written).find(|unit| !unit.is_empty()).unwrap_or_default()
    });
    units.into_iter().find(|unit| !unit.is_empty()).unwrap_or_default()
}

fn written(text: &str) -> &'static str {
    let text = text.trim();
    WRITTEN.iter().find(|(written, _)| *written == text).map_or("", |(_, unit)| unit)
}

/// The unit of a field of a type, by its comment or its name.
pub fn of_field(type_name: &str, field: &str, comment: &str) -> &'static str {
    let named = || {
        let end = ENDS.iter().find(|(end, _)| field.ends_with(end));
        end.map_or(if field == "rpm" { "rpm" } else { "" }, |(_, unit)| unit)
    };
    let quantity = || {
        let is_quantity = type_name.starts_with("uavcan.si.");
        let quantity = QUANTITIES.iter().find(|(name, _)| is_quantity && *name == field);
        quantity.map_or("", |(_, unit)| unit)
    };
    [of_comment(comment), named(), quantity()].into_iter().find(|unit| !unit.is_empty()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_those_that_a_definition_names() {
        for (comment, unit) in [
            (" [Volt]", "V"),
            (" m/s", "m/s"),
            (" Ampere. Can be negative in case of a regenerative braking.", "A"),
            (" [Ah] : Predicted capacity", "Ah"),
            (" NED frame (north-east-down) in meters per second", "m/s"),
            (" Measured angle of connected angle sensor, in degrees. Range is 0 to 360.", "deg"),
            (" meter or radian", ""),
            (" Unit: percent, from 0% to 100%", "%"),
            (" Temperature of connected motor, in Celsius. Range is -256 to +255 C.", "°C"),
            (" Number of transmitted transfers.", ""),
            (" Reserved", ""),
            (" minutes", "min"),
        ] {
            assert_eq!(of_comment(comment), unit, "{comment}");
        }
        for (_, unit) in WRITTEN {
            assert_eq!(of_comment(unit), *unit, "a unit that is written by itself is read again");
        }
        assert_eq!(of_field("a.B", "uptime_sec", ""), "s");
        assert_eq!(of_field("uavcan.si.unit.velocity.Scalar.1.0", "meter_per_second", ""), "m/s");
        assert_eq!(of_field("own.Scalar.1.0", "second", ""), "");
    }
}
