//! Records what the emulated core executes while the firmware does everything it can, for a second core to execute again:
//! `lockstep FIRMWARE.elf RECORDING [SECONDS] [SEED]`; then `sim/lockstep/replay.py FIRMWARE.elf RECORDING`. SECONDS are emulated ones of
//! full load on both channels.

use std::error::Error;
use std::fs::File;
use std::io::BufWriter;

use cantap_emu::Machine;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig, timing};
use cantap_sim::{CYCLES_PER_SECOND, firmware};
use cantap_wire::message::{ChannelConfig, Filter, FrameKind, Mode, Periodic, Trigger, TxFrame};
use cantap_wire::{Channel, Command};

const MEGABIT: u32 = 1_000_000;
/// The buses are filled again in turns of this long.
const TURN: u64 = 50 * MS;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [elf, recording, rest @ ..] = arguments.as_slice() else {
        return Err("give FIRMWARE.elf RECORDING [SECONDS] [SEED]".into());
    };
    let seconds: f64 = rest.first().map_or(Ok(2.0), |text| text.parse())?;
    let seed: u64 = rest.get(1).map_or(Ok(1), |text| text.parse())?;
    let image = firmware::open(elf.as_ref())?;
    let setup = board::setup_for(&image);
    let out = BufWriter::new(File::create(recording)?);
    let machine = Machine::with_recording(image, setup, Some(Box::new(out)));
    let mut rig = Rig::on(machine, setup, Timing::hasty(CLOCK));
    rig.connect()?;
    settings(&mut rig)?;
    let until = rig.now() + (seconds * CYCLES_PER_SECOND as f64) as u64;
    for channel in Channel::ALL {
        let source = Traffic::new(Kind::Mix, seed + channel.index() as u64, 100.0, rig.now(), until);
        rig.add_traffic(channel, MEGABIT, source);
    }
    while rig.now() < until {
        listen(&mut rig)?;
        send(&mut rig)?;
    }
    slcan(&mut rig)?;
    rig.with_host(cantap_emu::usb_host::UsbHost::reset);
    rig.run_for(20 * MS)?;
    rig.cut();
    rig.wait_for_port()?;
    rig.greet()?;
    rig.ask(Command::Reset)?;
    rig.run_for(100 * MS)?;
    rig.cut();
    rig.wait_for_port()?;
    rig.greet()?;
    let recording = rig.machine.take_recording().ok_or("there is no recording")?;
    println!("{} steps recorded", recording.steps());
    recording.finish()?;
    Ok(())
}

/// What is saved, loaded, measured and asked for. The sector is filled, and so erased.
fn settings(rig: &mut Rig) -> Result<(), Box<dyn Error>> {
    let filters = (0..14).map(|id| Filter { extended: false, kind: FrameKind::Any, id, mask: 0x7FF });
    for channel in Channel::ALL {
        let config = ChannelConfig::listen_only(timing(MEGABIT)?);
        rig.ask(Command::SetFilters { channel, filters: filters.clone().collect() })?;
        rig.ask(Command::Configure { channel, config })?;
    }
    for _ in 0..120 {
        rig.ask(Command::SaveDefaults)?;
    }
    for channel in Channel::ALL {
        rig.ask(Command::Defaults { channel })?;
        rig.ask(Command::SetFilters { channel, filters: [].into_iter().collect() })?;
        rig.ask(Command::Registers { channel })?;
    }
    rig.ask(Command::ClearDefaults)?;
    rig.ask(Command::Failures)?;
    rig.ask(Command::Identify { seconds: 1 })?;
    Ok(())
}

/// Both channels full, the host stalled for a moment.
fn listen(rig: &mut Rig) -> Result<(), Box<dyn Error>> {
    for channel in Channel::ALL {
        rig.listen(channel, MEGABIT)?;
    }
    rig.run_for(TURN)?;
    rig.status()?;
    rig.with_host(|host, _| host.read(false));
    rig.run_for(TURN)?;
    rig.with_host(|host, _| host.read(true));
    for channel in Channel::ALL {
        rig.close(channel)?;
    }
    Ok(())
}

/// Sending at once, at a time, periodically and in reply.
fn send(rig: &mut Rig) -> Result<(), Box<dyn Error>> {
    let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(MEGABIT)?) };
    for channel in Channel::ALL {
        rig.open(channel, config)?;
        let reply = "004#".parse()?;
        let filter = Filter { extended: false, kind: FrameKind::Any, id: 0, mask: 0 };
        rig.ask(Command::SetTrigger { channel, slot: 0, entry: Some(Trigger { filter, reply, count: 50 }) })?;
        let frame = "005#1122334455667788".parse()?;
        let entry = Periodic { frame, period_ticks: 12_000, count: 0, modifiers: [].into_iter().collect() };
        rig.ask(Command::SetPeriodic { channel, slot: 0, entry: Some(entry) })?;
        let frames = (0..8).map(|tag| TxFrame { tag, frame, at_ticks: None }).collect();
        rig.ask(Command::Send { channel, frames })?;
    }
    rig.run_for(TURN)?;
    for channel in Channel::ALL {
        rig.ask(Command::Abort { channel })?;
        rig.close(channel)?;
    }
    Ok(())
}

/// The other language.
fn slcan(rig: &mut Rig) -> Result<(), Box<dyn Error>> {
    rig.cut();
    rig.with_host(|host, _| host.close_port());
    rig.run_for(20 * MS)?;
    rig.wait_for_port()?;
    for line in
        ["V\r", "N\r", "S8\r", "Z1\r", "O\r", "t1232AABB\r", "T1234567881122334455667788\r", "F\r", "C\r"]
    {
        rig.with_host(|host, _| host.send(line.as_bytes()));
        rig.run_unbooked(5 * MS)?;
    }
    rig.with_host(|host, _| host.close_port());
    rig.run_for(20 * MS)?;
    rig.wait_for_port()?;
    rig.greet()?;
    Ok(())
}
