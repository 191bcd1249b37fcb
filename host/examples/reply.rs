//! Has the device answer a frame, within microseconds and without the computer: `cargo run -p cantap --example reply [PORT]`.
//! It takes part in the bus. Both channels must be on one bus: channel 2 asks, channel 1 answers.

mod device;

use std::error::Error;

use cantap::wire::message::{Filter, FrameKind, Trigger, TxFrame};
use cantap::{Channel, Device, Frame, TraceEvent, TraceFrame};

/// Returns the answer as channel 2 received it.
pub fn ask(device: &Device) -> Result<Frame, Box<dyn Error>> {
    device.join(Channel::Can1, 500_000)?;
    device.join(Channel::Can2, 500_000)?;
    let filter = Filter { extended: false, kind: FrameKind::Data, id: 0x7E0, mask: 0x7FF };
    let reply = Trigger { filter, reply: "7E8#0462F19001".parse()?, count: 1 };
    device.set_trigger(Channel::Can1, 0, Some(reply))?;

    let mut records = device.records();
    device.send(Channel::Can2, &[TxFrame { tag: 1, frame: "7E0#0322F190".parse()?, at_ticks: None }])?;
    let mut asked_ns = None;
    loop {
        let record = records.next().ok_or("the device stopped")??;
        let TraceEvent::Frame { frame: TraceFrame::Classic(frame), .. } = record.event else { continue };
        if record.channel != Channel::Can2.number() {
            continue;
        }
        match asked_ns {
            None => asked_ns = Some(record.time_ns),
            Some(asked_ns) => {
                println!("{frame} came {} µs after the question", (record.time_ns - asked_ns) / 1000);
                return Ok(frame);
            }
        }
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    ask(&device::chosen("load=0,bitrate=500k,wire=joined")?)?;
    Ok(())
}
