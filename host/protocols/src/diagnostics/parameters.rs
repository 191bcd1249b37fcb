//! OBD-II's parameters (PIDs): their names, and their values with units.

use super::values::{number, supported};
use super::{dtc, meanings, monitors};
use crate::Field;

/// A parameter with a linear value: `(raw * scale) + offset`.
struct Line {
    pid: u8,
    bytes: u8,
    name: &'static str,
    unit: &'static str,
    scale: f64,
    offset: f64,
    signed: bool,
}

const PERCENT: f64 = 100.0 / 255.0;
const TRIM: f64 = 100.0 / 128.0;

const fn line(pid: u8, bytes: u8, name: &'static str, unit: &'static str, scale: f64, offset: f64) -> Line {
    Line { pid, bytes, name, unit, scale, offset, signed: false }
}

/// SAE J1979-DA, by publicly known formulas: those of Wireshark's dissector, of the signal set OBDb/SAEJ1979, and of Wikipedia's
/// "OBD-II PIDs". All three give parameter 10 (air flow) two bytes; scapy 2.8 gives it one.
const LINES: [Line; 68] = [
    line(0x04, 1, "calculated_load", "%", PERCENT, 0.0),
    line(0x05, 1, "coolant_temperature", "°C", 1.0, -40.0),
    line(0x06, 1, "short_term_fuel_trim_bank_1", "%", TRIM, -100.0),
    line(0x07, 1, "long_term_fuel_trim_bank_1", "%", TRIM, -100.0),
    line(0x08, 1, "short_term_fuel_trim_bank_2", "%", TRIM, -100.0),
    line(0x09, 1, "long_term_fuel_trim_bank_2", "%", TRIM, -100.0),
    line(0x0A, 1, "fuel_pressure", "kPa", 3.0, 0.0),
    line(0x0B, 1, "intake_manifold_pressure", "kPa", 1.0, 0.0),
    line(0x0C, 2, "engine_speed", "rpm", 0.25, 0.0),
    line(0x0D, 1, "vehicle_speed", "km/h", 1.0, 0.0),
    line(0x0E, 1, "timing_advance", "°", 0.5, -64.0),
    line(0x0F, 1, "intake_air_temperature", "°C", 1.0, -40.0),
    line(0x10, 2, "air_flow", "g/s", 0.01, 0.0),
    line(0x11, 1, "throttle_position", "%", PERCENT, 0.0),
    line(0x1F, 2, "run_time", "s", 1.0, 0.0),
    line(0x21, 2, "distance_with_mil_on", "km", 1.0, 0.0),
    line(0x22, 2, "fuel_rail_pressure_relative", "kPa", 0.079, 0.0),
    line(0x23, 2, "fuel_rail_gauge_pressure", "kPa", 10.0, 0.0),
    line(0x2C, 1, "commanded_egr", "%", PERCENT, 0.0),
    line(0x2D, 1, "egr_error", "%", TRIM, -100.0),
    line(0x2E, 1, "commanded_evaporative_purge", "%", PERCENT, 0.0),
    line(0x2F, 1, "fuel_level", "%", PERCENT, 0.0),
    line(0x30, 1, "warm_ups_since_cleared", "", 1.0, 0.0),
    line(0x31, 2, "distance_since_cleared", "km", 1.0, 0.0),
    Line { signed: true, ..line(0x32, 2, "evaporative_system_pressure", "Pa", 0.25, 0.0) },
    line(0x33, 1, "barometric_pressure", "kPa", 1.0, 0.0),
    line(0x3C, 2, "catalyst_temperature_bank_1_sensor_1", "°C", 0.1, -40.0),
    line(0x3D, 2, "catalyst_temperature_bank_2_sensor_1", "°C", 0.1, -40.0),
    line(0x3E, 2, "catalyst_temperature_bank_1_sensor_2", "°C", 0.1, -40.0),
    line(0x3F, 2, "catalyst_temperature_bank_2_sensor_2", "°C", 0.1, -40.0),
    line(0x42, 2, "control_module_voltage", "V", 0.001, 0.0),
    line(0x43, 2, "absolute_load", "%", PERCENT, 0.0),
    line(0x44, 2, "commanded_lambda", "", 2.0 / 65_536.0, 0.0),
    line(0x45, 1, "relative_throttle_position", "%", PERCENT, 0.0),
    line(0x46, 1, "ambient_air_temperature", "°C", 1.0, -40.0),
    line(0x47, 1, "absolute_throttle_position_b", "%", PERCENT, 0.0),
    line(0x48, 1, "absolute_throttle_position_c", "%", PERCENT, 0.0),
    line(0x49, 1, "accelerator_pedal_position_d", "%", PERCENT, 0.0),
    line(0x4A, 1, "accelerator_pedal_position_e", "%", PERCENT, 0.0),
    line(0x4B, 1, "accelerator_pedal_position_f", "%", PERCENT, 0.0),
    line(0x4C, 1, "commanded_throttle_actuator", "%", PERCENT, 0.0),
    line(0x4D, 2, "time_with_mil_on", "min", 1.0, 0.0),
    line(0x4E, 2, "time_since_cleared", "min", 1.0, 0.0),
    line(0x52, 1, "ethanol_fuel", "%", PERCENT, 0.0),
    line(0x53, 2, "absolute_evaporative_pressure", "kPa", 0.005, 0.0),
    Line { signed: true, ..line(0x54, 2, "evaporative_system_pressure_wide", "Pa", 1.0, 0.0) },
    line(0x59, 2, "fuel_rail_absolute_pressure", "kPa", 10.0, 0.0),
    line(0x5A, 1, "relative_accelerator_pedal_position", "%", PERCENT, 0.0),
    line(0x5B, 1, "hybrid_battery_remaining", "%", PERCENT, 0.0),
    line(0x5C, 1, "oil_temperature", "°C", 1.0, -40.0),
    line(0x5D, 2, "fuel_injection_timing", "°", 1.0 / 128.0, -210.0),
    line(0x5E, 2, "fuel_rate", "L/h", 0.05, 0.0),
    line(0x61, 1, "demanded_torque", "%", 1.0, -125.0),
    line(0x62, 1, "actual_torque", "%", 1.0, -125.0),
    line(0x63, 2, "reference_torque", "Nm", 1.0, 0.0),
    line(0x8E, 1, "friction_torque", "%", 1.0, -125.0),
    line(0x84, 1, "manifold_surface_temperature", "°C", 1.0, -40.0),
    line(0x8D, 1, "absolute_throttle_position_g", "%", PERCENT, 0.0),
    line(0x9E, 2, "exhaust_flow_rate", "kg/h", 0.2, 0.0),
    line(0xA2, 2, "cylinder_fuel_rate", "mg/stroke", 1.0 / 32.0, 0.0),
    line(0xA6, 4, "odometer", "km", 0.1, 0.0),
    line(0x1C, 1, "obd_standard", "", 1.0, 0.0),
    line(0x51, 1, "fuel_type", "", 1.0, 0.0),
    line(0x5F, 1, "emission_requirements", "", 1.0, 0.0),
    line(0x12, 1, "secondary_air_status", "", 1.0, 0.0),
    line(0x13, 1, "oxygen_sensors_present", "", 1.0, 0.0),
    line(0x1D, 1, "oxygen_sensors_present_4_banks", "", 1.0, 0.0),
    line(0x1E, 1, "auxiliary_input", "", 1.0, 0.0),
];

