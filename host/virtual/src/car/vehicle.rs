//! The car's physics: a driver who follows a drive cycle, an engine, a gearbox, wheels, temperatures, a body.
//!
//! Everything moves in steps of 10 ms, so it is the same for every reader at any time. This module knows
//! nothing about frames.

use std::f64::consts::PI;

/// A step, in seconds.
const DT: f64 = 0.01;
/// The same, in nanoseconds.
pub const STEP_NS: u64 = 10_000_000;
/// The drive repeats after this many seconds.
pub const CYCLE_S: f64 = 120.0;
/// The corners of the drive cycle's speed: seconds, km/h.
const DRIVE: [(f64, f64); 14] = [
    (0.0, 0.0),
    (4.0, 0.0),
    (13.0, 50.0),
    (23.0, 50.0),
    (28.0, 28.0),
    (32.0, 28.0),
    (44.0, 92.0),
    (56.0, 100.0),
    (68.0, 58.0),
    (75.0, 58.0),
    (83.0, 0.0),
    (93.0, 0.0),
    (102.0, 42.0),
    (120.0, 0.0),
];
/// Turns: from, to, the steering wheel's angle in degrees (left is positive).
const TURNS: [(f64, f64, f64); 3] = [(27.5, 31.5, -95.0), (68.5, 73.0, 80.0), (112.0, 116.0, -150.0)];

const MASS_KG: f64 = 1500.0;
const WHEEL_RADIUS_M: f64 = 0.31;
const WHEELBASE_M: f64 = 2.7;
const TRACK_M: f64 = 1.5;
const STEERING_RATIO: f64 = 16.0;
const GRAVITY: f64 = 9.81;
/// Gear ratios, including the final drive.
const RATIOS: [f64; 6] = [14.0, 8.2, 5.5, 3.9, 3.1, 2.53];
/// Above this many km/h it shifts to the next gear.
const SHIFT_UP_KMH: [f64; 5] = [18.0, 34.0, 50.0, 68.0, 86.0];
/// It shifts down this many km/h below the speed for shifting up.
const SHIFT_HYSTERESIS_KMH: f64 = 5.0;
const SHIFT_S: f64 = 0.35;
/// Cranking, after the ignition is switched on.
const CRANK_FROM_S: f64 = 0.8;
const CRANK_TO_S: f64 = 1.5;
const CRANK_RPM: f64 = 250.0;
const MAX_TORQUE_NM: f64 = 230.0;
/// Torque of the engine when it is dragged along.
const DRAG_TORQUE_NM: f64 = -25.0;
/// Limit given by crankshaft and tyres: speed cannot jump.
const MAX_RPM_PER_S: f64 = 4000.0;
const MAX_STEERING_DEG_PER_S: f64 = 220.0;
const TANK_L: f64 = 55.0;
/// With this little left, it is refuelled at the next stop.
const RESERVE_L: f64 = 8.0;
const FILLING_L_PER_S: f64 = 0.8;
const AMBIENT_C: f64 = 18.5;
/// The odometer's initial value, in metres.
const ODOMETER_M: f64 = 48_213_470.0;

/// Everything that a sensor could measure, in SI units unless stated otherwise.
#[derive(Clone, Debug)]
pub struct Vehicle {
    steps: u64,
    /// Distinguishes cars: each drives a little faster or slower, with different temperatures.
    character: f64,
    /// m/s.
    pub speed: f64,
    /// m/s².
    pub acceleration: f64,
    /// 0 is neutral.
    pub gear: u8,
    /// The gear that is being shifted to, or [`Self::gear`].
    pub target_gear: u8,
    shift_left_s: f64,
    pub rpm: f64,
    /// At the crankshaft, Nm.
    pub torque: f64,
    /// Per cent.
    pub pedal: f64,
    /// Per cent.
    pub throttle: f64,
    /// bar.
    pub brake_pressure: f64,
    /// °C.
    pub coolant: f64,
    pub oil: f64,
    pub gearbox_oil: f64,
    pub intake: f64,
    pub cabin: f64,
    pub tyres: f64,
    /// l/h.
    pub fuel_rate: f64,
    /// litres.
    pub fuel: f64,
    filling: bool,
    /// metres, since the car was built and since the start.
    pub odometer: f64,
    pub trip: f64,
    /// Steering wheel, degrees and degrees/s.
    pub steering: f64,
    pub steering_rate: f64,
    /// V.
    pub battery: f64,
    /// How far the driver's window is open, in per cent.
    pub window: f64,
    /// degrees.
    pub wiper: f64,
    wiper_phase: f64,
}

