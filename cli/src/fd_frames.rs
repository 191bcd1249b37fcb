//! CAN FD frames to be sent, where the device may send none.

use anyhow::bail;
use cantap::{Device, TraceFrame};

/// Refuses a list with a CAN FD frame that the device cannot send, before anything is opened or sent.
pub fn check<'f>(device: &Device, frames: impl IntoIterator<Item = &'f TraceFrame>) -> anyhow::Result<()> {
    let hello = device.hello();
    let fd = frames.into_iter().find(|frame| frame.is_fd()).filter(|_| !hello.sends_fd());
    if let Some(frame) = fd {
        bail!("'{frame}' is a CAN FD frame: {}; nothing was sent", cantap_adapters::fd_advice(hello));
    }
    Ok(())
}