/// Parameters with several values, whose first byte says which are present: the length, the name, and each value's bit, position,
/// bytes, name, unit, scale and offset.
struct Group {
    pid: u8,
    bytes: u8,
    name: &'static str,
    values: &'static [(u8, u8, u8, &'static str, &'static str, f64, f64)],
}

const GROUPS: [Group; 11] = [
    Group {
        pid: 0x66,
        bytes: 5,
        name: "air_flow_sensors",
        values: &[
            (0, 1, 2, "air_flow_a", "g/s", 1.0 / 32.0, 0.0),
            (1, 3, 2, "air_flow_b", "g/s", 1.0 / 32.0, 0.0),
        ],
    },
    Group {
        pid: 0x67,
        bytes: 3,
        name: "coolant_temperatures",
        values: &[
            (0, 1, 1, "coolant_temperature_1", "°C", 1.0, -40.0),
            (1, 2, 1, "coolant_temperature_2", "°C", 1.0, -40.0),
        ],
    },
    Group {
        pid: 0x6F,
        bytes: 3,
        name: "compressor_inlet_pressures",
        values: &[
            (0, 1, 1, "compressor_inlet_pressure_a", "kPa", 1.0, 0.0),
            (1, 2, 1, "compressor_inlet_pressure_b", "kPa", 1.0, 0.0),
        ],
    },
    Group { pid: 0x78, bytes: 9, name: "exhaust_gas_temperatures_bank_1", values: &EXHAUST_TEMPERATURES },
    Group { pid: 0x79, bytes: 9, name: "exhaust_gas_temperatures_bank_2", values: &EXHAUST_TEMPERATURES },
    Group {
        pid: 0x7C,
        bytes: 9,
        name: "particulate_filter_temperatures",
        values: &[
            (0, 1, 2, "filter_inlet_temperature_bank_1", "°C", 0.1, -40.0),
            (1, 3, 2, "filter_outlet_temperature_bank_1", "°C", 0.1, -40.0),
            (2, 5, 2, "filter_inlet_temperature_bank_2", "°C", 0.1, -40.0),
            (3, 7, 2, "filter_outlet_temperature_bank_2", "°C", 0.1, -40.0),
        ],
    },
    Group {
        pid: 0x87,
        bytes: 5,
        name: "intake_manifold_absolute_pressures",
        values: &[
            (0, 1, 2, "intake_manifold_absolute_pressure_a", "kPa", 1.0 / 32.0, 0.0),
            (1, 3, 2, "intake_manifold_absolute_pressure_b", "kPa", 1.0 / 32.0, 0.0),
        ],
    },
    Group {
        pid: 0x98,
        bytes: 9,
        name: "exhaust_gas_temperatures_5_to_8_bank_1",
        values: &MORE_EXHAUST_TEMPERATURES,
    },
    Group {
        pid: 0x99,
        bytes: 9,
        name: "exhaust_gas_temperatures_5_to_8_bank_2",
        values: &MORE_EXHAUST_TEMPERATURES,
    },
    Group {
        pid: 0xA4,
        bytes: 4,
        name: "transmission_gear",
        values: &[(1, 2, 2, "gear_ratio", "", 0.001, 0.0)],
    },
    Group {
        pid: 0xA5,
        bytes: 4,
        name: "exhaust_fluid_dosing",
        values: &[(0, 1, 1, "commanded_exhaust_fluid_dosing", "%", 0.5, 0.0)],
    },
];

