//! The value of each of the database's signals, from the car's state.

use super::vehicle::Vehicle;

/// What a message needs besides the car itself.
#[derive(Clone, Copy, Debug, Default)]
pub struct Context {
    /// How often the message has been sent.
    pub sent: u32,
    /// Which of several parts this is: a cylinder, a packet of a long message.
    pub part: u8,
    /// Whether the engine's ECU has a trouble code.
    pub faulty: bool,
}

/// The car's identification number: fictitious, with a correct check digit.
pub const VIN: &[u8; 17] = b"WCTCANTA4P0000001";
/// Length of the identification as J1939 sends it, ending with an asterisk.
const J1939_VIN_BYTES: usize = VIN.len() + 1;
/// Number of packets of seven bytes.
pub const J1939_VIN_PACKETS: u8 = J1939_VIN_BYTES.div_ceil(7) as u8;
/// Vehicle identification.
const J1939_VIN_PGN: u32 = 65_260;
/// The trouble code P0128 in J1939: SPN 110, coolant temperature, FMI 17, below normal.
const J1939_FAULT: (f64, f64) = (110.0, 17.0);
/// The clock at the start: 2026-06-01, 8:00:00.
const CLOCK_START_S: u64 = 8 * 3600;
const DAY_S: u64 = 24 * 3600;
/// Days in the months from June 2026 on, for a year.
const MONTHS: [(u64, u64, u64); 12] = [
    (6, 30, 2026),
    (7, 31, 2026),
    (8, 31, 2026),
    (9, 30, 2026),
    (10, 31, 2026),
    (11, 30, 2026),
    (12, 31, 2026),
    (1, 31, 2027),
    (2, 28, 2027),
    (3, 31, 2027),
    (4, 30, 2027),
    (5, 31, 2027),
];

