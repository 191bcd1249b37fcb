//! Adapters as devices, against stand-ins that follow foreign sources.

mod cannelloni;
mod cannelloni_tcp;
#[cfg(unix)]
mod elm327;
mod gvret;
#[cfg(target_os = "linux")]
mod makers;
#[cfg(unix)]
mod port;
#[cfg(unix)]
mod slcan;
mod socketcand;
#[cfg(unix)]
mod trace_pipe;
#[cfg(unix)]
mod usb_can_a;

use cantap::device::Transmission;
use cantap::{Device, TraceEvent, TraceFrame, TraceRecord};

/// A session with the adapter at an address.
fn open(address: &str) -> Device {
    let place = address.parse::<cantap_adapters::Place>().unwrap();
    Device::over(cantap_adapters::open(&place).unwrap(), address).unwrap()
}

/// The frames among records, as texts.
fn frames(records: &[TraceRecord]) -> Vec<String> {
    records.iter().filter_map(|record| Some(record.frame()?.to_string())).collect()
}

/// Records up to the first that fits, included.
fn until(device: &Device, mut fits: impl FnMut(&TraceRecord) -> bool) -> Vec<TraceRecord> {
    let mut all = Vec::new();
    for record in device.records() {
        let record = record.unwrap();
        let is_last = fits(&record);
        all.push(record);
        if is_last {
            break;
        }
    }
    all
}

/// Records up to a frame, given as text.
fn until_frame(device: &Device, text: &str) -> Vec<TraceRecord> {
    until(device, |record| record.frame().is_some_and(|frame| frame.to_string() == text))
}

/// Losses among records: stage and count.
fn losses(records: &[TraceRecord]) -> Vec<(&'static str, u32)> {
    let loss = |record: &TraceRecord| match record.event {
        TraceEvent::Lost { stage: Some(stage), count, .. } => Some((stage.name(), count)),
        _ => None,
    };
    records.iter().filter_map(loss).collect()
}

/// Sends one frame and waits for its end.
fn send(device: &Device, frame: &str) -> Transmission {
    use cantap::wire::message::TxFrame;
    let ends = device.transmissions();
    let frame = frame.parse().unwrap();
    device.send(cantap::Channel::Can1, &[TxFrame { tag: 7, frame, at_ticks: None }]).unwrap();
    ends.recv().unwrap()
}

/// The same with a CAN FD frame.
fn send_fd(device: &Device, frame: &str) -> Transmission {
    use cantap::wire::message::TxFdFrame;
    let ends = device.transmissions();
    let frame: TraceFrame = frame.parse().unwrap();
    let frame = TxFdFrame { tag: 7, frame: *frame.fd().unwrap(), at_ticks: None };
    device.send_fd(cantap::Channel::Can1, &[frame]).unwrap();
    ends.recv().unwrap()
}