const EXHAUST_TEMPERATURES: [(u8, u8, u8, &str, &str, f64, f64); 4] = [
    (0, 1, 2, "exhaust_gas_temperature_1", "°C", 0.1, -40.0),
    (1, 3, 2, "exhaust_gas_temperature_2", "°C", 0.1, -40.0),
    (2, 5, 2, "exhaust_gas_temperature_3", "°C", 0.1, -40.0),
    (3, 7, 2, "exhaust_gas_temperature_4", "°C", 0.1, -40.0),
];

const MORE_EXHAUST_TEMPERATURES: [(u8, u8, u8, &str, &str, f64, f64); 4] = [
    (0, 1, 2, "exhaust_gas_temperature_5", "°C", 0.1, -40.0),
    (1, 3, 2, "exhaust_gas_temperature_6", "°C", 0.1, -40.0),
    (2, 5, 2, "exhaust_gas_temperature_7", "°C", 0.1, -40.0),
    (3, 7, 2, "exhaust_gas_temperature_8", "°C", 0.1, -40.0),
];

/// Parameters that have a name and are shown as bytes; each extends to the end of its response. Names up to 87 as in
/// Wireshark, the others as in Wikipedia's "OBD-II PIDs" and, up to A6, in scapy; what 8F, 91 and 9C contain, by
/// BMW's OBD description for EDIABAS.
const NAMED: [(u8, &str); 46] = [
    (0x65, "auxiliary_inputs_and_outputs"),
    (0x68, "intake_air_temperature_sensors"),
    (0x69, "egr_commanded_and_actual"),
    (0x6A, "diesel_intake_air_flow_control"),
    (0x6B, "egr_temperatures"),
    (0x6C, "throttle_actuator_control"),
    (0x6D, "fuel_pressure_control"),
    (0x6E, "injection_pressure_control"),
    (0x70, "boost_pressure_control"),
    (0x71, "variable_geometry_turbo_control"),
    (0x72, "wastegate_control"),
    (0x73, "exhaust_pressures"),
    (0x74, "turbocharger_speeds"),
    (0x75, "turbocharger_a_temperatures"),
    (0x76, "turbocharger_b_temperatures"),
    (0x77, "charge_air_cooler_temperatures"),
    (0x7A, "particulate_filter_bank_1"),
    (0x7B, "particulate_filter_bank_2"),
    (0x7D, "nox_control_area_status"),
    (0x7E, "pm_control_area_status"),
    (0x7F, "engine_run_times"),
    (0x81, "run_times_of_auxiliary_device_1_to_5"),
    (0x82, "run_times_of_auxiliary_device_6_to_10"),
    (0x83, "nox_sensors"),
    (0x85, "nox_reagent_system"),
    (0x86, "pm_sensors"),
    (0x88, "scr_induce_system"),
    (0x89, "run_times_of_auxiliary_device_11_to_15"),
    (0x8A, "run_times_of_auxiliary_device_16_to_20"),
    (0x8B, "diesel_aftertreatment"),
    (0x8C, "wide_range_oxygen_sensors"),
    (0x8F, "pm_sensor_output"),
    (0x90, "wwh_obd_vehicle_information"),
    (0x91, "wwh_obd_ecu_information"),
    (0x92, "fuel_system_control"),
    (0x93, "wwh_obd_counters"),
    (0x94, "nox_warning_and_inducement"),
    (0x9A, "hybrid_vehicle_battery"),
    (0x9B, "exhaust_fluid_sensor"),
    (0x9C, "wide_range_oxygen_sensors_3_and_4"),
    (0x9F, "fuel_system_percentage_use"),
    (0xA1, "nox_sensors_corrected"),
    (0xA3, "evaporative_system_pressures"),
    (0xA7, "nox_sensors_3_and_4"),
    (0xA8, "nox_sensors_3_and_4_corrected"),
    (0xA9, "abs_disable_switch"),
];

