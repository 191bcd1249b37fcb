//! Asks a vehicle for its identification number: `cargo run -p cantap-work --example ask_an_ecu [DEVICE]`.

use std::error::Error;
use std::time::Duration;

use cantap::Channel;
use cantap_protocols::diagnostics::Diagnostics;
use cantap_protocols::iso_tp::Pair;
use cantap_work::bus_off::BusOffRecovery;
use cantap_work::report::Reporter;
use cantap_work::speaking::Speaking;
use cantap_work::uds::{self, Client, TransferOptions};

/// The vehicle identification number by UDS: data identifier F190 of the ECU that is asked by 7E0 and answers by 7E8.
pub fn vin(address: &str) -> Result<String, Box<dyn Error>> {
    let device = cantap_address::open(address)?;
    // From here on the device acknowledges, and sends what it is told to.
    device.join(Channel::Can1, 500_000)?;
    let pair: Pair = "7E0:7E8".parse()?;
    let reader = Diagnostics::new(&[pair.into()], false);
    let recovery = BusOffRecovery::new(None, Reporter::silent());
    let on_event = Box::new(|_: &_| Ok(()));
    let speaking =
        Speaking::new(&device, Channel::Can1, recovery, Box::new(reader), on_event, Reporter::silent());
    let options = TransferOptions::of_obd(pair, Duration::from_millis(150), false);
    let mut client = Client::new(speaking, options, Reporter::silent());
    let answer = uds::first(client.ask(&[0x22, 0xF1, 0x90])?)?;
    client.all_agreed()?;
    drop(client);
    device.stop()?;
    let text = answer.data.get(3..).ok_or("the answer is too short")?;
    Ok(String::from_utf8_lossy(text).into_owned())
}

fn main() -> Result<(), Box<dyn Error>> {
    let address = std::env::args().nth(1).unwrap_or_else(|| "virtual:car".to_owned());
    println!("{}", vin(&address)?);
    Ok(())
}