/// Moves towards a value with a first-order lag.
fn lag(value: &mut f64, target: f64, seconds: f64) {
    *value += (target - *value) * DT / seconds;
}

/// Moves towards a value by at most this much per second.
fn approach(value: &mut f64, target: f64, per_second: f64) {
    *value += (target - *value).clamp(-per_second * DT, per_second * DT);
}

impl Vehicle {
    /// The ignition has just been switched on, and the engine is cold.
    pub fn new(seed: u64) -> Self {
        let character =
            (seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as f64 / f64::from(1_u32 << 24) - 0.5;
        let ambient = AMBIENT_C + 4.0 * character;
        Self {
            steps: 0,
            character,
            speed: 0.0,
            acceleration: 0.0,
            gear: 0,
            target_gear: 0,
            shift_left_s: 0.0,
            rpm: 0.0,
            torque: 0.0,
            pedal: 0.0,
            throttle: 0.0,
            brake_pressure: 0.0,
            coolant: ambient + 2.0,
            oil: ambient + 2.0,
            gearbox_oil: ambient + 1.0,
            intake: ambient,
            cabin: ambient + 3.0,
            tyres: ambient,
            fuel_rate: 0.0,
            fuel: 41.0 + 10.0 * character,
            filling: false,
            odometer: ODOMETER_M,
            trip: 0.0,
            steering: 0.0,
            steering_rate: 0.0,
            battery: 12.4,
            window: 0.0,
            wiper: 0.0,
            wiper_phase: 0.0,
        }
    }

    /// Lets time pass up to `now_ns` since the start, in whole steps. Returns whether there was one.
    pub fn advance(&mut self, now_ns: u64) -> bool {
        let until = now_ns / STEP_NS;
        let moved = self.steps < until;
        while self.steps < until {
            self.steps += 1;
            self.step();
        }
        moved
    }

    /// Seconds since the ignition was switched on.
    pub fn seconds(&self) -> f64 {
        self.steps as f64 * DT
    }

    /// Seconds into the drive cycle.
    pub fn in_cycle(&self) -> f64 {
        self.seconds() % CYCLE_S
    }

    fn step(&mut self) {
        let demand = self.driver();
        self.engine(demand);
        self.warm_up();
        self.chassis();
        self.body();
    }

    /// The speed that the cycle demands at a time, in m/s.
    fn wanted(&self, in_cycle: f64) -> f64 {
        let corners = DRIVE.windows(2).find(|pair| in_cycle < pair[1].0);
        let kmh = corners.map_or(0.0, |pair| {
            let [(from, low), (to, high)] = [pair[0], pair[1]];
            low + (high - low) * (in_cycle - from) / (to - from)
        });
        kmh / 3.6 * (1.0 + 0.06 * self.character)
    }

    /// Follows the cycle, and returns the acceleration for it.
    fn driver(&mut self) -> f64 {
        let now = self.in_cycle();
        let wanted = self.wanted(now);
        let ahead = self.wanted((now + 0.4).min(CYCLE_S));
        let demand = ((ahead - self.speed) * 1.3).clamp(-4.5, 3.0);
        lag(&mut self.acceleration, demand, 0.25);
        let stands = wanted == 0.0 && self.speed < 0.3;
        if stands {
            // The brake does the last part, gently.
            approach(&mut self.speed, 0.0, 1.0);
            approach(&mut self.acceleration, 0.0, 6.0);
        } else {
            self.speed = (self.speed + self.acceleration * DT).max(0.0);
        }
        self.odometer += self.speed * DT;
        self.trip += self.speed * DT;
        demand
    }

    /// The force that moves the car, in N; negative if something holds it back.
    fn force(&self) -> f64 {
        let air = 0.5 * 1.2 * 0.65 * self.speed * self.speed;
        let rolling = if self.speed > 0.1 { 0.011 * MASS_KG * GRAVITY } else { 0.0 };
        MASS_KG * self.acceleration + air + rolling
    }

    /// Whether the engine runs on its own.
    pub fn runs(&self) -> bool {
        self.seconds() >= CRANK_TO_S
    }

    /// Whether the starter turns it.
    pub fn cranks(&self) -> bool {
        (CRANK_FROM_S..CRANK_TO_S).contains(&self.seconds())
    }

    /// The engine's load, as a percentage of what it could deliver.
    pub fn load(&self) -> f64 {
        let own_needs = if self.runs() { 12.0 } else { 0.0 };
        (self.torque.max(0.0) / MAX_TORQUE_NM * 100.0).max(own_needs)
    }

    /// kPa in the intake.
    pub fn manifold(&self) -> f64 {
        if self.runs() { 28.0 + 0.72 * self.load() } else { 100.0 }
    }

    /// Ignition angle in degrees before top dead centre.
    pub fn ignition(&self) -> f64 {
        if self.runs() { 12.0 + self.rpm / 300.0 - self.load() * 0.12 } else { 0.0 }
    }

    /// Torque as a percentage of the maximum.
    pub fn torque_percent(&self) -> f64 {
        self.torque / MAX_TORQUE_NM * 100.0
    }

    /// Whether a gear is being changed.
    pub fn shifts(&self) -> bool {
        self.shift_left_s > 0.0
    }

    fn choose_gear(&mut self) {
        if self.shift_left_s > 0.0 {
            self.shift_left_s -= DT;
            if self.shift_left_s <= 0.0 {
                self.shift_left_s = 0.0;
                self.gear = self.target_gear;
            }
            return;
        }
        let kmh = self.speed * 3.6;
        let up = |gear: usize| gear < RATIOS.len() && kmh > SHIFT_UP_KMH[gear - 1];
        let down = |gear: usize| gear > 1 && kmh < SHIFT_UP_KMH[gear - 2] - SHIFT_HYSTERESIS_KMH;
        let gear = usize::from(self.gear);
        let in_drive = self.in_drive();
        self.target_gear = match gear {
            0 if in_drive => 1,
            0 => 0,
            _ if !in_drive => 0,
            _ if up(gear) => self.gear + 1,
            _ if down(gear) => self.gear - 1,
            _ => self.gear,
        };
        if self.target_gear != self.gear {
            self.shift_left_s = SHIFT_S;
        }
    }

    /// Whether the selector lever is in Drive.
    pub fn in_drive(&self) -> bool {
        self.seconds() > 3.0
    }

    fn engine(&mut self, demand: f64) {
        self.choose_gear();
        let runs = self.runs();
        let ratio = RATIOS[usize::from(self.target_gear.max(1)) - 1];
        let force = self.force();
        let needed = if self.gear == 0 || !runs { 0.0 } else { force * WHEEL_RADIUS_M / (ratio * 0.92) };
        let torque = if self.shifts() { 0.0 } else { needed.clamp(DRAG_TORQUE_NM, MAX_TORQUE_NM) };
        lag(&mut self.torque, if runs { torque } else { 0.0 }, 0.12);
        let pedal = if force > 0.0 && demand > -0.5 { needed / MAX_TORQUE_NM * 100.0 } else { 0.0 };
        lag(&mut self.pedal, pedal.clamp(0.0, 100.0), 0.15);
        let idle_air = if runs { 3.0 + (90.0 - self.coolant).clamp(0.0, 70.0) * 0.03 } else { 0.0 };
        let throttle = if self.shifts() { idle_air } else { self.pedal.max(idle_air) };
        lag(&mut self.throttle, throttle, 0.1);

        let idle = 780.0 + (90.0 - self.coolant).clamp(0.0, 70.0) * 4.5;
        let turbine = self.turbine_rpm(self.target_gear);
        let slip = if turbine < 1500.0 { self.throttle * 9.0 * (1.0 - turbine / 1500.0) } else { 0.0 };
        let roughness = 6.0 * (self.seconds() * 7.3).sin() + 4.0 * (self.seconds() * 11.9).sin();
        let target = match () {
            () if self.cranks() => CRANK_RPM + 30.0 * (self.seconds() * 40.0).sin(),
            () if !runs => 0.0,
            () => turbine.max(idle) + slip + roughness,
        };
        let wanted = (target - self.rpm) / 0.12;
        self.rpm = (self.rpm + wanted.clamp(-MAX_RPM_PER_S, MAX_RPM_PER_S) * DT).max(0.0);

        let power_kw = self.torque.max(0.0) * self.rpm * PI / 30.0 / 1000.0;
        let cut_off = self.torque < 0.0 && self.rpm > 1400.0;
        let rate = if !runs || cut_off { 0.0 } else { 0.7 * self.rpm / 800.0 + power_kw * 0.28 };
        lag(&mut self.fuel_rate, rate, 0.1);

        let brake = ((-force - 900.0 * f64::from(self.gear.min(1))) / (MASS_KG * GRAVITY) * 110.0).max(0.0);
        let holding = if self.speed < 0.5 && self.wanted(self.in_cycle()) == 0.0 { 14.0 } else { 0.0 };
        lag(&mut self.brake_pressure, brake.max(holding), 0.12);
    }

    /// The gearbox's input speed if the wheels turn it in this gear.
    fn turbine_rpm(&self, gear: u8) -> f64 {
        match gear {
            0 => 0.0,
            gear => self.speed / WHEEL_RADIUS_M * RATIOS[usize::from(gear) - 1] * 30.0 / PI,
        }
    }

    /// The gearbox's input, rpm.
    pub fn turbine(&self) -> f64 {
        if self.gear == 0 { self.rpm * 0.97 } else { self.turbine_rpm(self.gear) }
    }

    fn warm_up(&mut self) {
        let load = self.torque.max(0.0) / MAX_TORQUE_NM;
        if self.runs() {
            lag(&mut self.coolant, 90.0 + 8.0 * load, 75.0);
            lag(&mut self.oil, 94.0 + 20.0 * load, 150.0);
            lag(&mut self.gearbox_oil, 78.0 + 15.0 * load, 240.0);
        }
        let ambient = self.ambient();
        lag(&mut self.intake, ambient + 18.0 / (1.0 + self.speed), 30.0);
        lag(&mut self.cabin, if self.coolant > 50.0 { 21.5 } else { ambient + 4.0 }, 140.0);
        lag(&mut self.tyres, ambient + self.speed * 0.6, 400.0);
        let voltage = if self.runs() { 14.2 - 0.001 * self.wiper } else { 11.9 };
        lag(&mut self.battery, voltage, 0.4);
        let standing = self.speed == 0.0;
        self.filling = standing && (self.filling && self.fuel < TANK_L || self.fuel < RESERVE_L);
        let flow = if self.filling { FILLING_L_PER_S } else { -self.fuel_rate / 3600.0 };
        self.fuel = (self.fuel + flow * DT).clamp(0.0, TANK_L);
    }

    /// °C outside.
    pub fn ambient(&self) -> f64 {
        AMBIENT_C + 4.0 * self.character
    }

    fn chassis(&mut self) {
        let now = self.in_cycle();
        let turn = TURNS.iter().find(|(from, to, _)| (*from..*to).contains(&now));
        let straight = 2.5 * (self.seconds() * 0.7).sin() * (self.speed / 8.0).min(1.0);
        let target = turn.map_or(straight, |(_, _, angle)| *angle);
        let before = self.steering;
        let rate = ((target - self.steering) * 3.0).clamp(-MAX_STEERING_DEG_PER_S, MAX_STEERING_DEG_PER_S);
        self.steering += rate * DT;
        lag(&mut self.steering_rate, (self.steering - before) / DT, 0.05);
    }

    /// Degrees/s, left is positive.
    pub fn yaw_rate(&self) -> f64 {
        (self.speed * (self.steering / STEERING_RATIO).to_radians().tan() / WHEELBASE_M).to_degrees()
    }

    /// m/s², left is positive.
    pub fn lateral(&self) -> f64 {
        self.speed * self.yaw_rate().to_radians()
    }

    /// km/h of a wheel: front left, front right, rear left, rear right.
    pub fn wheel(&self, index: usize) -> f64 {
        let side = if index.is_multiple_of(2) { -0.5 } else { 0.5 };
        let ripple = 1.0 + 0.0015 * (self.trip * 3.1 + index as f64).sin();
        ((self.speed + side * TRACK_M * self.yaw_rate().to_radians()) * ripple).max(0.0) * 3.6
    }

    fn body(&mut self) {
        let target = if (14.0..24.0).contains(&self.in_cycle()) { 60.0 } else { 0.0 };
        approach(&mut self.window, target, 25.0);
        let turning = 2.0 * PI * DT / if self.wipes_fast() { 0.8 } else { 1.3 };
        // The wiper does not stop half-way.
        if self.wipes() || self.wiper_phase > 0.0 {
            self.wiper_phase += turning;
            if self.wiper_phase >= 2.0 * PI {
                self.wiper_phase = if self.wipes() { self.wiper_phase - 2.0 * PI } else { 0.0 };
            }
        }
        self.wiper = 55.0 * (1.0 - self.wiper_phase.cos());
    }

    /// Whether it is raining.
    pub fn wipes(&self) -> bool {
        (50.0..66.0).contains(&self.in_cycle())
    }

    pub fn wipes_fast(&self) -> bool {
        (55.0..60.0).contains(&self.in_cycle())
    }

    /// The driver's door, open before the drive begins and at the long stop.
    pub fn driver_door(&self) -> bool {
        (0.4..2.2).contains(&self.seconds())
    }

    /// The passenger's door: somebody gets in at the long stop, and out at the next.
    pub fn passenger_door(&self) -> bool {
        (85.5..89.0).contains(&self.in_cycle())
    }

    /// Whether somebody sits next to the driver.
    pub fn passenger(&self) -> bool {
        (87.0..CYCLE_S).contains(&self.in_cycle()) || self.seconds() > CYCLE_S && self.in_cycle() < 86.0
    }

    /// Locked while driving.
    pub fn is_locked(&self) -> bool {
        let now = self.in_cycle();
        self.seconds() > 6.0 && !(84.5..94.5).contains(&now)
    }

    pub fn belt(&self) -> bool {
        self.seconds() > 2.8
    }

    pub fn passenger_belt(&self) -> bool {
        self.passenger() && !(84.0..90.5).contains(&self.in_cycle())
    }

    pub fn parking_brake(&self) -> bool {
        self.seconds() < 3.4 || (85.0..92.0).contains(&self.in_cycle())
    }

    /// Whether the lamps on a side are lit at this moment while blinking.
    fn blinks(&self, turns_left: bool) -> bool {
        let soon = |(from, to, angle): &(f64, f64, f64)| {
            (*angle > 0.0) == turns_left && (*from - 3.0..*to - 0.5).contains(&self.in_cycle())
        };
        TURNS.iter().any(soon) && self.seconds() % 0.7 < 0.35
    }

    pub fn left_lamps(&self) -> bool {
        self.blinks(true)
    }

    pub fn right_lamps(&self) -> bool {
        self.blinks(false)
    }

    pub fn low_beam(&self) -> bool {
        self.seconds() > 5.0
    }

    pub fn high_beam(&self) -> bool {
        (46.0..49.5).contains(&self.in_cycle())
    }

    pub fn brake_pedal(&self) -> bool {
        self.brake_pressure > 1.5
    }

    /// The button on the steering wheel that is pressed: 0 is none.
    pub fn button(&self) -> u8 {
        match self.in_cycle() {
            now if (15.0..15.3).contains(&now) || (16.0..16.3).contains(&now) => 1,
            now if (35.0..35.4).contains(&now) => 3,
            now if (53.0..53.5).contains(&now) => 5,
            now if (64.0..64.2).contains(&now) => 2,
            _ => 0,
        }
    }

    /// The button of the key that is pressed: 0 is none.
    pub fn key(&self) -> u8 {
        if (0.1..0.35).contains(&self.seconds()) { 2 } else { 0 }
    }
}