/// Parameters 55 to 58: the name, and that of the second byte. A bank shares its parameter with the next but one.
const SECONDARY_TRIMS: [(&str, &str); 4] = [
    ("short_term_secondary_trim_bank_1", "short_term_secondary_trim_bank_3"),
    ("long_term_secondary_trim_bank_1", "long_term_secondary_trim_bank_3"),
    ("short_term_secondary_trim_bank_2", "short_term_secondary_trim_bank_4"),
    ("long_term_secondary_trim_bank_2", "long_term_secondary_trim_bank_4"),
];

/// Number of data bytes of a parameter of service 01; `None` if it is unknown.
pub fn length(pid: u8) -> Option<usize> {
    if pid.is_multiple_of(0x20) {
        return Some(4);
    }
    let known = LINES.iter().find(|line| line.pid == pid).map(|line| usize::from(line.bytes));
    let known = known.or_else(|| group(pid).map(|group| usize::from(group.bytes)));
    known.or(match pid {
        0x01 | 0x24..=0x2B | 0x34..=0x3B | 0x41 | 0x4F | 0x50 | 0x9D => Some(4),
        0x02 | 0x03 | 0x14..=0x1B | 0x55..=0x58 => Some(2),
        0x64 => Some(5),
        _ => None,
    })
}

fn group(pid: u8) -> Option<&'static Group> {
    GROUPS.iter().find(|group| group.pid == pid)
}

/// A parameter's name.
pub fn name(pid: u8) -> Option<&'static str> {
    let known = LINES.iter().find(|line| line.pid == pid).map(|line| line.name);
    let known = known.or_else(|| group(pid).map(|group| group.name));
    let known = known.or_else(|| NAMED.iter().find(|(named, _)| *named == pid).map(|(_, name)| *name));
    known.or(match pid {
        0x9D => Some("fuel_rates"),
        _ if pid.is_multiple_of(0x20) => Some("supported"),
        0x01 => Some("monitor_status"),
        0x02 => Some("freeze_frame_code"),
        0x03 => Some("fuel_system_status"),
        0x14..=0x1B => Some("oxygen_sensor_voltage"),
        0x24..=0x2B => Some("oxygen_sensor_lambda_voltage"),
        0x34..=0x3B => Some("oxygen_sensor_lambda_current"),
        0x41 => Some("monitor_status_this_cycle"),
        0x4F => Some("maximum_values"),
        0x50 => Some("maximum_air_flow"),
        0x55..=0x58 => Some(SECONDARY_TRIMS[usize::from(pid - 0x55)].0),
        0x64 => Some("torque_data"),
        _ => None,
    })
}

