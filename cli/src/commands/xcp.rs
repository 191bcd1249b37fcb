//! `cantap xcp`: measures and calibrates an ECU by XCP, or by its predecessor CCP.

mod measure;
mod rows;
mod targets;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{bail, ensure};
use cantap_protocols::a2l::{A2lDescriptions, Description};
use cantap_protocols::calibration::{ByteOrder, Known, MasterSlave};
use cantap_protocols::ccp::Ccp;
use cantap_protocols::xcp::Xcp;
use cantap_protocols::{Assembler, EventKind};
use cantap_work::calibration::{Master, MasterOptions};
use cantap_work::{a2l, interrupt};

use self::measure::{DaqArgs, PollArgs};
use self::rows::Rows;
use self::targets::Target;
use crate::speak_args::SpeakArgs;
use crate::usage_error::usage;
use crate::{args, key_command, stderr};

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap xcp -d virtual:ecu --pair 7F0:7F1 info\n  \
                cantap xcp -d /dev/ttyACM0 -b 500k --a2l engine.a2l read EngineSpeed Gear\n  \
                cantap xcp -d COM5 -b 500k --pair 7F0:7F1 read 20000000:16\n  \
                cantap xcp -d COM5 -b 500k --a2l engine.a2l write IdleSpeed 850 --yes\n  \
                cantap xcp -d COM5 -b 500k --a2l engine.a2l poll EngineSpeed --every 100ms\n  \
                cantap xcp -d COM5 -b 500k --a2l engine.a2l daq EngineSpeed Gear --csv\n  \
                cantap xcp -d COM5 -b 500k --a2l engine.a2l --protocol ccp read EngineSpeed\n\n\
                It takes part in the bus: it acknowledges, and sends what it is asked for here and nothing else. However \
                it ends, with Ctrl-C too, the ECU's lists are stopped and it is disconnected. A refusal is exit code 1.")]
