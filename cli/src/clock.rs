//! What is known of a device's clock, for people and for scripts.

use cantap::device::{ClockReport, ClockSource};
use serde_json::{Value, json};

/// On one line.
pub fn line(report: &ClockReport) -> String {
    let drift =
        report.drift_ppm.map_or("drift not known yet".to_owned(), |ppm| format!("drift {ppm:+.2} ppm"));
    let off = report.uncertainty_ns.map_or("not in real time".to_owned(), |ns| {
        format!("UTC to {} us or better", ns.div_euclid(1000) + 1)
    });
    match report.source {
        ClockSource::Frames => format!("{drift}, {off}, by USB frames and round trips"),
        ClockSource::RoundTrips(doubt) => format!("{drift}, {off}, by round trips alone: {doubt}"),
    }
}

/// As a JSON object.
pub fn object(report: &ClockReport) -> Value {
    let doubt = match report.source {
        ClockSource::Frames => None,
        ClockSource::RoundTrips(doubt) => Some(doubt.to_string()),
    };
    json!({
        "by_usb_frames": report.source == ClockSource::Frames,
        "no_usb_frames_because": doubt,
        "drift_ppm": report.drift_ppm,
        "usb_frames_drift_ppm": report.frames_ppm,
        "uncertainty_us": report.uncertainty_ns.map(|ns| ns as f64 / 1e3),
        "round_trip_us": report.round_trip_ns as f64 / 1e3,
    })
}