/// The parameter's values.
pub fn values(pid: u8, bytes: &[u8], fields: &mut Vec<Field>) {
    if let Some(line) = LINES.iter().find(|line| line.pid == pid) {
        let raw = number(bytes);
        let value = if line.signed { f64::from(raw as u16 as i16) } else { raw as f64 };
        // As the standard defines it: the offset is added before anything else is done to the number.
        fields.push(
            Field::real(line.name, value * line.scale + line.offset, line.unit)
                .meaning(meanings::of(pid, raw)),
        );
        return;
    }
    if let Some(group) = group(pid) {
        for &(bit, at, length, name, unit, scale, offset) in group.values {
            let raw = number(&bytes[usize::from(at)..usize::from(at + length)]) as f64;
            fields.push(if bytes[0] >> bit & 1 == 0 {
                Field::missing(name)
            } else {
                Field::real(name, raw * scale + offset, unit)
            });
        }
        return;
    }
    let word = |at: usize| number(&bytes[at..at + 2]) as f64;
    let byte = |at: usize| f64::from(bytes[at]);
    match pid {
        _ if pid.is_multiple_of(0x20) => fields.push(Field::text("supported", supported(pid, bytes))),
        0x01 | 0x41 => {
            // Of this driving cycle, the first byte is reserved: zero there does not mean that there are no codes.
            if pid == 0x01 {
                fields.push(Field::text("mil", if bytes[0] & 0x80 == 0 { "off" } else { "on" }));
                fields.push(Field::number("trouble_codes", bytes[0] & 0x7F));
            }
            fields.push(Field::bytes("monitors", &bytes[1..]));
            let open = monitors::not_complete(bytes);
            fields.push(Field::text("not_complete", if open.is_empty() { "none".to_owned() } else { open }));
        }
        0x02 => fields.push(Field::text("freeze_frame_code", dtc::list(bytes))),
        0x03 => {
            for (name, byte) in ["fuel_system_1", "fuel_system_2"].into_iter().zip(bytes) {
                fields.push(Field::hex(name, *byte, 2).meaning(meanings::of(pid, (*byte).into())));
            }
        }
        0x9D => {
            fields.push(Field::real("engine_fuel_rate", word(0) / 50.0, "g/s"));
            fields.push(Field::real("vehicle_fuel_rate", word(2) / 50.0, "g/s"));
        }
        0x14..=0x1B => {
            fields.push(Field::real("oxygen_sensor_voltage", byte(0) / 200.0, "V"));
            if bytes[1] != 0xFF {
                fields.push(Field::real("short_term_fuel_trim", byte(1) * TRIM - 100.0, "%"));
            }
        }
        0x24..=0x2B => {
            fields.push(Field::real("lambda", word(0) * 2.0 / 65_536.0, ""));
            fields.push(Field::real("oxygen_sensor_voltage", word(2) * 8.0 / 65_536.0, "V"));
        }
        0x34..=0x3B => {
            fields.push(Field::real("lambda", word(0) * 2.0 / 65_536.0, ""));
            fields.push(Field::real("oxygen_sensor_current", word(2) / 256.0 - 128.0, "mA"));
        }
        0x4F => {
            let parts = [
                ("lambda", 1.0, ""),
                ("oxygen_sensor_voltage", 1.0, "V"),
                ("oxygen_sensor_current", 1.0, "mA"),
            ];
            for (at, (name, scale, unit)) in parts.into_iter().enumerate() {
                fields.push(Field::real(format!("maximum_{name}"), byte(at) * scale, unit));
            }
            fields.push(Field::real("maximum_intake_manifold_pressure", byte(3) * 10.0, "kPa"));
        }
        0x50 => fields.push(Field::real("maximum_air_flow", byte(0) * 10.0, "g/s")),
        0x55..=0x58 => {
            let (first, second) = SECONDARY_TRIMS[usize::from(pid - 0x55)];
            for (at, name) in [first, second].into_iter().enumerate() {
                fields.push(Field::real(name, byte(at) * TRIM - 100.0, "%"));
            }
        }
        0x64 => {
            for (at, point) in ["idle", "1", "2", "3", "4"].into_iter().enumerate() {
                fields.push(Field::real(format!("torque_{point}"), byte(at) - 125.0, "%"));
            }
        }
        _ => fields.push(Field::bytes("value", bytes)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_parameter_is_there_once() {
        let mut pids: Vec<_> = LINES.iter().map(|line| line.pid).collect();
        pids.extend(GROUPS.iter().map(|group| group.pid));
        pids.extend(NAMED.iter().map(|(pid, _)| *pid));
        let all = pids.len();
        pids.sort_unstable();
        pids.dedup();
        assert_eq!(pids.len(), all);
    }
}
