//! What a board can show on its own: its bus controllers by themselves, its queues, its clock, and with both channels wired to each other, its bus.
//!
//! Without a loop no channel puts a dominant bit on its bus, whatever is connected.

mod buses;
mod patience;
mod report;
mod steps;
mod traffic;

use std::time::Duration;

use cantap::{Channel, Device};
use cantap_address::{Address, OpenDevice};

pub use self::patience::Patience;
use self::report::StepOutcome;
pub use self::report::{Report, ReportLines};

/// What to try.
#[derive(Clone, Copy, Debug)]
pub struct TestPlan {
    /// Channel 1 is wired to channel 2 and nothing else: both take part in the bus and send.
    pub has_loop: bool,
    /// How long each saturating load lasts.
    pub load_time: Duration,
    /// Restart the firmware at the end, and wait for it to come back.
    pub restarts: bool,
}

/// Bit rates at which frames are sent.
const BITRATES_BPS: [u32; 4] = [1_000_000, 500_000, 250_000, 125_000];

/// Tries everything; the results are in the report. Channels that are open are closed.
pub fn run(plan: TestPlan, address: &Address, device: OpenDevice, report: &mut Report) {
    test(plan, address, &device, report);
    restart(plan, address, device, report);
    report.finish();
}

/// All steps except the restart.
fn test(plan: TestPlan, address: &Address, device: &Device, report: &mut Report) {
    // If something is wrong with it, that shows when it is read again.
    let saved = steps::saved(device).unwrap_or_default();
    report.step("identity", |_| Ok(steps::identity(device.hello())));
    report.step("USB", |_| steps::usb(address, device.hello()));
    report.step("round trips", |patience| steps::round_trips(patience, device));
    for channel in Channel::ALL {
        report.step(&format!("channel {} listens", channel.number()), |patience| {
            buses::listen(patience, device, channel)
        });
    }
    for channel in Channel::ALL {
        for bitrate_bps in BITRATES_BPS {
            let name = format!("channel {} by itself, {bitrate_bps} bit/s", channel.number());
            report.step(&name, |patience| buses::alone(patience, device, channel, bitrate_bps));
        }
    }
    for channel in Channel::ALL {
        let name = format!("channel {} transmit queue", channel.number());
        report.step(&name, |patience| buses::fill_queue(patience, device, channel));
    }
    report.step("both channels saturated, each by itself", |patience| {
        buses::saturate(patience, device, false, plan.load_time)
    });
    if plan.has_loop {
        for bitrate_bps in BITRATES_BPS {
            report.step(&format!("channel 1 to channel 2 and back, {bitrate_bps} bit/s"), |patience| {
                buses::cross(patience, device, bitrate_bps)
            });
        }
        for sender in Channel::ALL {
            let name = format!("channel {} without an acknowledgement", sender.number());
            report.step(&name, |patience| buses::unacknowledged(patience, device, sender));
        }
        report.step("both channels saturate one bus", |patience| {
            buses::saturate(patience, device, true, plan.load_time)
        });
    } else {
        report.step("channel 1 to channel 2", |_| {
            Ok(StepOutcome::Skip("they are not said to be wired to each other (--loop)".to_owned()))
        });
    }
    report.step("clock", |patience| steps::clock(patience, address, device));
    report.step("saved settings untouched", |_| {
        let now = steps::saved(device)?;
        Ok(steps::compare_saved(&saved, &now))
    });
}

fn restart(plan: TestPlan, address: &Address, device: OpenDevice, report: &mut Report) {
    report.step("restart", move |patience| match (plan.restarts, address.may_come_back()) {
        (false, _) => Ok(StepOutcome::Skip("it was not asked for (--restart)".to_owned())),
        (true, true) => steps::restart(patience, address, device),
        (true, false) => {
            Ok(StepOutcome::Skip("this device lives in this process, and would end with it".to_owned()))
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_virtual::{Options, start};

    /// How often each channel put a dominant level on its bus.
    fn driven(has_loop: bool, options: &str) -> [u64; 2] {
        let plan = TestPlan { has_loop, load_time: Duration::from_millis(100), restarts: false };
        let connection = start(options.parse::<Options>().unwrap()).unwrap();
        let witness = std::sync::Arc::clone(&connection.witness);
        let device = Device::over(connection.into_link(), "virtual").unwrap();
        let address = "virtual".parse().unwrap();
        test(
            plan,
            &address,
            &device,
            &mut Report::new(&address, &device, ReportLines::Kept, Patience::endless()),
        );
        witness.activity().driven
    }

    #[test]
    fn nothing_is_driven_unless_a_loop_is_asked_for() {
        assert_eq!(driven(false, "load=20"), [0, 0]);
        let [first, second] = driven(true, "load=0,wire=joined,ack=no");
        assert!(first > 500 && second > 500, "{first}, {second}");
    }

    /// A step that is under way ends, and has no outcome; nothing has failed.
    #[test]
    fn whoever_waits_no_longer_gets_what_was_tried_so_far() {
        let connection = start("load=0".parse::<Options>().unwrap()).unwrap();
        let device = Device::over(connection.into_link(), "virtual").unwrap();
        let address = "virtual".parse().unwrap();
        let asked = std::sync::atomic::AtomicU32::new(0);
        let patience = Patience::until(move || asked.fetch_add(1, std::sync::atomic::Ordering::Relaxed) > 40);
        let mut report = Report::new(&address, &device, ReportLines::Kept, patience);
        let plan = TestPlan { has_loop: false, load_time: Duration::from_mins(1), restarts: false };
        test(plan, &address, &device, &mut report);
        report.finish();
        assert!(report.was_cut_short() && !report.has_passed());
    }
}