/// A signal's physical value; `None` if there is no such signal. Counters count transmissions; checksums are added
/// later.
pub fn value(signal: &str, car: &Vehicle, context: Context) -> Option<f64> {
    let flag = |on: bool| f64::from(u8::from(on));
    let kmh = car.speed * 3.6;
    let (load, ignition) = (car.load(), car.ignition());
    let oil_pressure = if car.rpm < 100.0 { 0.0 } else { (90.0 + car.rpm * 0.11 - car.oil * 0.5).max(60.0) };
    let injection = if car.fuel_rate > 0.0 { 0.6 + load * 0.12 } else { 0.0 };
    let moving = car.speed > 0.3;
    Some(match signal {
        "EngineSpeed" | "GwEngineSpeed" | "J1939EngineSpeed" => car.rpm,
        "EngineTorque" => car.torque,
        "ThrottlePosition" | "J1939Throttle" => car.throttle,
        "EngineState" if car.runs() => 2.0,
        "EngineState" => flag(car.cranks()),
        "AcceleratorPedal" | "J1939AcceleratorPedal" | "J1939DriverDemandTorque" => car.pedal,
        "EngineLoad" | "J1939EngineLoad" => load,
        "ManifoldPressure" => car.manifold(),
        "FuelRate" | "J1939FuelRate" => car.fuel_rate,
        "IgnitionAngle" => ignition,
        "CoolantTemperature" | "GwCoolantTemperature" | "J1939CoolantTemperature" => car.coolant,
        "OilTemperature" | "J1939OilTemperature" => car.oil,
        "IntakeAirTemperature" => car.intake,
        "AmbientTemperature" | "J1939AmbientTemperature" => car.ambient(),
        "J1939FuelTemperature" => car.ambient() + 3.0,
        "OilPressure" | "J1939OilPressure" => oil_pressure,
        "BatteryVoltage" | "BodyVoltage" => car.battery,
        "FuelLevel" => car.fuel,
        "FuelConsumption" => {
            if kmh > 5.0 {
                car.fuel_rate / kmh * 100.0
            } else {
                0.0
            }
        }
        "Range" => car.fuel / 0.068,
        "CylinderPage" => f64::from(context.part),
        "SelectorLever" => {
            if car.in_drive() {
                3.0
            } else {
                0.0
            }
        }
        "ShiftActive" => flag(car.shifts()),
        "CurrentGear" | "GwGear" | "DisplayedGear" => f64::from(car.gear),
        "TargetGear" => f64::from(car.target_gear),
        "TurbineSpeed" => car.turbine(),
        "TransmissionOilTemperature" => car.gearbox_oil,
        "WheelSpeedFL" => car.wheel(0),
        "WheelSpeedFR" => car.wheel(1),
        "WheelSpeedRL" => car.wheel(2),
        "WheelSpeedRR" => car.wheel(3),
        "VehicleSpeed" | "GwVehicleSpeed" | "J1939WheelSpeed" => kmh,
        // As the law requires, it is never below the actual speed.
        "DisplayedSpeed" => {
            if moving {
                kmh * 1.02 + 1.0
            } else {
                0.0
            }
        }
        "BrakePressure" => car.brake_pressure,
        "BrakePedal" | "BrakeLight" | "J1939BrakeSwitch" => flag(car.brake_pedal()),
        "ParkingBrake" | "GwParkingBrake" | "J1939ParkingBrake" => flag(car.parking_brake()),
        "LongitudinalAcceleration" => car.acceleration,
        "LateralAcceleration" => car.lateral(),
        "YawRate" => car.yaw_rate(),
        "SteeringAngle" => car.steering,
        "SteeringRate" => car.steering_rate,
        "BeltDriver" => flag(car.belt()),
        "BeltPassenger" => flag(car.passenger_belt()),
        "PassengerPresent" => flag(car.passenger()),
        "AirbagState" => 1.0,
        "MalfunctionLamp" | "J1939MalfunctionLamp" | "J1939Occurrences" => flag(context.faulty),
        "OilLamp" => flag(oil_pressure < 60.0),
        "BeltLamp" => flag(!car.belt() || car.passenger() && !car.passenger_belt()),
        "FuelLamp" => flag(car.fuel < 8.0),
        "Odometer" | "J1939TotalDistance" => car.odometer / 1000.0,
        "TripDistance" | "J1939TripDistance" => car.trip / 1000.0,
        "Button" => f64::from(car.button()),
        "ButtonPressed" => flag(car.button() != 0),
        "J1939TorqueMode" => {
            if car.pedal > 1.0 {
                1.0
            } else {
                0.0
            }
        }
        "J1939ActualTorque" => car.torque_percent(),
        "J1939FuelEconomy" => (kmh / car.fuel_rate.max(0.5)).min(125.0),
        "J1939Barometer" => 101.0,
        "J1939Spn" => {
            if context.faulty {
                J1939_FAULT.0
            } else {
                0.0
            }
        }
        "J1939Fmi" => {
            if context.faulty {
                J1939_FAULT.1
            } else {
                0.0
            }
        }
        // BAM, the broadcast of SAE J1939-21.
        "J1939TpControl" => 32.0,
        "J1939TpBytes" => J1939_VIN_BYTES as f64,
        "J1939TpPackets" => f64::from(J1939_VIN_PACKETS),
        "J1939TpPgn" => f64::from(J1939_VIN_PGN),
        "J1939TpNumber" => f64::from(context.part) + 1.0,
        "DoorFL" => flag(car.driver_door()),
        "DoorFR" => flag(car.passenger_door()),
        "Locked" => flag(car.is_locked()),
        "LowBeam" => flag(car.low_beam()),
        "HighBeam" => flag(car.high_beam()),
        "TurnLeft" => flag(car.left_lamps()),
        "TurnRight" => flag(car.right_lamps()),
        "DashBrightness" => {
            if car.low_beam() {
                60.0
            } else {
                100.0
            }
        }
        "WindowFL" => car.window,
        "WiperMode" => {
            if car.wipes_fast() {
                3.0
            } else {
                2.0 * flag(car.wipes())
            }
        }
        "WiperAngle" => car.wiper,
        "RainIntensity" => {
            if car.wipes_fast() {
                70.0
            } else {
                30.0 * flag(car.wipes())
            }
        }
        "WasherLevel" => 80.0,
        "Ignition" => {
            if car.cranks() {
                3.0
            } else {
                2.0
            }
        }
        "BatteryCurrent" if car.cranks() => -140.0,
        "BatteryCurrent" => (car.battery - 12.8) * 9.0,
        "CabinTemperature" => car.cabin,
        "SetTemperature" => 21.5,
        "FanSpeed" => {
            if car.coolant > 50.0 {
                5.0
            } else {
                2.0
            }
        }
        "Compressor" => flag(car.cabin > 23.0),
        "EvaporatorTemperature" => car.cabin - 6.0,
        "TyrePressureFL" | "TyrePressureFR" => 230.0 + (car.tyres - 20.0) * 0.8,
        "TyrePressureRL" | "TyrePressureRR" => 240.0 + (car.tyres - 20.0) * 0.8,
        "Hour" => (clock(car) % DAY_S / 3600) as f64,
        "Minute" => (clock(car) % 3600 / 60) as f64,
        "Second" => (clock(car) % 60) as f64,
        "Day" => date(car).0,
        "Month" => date(car).1,
        "Year" => date(car).2,
        "KeyButton" => f64::from(car.key()),
        "KeyBattery" => 88.0,
        "AbsActive"
        | "EspActive"
        | "CrashDetected"
        | "DoorRL"
        | "DoorRR"
        | "Trunk"
        | "Hood"
        | "Hazard"
        | "ReverseLight"
        | "RearFog"
        | "J1939SpnHigh"
        | "J1939SourceAddress"
        | "J1939ConversionMethod"
        | "WindowFR"
        | "WindowRL"
        | "WindowRR"
        | "Sunroof" => 0.0,
        _ if signal.starts_with("TyreTemperature") => car.tyres,
        _ if signal.starts_with("J1939TpByte") => f64::from(vin_byte(signal, context.part)),
        _ if signal.ends_with("Counter") => f64::from(context.sent % 16),
        _ if signal.ends_with("Injection") => injection + 0.01 * f64::from(context.part),
        _ if signal.ends_with("Ignition") => ignition + 0.5 * f64::from(context.part),
        _ if signal.ends_with("Knock") => 0.2 + load * 0.004 + car.rpm * 1e-4,
        _ => return None,
    })
}

/// A byte of the identification in the packet with that number.
fn vin_byte(signal: &str, packet: u8) -> u8 {
    let place = signal.bytes().last().map_or(0, |digit| usize::from(digit - b'1'));
    let at = usize::from(packet) * 7 + place;
    match at.cmp(&VIN.len()) {
        std::cmp::Ordering::Less => VIN[at],
        std::cmp::Ordering::Equal => b'*',
        std::cmp::Ordering::Greater => 0xFF,
    }
}

fn clock(car: &Vehicle) -> u64 {
    CLOCK_START_S + car.seconds() as u64
}

/// Day, month, year. The calendar repeats after a year.
fn date(car: &Vehicle) -> (f64, f64, f64) {
    let mut day = clock(car) / DAY_S % 365;
    for (month, days, year) in MONTHS {
        if day < days {
            return (day as f64 + 1.0, month as f64, year as f64);
        }
        day -= days;
    }
    (1.0, 6.0, 2026.0)
}