pub struct Args {
    #[command(flatten)]
    speak: SpeakArgs,
    /// The ECU's description (A2L): the names, addresses and conversions of its values, and its identifiers.
    #[arg(long, value_name = "FILE", global = true)]
    a2l: Option<PathBuf>,
    /// The identifiers of what the master and the ECU send, as 7F0:7F1. Without it, those in --a2l.
    #[arg(long, value_name = "MASTER:SLAVE", global = true)]
    pair: Option<MasterSlave>,
    /// Which protocol to speak.
    #[arg(long, value_enum, default_value = "xcp", global = true)]
    protocol: Spoken,
    /// CCP: the ECU's station address in hexadecimal. Without it, that in --a2l, or 0.
    #[arg(long, value_name = "HEX", value_parser = station, global = true)]
    station: Option<u16>,
    /// CCP: the order of the ECU's bytes. Without it, that in --a2l. XCP's says the ECU.
    #[arg(long, value_enum, global = true)]
    order: Option<Order>,
    /// XCP: fill every frame up to eight bytes (MAX_DLC_REQUIRED).
    #[arg(long, global = true)]
    pad: bool,
    /// How long to wait for each answer (T1 to T6).
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = args::positive_duration, global = true)]
    timeout: Duration,
    /// Maximum time for one command, however often its answer is pending or the ECU busy; also for --key-command.
    #[arg(long, value_name = "TIME", default_value = "30s", value_parser = args::positive_duration, global = true)]
    patience: Duration,
    /// First unlock this resource of the ECU. Requires --key-command. Can be repeated.
    #[arg(long, value_enum, value_name = "RESOURCE", requires = "key_command", global = true)]
    unlock: Vec<Resource>,
    /// A command that computes the key: it gets the seed in hexadecimal on standard input, and in place of {seed}, and prints the key
    /// in hexadecimal.
    #[arg(long, value_name = "COMMAND", global = true)]
    key_command: Option<String>,
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// Show what the ECU says about itself: resources, protection, name, lists, events.
    Info,
    /// Read values.
    Read {
        /// Names in --a2l, or addresses in hexadecimal with the number of bytes: 20000000:4. An address extension comes first: 1/20000000:4.
        #[arg(required = true, value_name = "NAME|ADDRESS:LENGTH")]
        what: Vec<String>,
    },
    /// Write a parameter, read it back and compare; requires --yes.
    Write {
        /// A parameter's name in --a2l, or an address in hexadecimal.
        #[arg(value_name = "NAME|ADDRESS")]
        what: String,
        /// A number in the parameter's unit, or one of its texts; for an address, bytes in hexadecimal.
        #[arg(value_name = "VALUE", allow_hyphen_values = true)]
        value: String,
        /// Confirm writing.
        #[arg(short, long)]
        yes: bool,
    },
    /// Read values again and again, one by one.
    Poll(PollArgs),
    /// Have the ECU send values by itself, with each of its events (a DAQ list).
    Daq(DaqArgs),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Spoken {
    Xcp,
    Ccp,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Order {
    /// The lowest byte first (Intel).
    Little,
    /// The highest byte first (Motorola).
    Big,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Resource {
    /// Writing parameters.
    Calibration,
    /// Lists that the ECU sends.
    Daq,
    /// Stimulation.
    Stim,
    /// Programming.
    Programming,
}

impl Resource {
    /// Its bit. CCP has others, and no stimulation.
    const fn mask(self, is_ccp: bool) -> u8 {
        match (self, is_ccp) {
            (Self::Calibration, _) => 0x01,
            (Self::Daq, false) => 0x04,
            (Self::Daq, true) => 0x02,
            (Self::Stim, _) => 0x08,
            (Self::Programming, false) => 0x10,
            (Self::Programming, true) => 0x40,
        }
    }
}

fn station(text: &str) -> Result<u16, String> {
    let digits = text.trim_start_matches("0x");
    u16::from_str_radix(digits, 16).map_err(|_| "station addresses are hexadecimal, 0 to FFFF".to_owned())
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let paths: Vec<_> = args.a2l.iter().cloned().collect();
    let loaded = a2l::load(&paths, &stderr::reporter())?;
    let description = match loaded.as_deref().map(A2lDescriptions::all) {
        Some([only]) => Some(Arc::clone(only)),
        Some(several) => {
            return Err(usage(format!("there are {} ECUs in --a2l; give a file of one", several.len())));
        }
        None => None,
    };
    let options = args.options(description.as_deref())?;
    // Nothing is sent unless all of it can be.
    let mut targets = args.targets(description.as_deref())?;
    args.check(&targets)?;
    let device = args.speak.open()?;
    // What is read is described whatever identifiers the file has.
    let descriptions = description.clone().map(|one| Arc::new(A2lDescriptions::new(vec![one])));
    let known = |xcp, ccp| Known { xcp, ccp, descriptions: descriptions.clone() };
    let witness: Box<dyn Assembler> = match args.protocol {
        Spoken::Xcp => Box::new(Xcp::new(known(vec![options.parties], Vec::new()))),
        Spoken::Ccp => Box::new(Ccp::new(known(Vec::new(), vec![options.parties]))),
    };
    let mut master = Master::new(args.speak.speak(&device, witness), options);
    let done = args.perform(&mut targets, description.as_deref(), &mut master);
    master.disconnect();
    drop(master);
    device.stop()?;
    done?;
    Ok(ExitCode::SUCCESS)
}

impl Args {
    fn options(&self, description: Option<&Description>) -> anyhow::Result<MasterOptions> {
        let is_ccp = self.protocol == Spoken::Ccp;
        if !is_ccp && (self.station.is_some() || self.order.is_some()) {
            return Err(usage("--station and --order are for --protocol ccp"));
        }
        if is_ccp && self.unlock.contains(&Resource::Stim) {
            return Err(usage("CCP has no stimulation; it unlocks calibration, daq and programming"));
        }
        let described = description.and_then(|one| if is_ccp { one.ccp() } else { one.xcp() });
        let Some(parties) = self.pair.or(described) else {
            let why =
                if self.a2l.is_some() { "--a2l has no identifiers for it" } else { "there is no --a2l" };
            return Err(usage(format!("give the identifiers with --pair, as 7F0:7F1; {why}")));
        };
        let order = self.order.map(|order| match order {
            Order::Little => ByteOrder::Little,
            Order::Big => ByteOrder::Big,
        });
        let order = order.or_else(|| description.and_then(Description::ccp_order));
        let ccp = match (is_ccp, order) {
            (false, _) => None,
            (true, Some(order)) => {
                let station = self.station.or_else(|| description.map(Description::station));
                Some((station.unwrap_or(0), order))
            }
            (true, None) => {
                return Err(usage(
                    "CCP does not say the order of the ECU's bytes; give --order little or big",
                ));
            }
        };
        Ok(MasterOptions {
            parties,
            ccp,
            is_padded: self.pad,
            timeout: self.timeout,
            patience: self.patience,
        })
    }

    fn targets(&self, description: Option<&Description>) -> anyhow::Result<Vec<Target>> {
        let texts = match &self.what {
            What::Info => return Ok(Vec::new()),
            What::Read { what } => what.clone(),
            What::Write { what, value, .. } => return Ok(vec![Target::to_write(what, value, description)?]),
            What::Poll(poll) => poll.what.clone(),
            What::Daq(daq) => daq.what.clone(),
        };
        texts.iter().map(|text| Target::read(text, description)).collect()
    }

    fn check(&self, targets: &[Target]) -> anyhow::Result<()> {
        match &self.what {
            What::Write { yes: false, .. } => {
                Err(usage("writing changes how the ECU works; if that is meant, add --yes"))
            }
            What::Poll(PollArgs { csv: true, .. }) | What::Daq(DaqArgs { csv: true, .. })
                if self.speak.json =>
            {
                Err(usage("--json and --csv are two ways to print; choose one"))
            }
            What::Daq(_) => targets.iter().try_for_each(Target::check_sampled),
            _ => Ok(()),
        }
    }

    fn perform(
        &self,
        targets: &mut [Target],
        description: Option<&Description>,
        master: &mut Master<'_>,
    ) -> anyhow::Result<()> {
        let is_info = matches!(self.what, What::Info);
        let connected = master.connect();
        // What was said is shown when it explains an end, or is what was asked for.
        if is_info || connected.is_err() {
            master.show(|_| true)?;
        }
        connected?;
        if let Err(error) = self.unlock(master) {
            master.show(|event| event.kind != EventKind::Periodic)?;
            return Err(error);
        }
        for target in &mut *targets {
            target.settle(description, master)?;
        }
        match &self.what {
            What::Info => {
                let inquired = master.inquire();
                master.show(|event| event.kind != EventKind::Periodic)?;
                inquired
            }
            What::Read { .. } => {
                let mut rows = Rows::one(self.speak.json);
                for target in targets {
                    let bytes = master.read(target.extension, target.address, target.length)?;
                    rows.write_one(target, &target.fields(&bytes, master.order()))?;
                    let (fixed, stored) = target.axes(description);
                    if !fixed.is_empty() {
                        rows.write_one(target, &fixed.into_iter().map(Some).collect::<Vec<_>>())?;
                    }
                    for mut axis in stored {
                        axis.settle(description, master)?;
                        let bytes = master.read(axis.extension, axis.address, axis.length)?;
                        rows.write_one(&axis, &axis.fields(&bytes, master.order()))?;
                    }
                }
                Ok(())
            }
            What::Write { value, .. } => {
                let [target] = targets else { bail!("one value is written at a time") };
                self.write(target, value, master)
            }
            What::Poll(poll) => poll.run(targets, master, self.speak.json),
            What::Daq(daq) => daq.run(targets, master, self.speak.json),
        }
    }

    fn unlock(&self, master: &mut Master<'_>) -> anyhow::Result<()> {
        let Some(command) = &self.key_command else { return Ok(()) };
        for resource in &self.unlock {
            let seed = master.seed(resource.mask(self.protocol == Spoken::Ccp))?;
            // It is not protected.
            if seed.is_empty() {
                continue;
            }
            let speaking = &mut master.speaking;
            let key = key_command::key(command, &seed, self.patience, |time| speaking.listen(time))?;
            master.unlock(&key)?;
        }
        Ok(())
    }

    fn write(&self, target: &Target, value: &str, master: &mut Master<'_>) -> anyhow::Result<()> {
        let bytes = target.bytes(value, master.order())?;
        let length = bytes.len() as u32;
        let before = master.read(target.extension, target.address, length)?;
        ensure!(!interrupt::requested(), "ended by Ctrl-C; nothing was written");
        master.write(target.extension, target.address, &bytes)?;
        let field = |bytes: &[u8]| target.fields(bytes, master.order());
        Rows::one(self.speak.json).write_change(target, &field(&before), &field(&bytes))
    }
}
