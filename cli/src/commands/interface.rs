//! `cantap interface`: a CAN interface of Linux, shown, or set up. No other command sets one.

use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

use cantap::wire::message::Mode;
use cantap_adapters::{CanInterface, InterfaceSettings};
use cantap_work::channel_options::RecoveryOption;

use crate::channel_args::{ModeArg, recovery};
use crate::timing_args::percent;
use crate::usage_error::usage;
use crate::{args, completion, stderr};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Without options it is shown, which changes nothing. With -b it is taken down, set, and taken up again; if a step fails, what was set \
                before is set again, and an interface that is already so is left alone. It only listens unless --mode says otherwise: then it \
                acknowledges frames on its bus for as long as it is up, whether or not a program listens.\n\n\
                Programs that have it open get an error (network is down) when it is taken down, so if any receive from it, --yes is needed. Those that \
                only send are not seen.\n\n\
                To set an interface takes root's rights, or the capability cap_net_admin.\n\n\
                Examples:\n  \
                cantap interface can0\n  \
                sudo cantap interface can0 -b 500k\n  \
                sudo cantap interface can0 -b 500k --data-bitrate 2M --mode normal\n  \
                sudo cantap interface can0 -b 250k --mode normal --recovery 100ms\n  \
                sudo cantap interface can0 --down"
)]
pub struct Args {
    /// Its name, such as can0; cantap list has those that there are.
    #[arg(value_name = "INTERFACE")]
    name: String,
    /// Set this bit rate, in bit/s: 500000, 500k, 1M.
    #[arg(short, long, value_name = "RATE", value_parser = args::bitrate, add = completion::bit_rates())]
    bitrate: Option<u32>,
    /// How to take part in the bus; listen-only if it is not given.
    #[arg(long, value_enum, requires = "bitrate")]
    mode: Option<ModeArg>,
    /// Sample point in per cent of the bit, instead of the kernel's.
    #[arg(long, value_name = "PCT", value_parser = percent, requires = "bitrate")]
    sample_point: Option<f64>,
    /// Switch CAN FD on, with this bit rate of data phases; without it, CAN FD is off.
    #[arg(long, value_name = "RATE", value_parser = args::bitrate, add = completion::bit_rates(), requires = "bitrate")]
    data_bitrate: Option<u32>,
    /// How to leave bus-off: manual, by --restart; or by the kernel after a time, such as 100ms. Without it, this stays as it is.
    #[arg(long, value_name = "auto|manual|TIME", value_parser = recovery, requires = "bitrate")]
    recovery: Option<RecoveryOption>,
    /// Take it down.
    #[arg(long, conflicts_with_all = ["bitrate", "restart"])]
    down: bool,
    /// Restart its controller after bus-off.
    #[arg(long, conflicts_with = "bitrate")]
    restart: bool,
    /// Confirm that programs that receive from it may be cut off.
    #[arg(short, long)]
    yes: bool,
    /// Print one JSON object: how it is then.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let name = args.name.strip_prefix("socketcan:").unwrap_or(&args.name);
    if let Some(bitrate_bps) = args.bitrate {
        let settings = InterfaceSettings {
            bitrate_bps,
            sample_point_permille: args.sample_point.map(|percent| (percent * 10.0).round() as u32),
            mode: args.mode.map_or(Mode::ListenOnly, Mode::from),
            data_bitrate_bps: args.data_bitrate,
            restart_after: args.recovery.map(restart_after).transpose()?,
        };
        if !cantap_adapters::set_can_interface(name, &settings, args.yes)? {
            stderr::tell(&format!("cantap: {name} was so already; nothing is changed\n"));
        }
    } else if args.down {
        if !cantap_adapters::take_down_can_interface(name, args.yes)? {
            stderr::tell(&format!("cantap: {name} was down already\n"));
        }
    } else if args.restart {
        cantap_adapters::restart_can_interface(name)?;
    }
    let now = cantap_adapters::can_interface(name)?;
    if let (Some(wanted), Some(point)) = (args.sample_point, now.sample_point_permille)
        && (wanted * 10.0 - f64::from(point)).abs() >= 1.0
    {
        let got = f64::from(point) / 10.0;
        stderr::warn(&format!(
            "{name} is sampled at {got} % of the bit, the nearest to {wanted} that the kernel finds"
        ));
    }
    print(&now, args.json)?;
    Ok(ExitCode::SUCCESS)
}

fn restart_after(option: RecoveryOption) -> anyhow::Result<Duration> {
    match option {
        RecoveryOption::Auto => Err(usage(
            "Linux leaves bus-off after a time or not at all: give --recovery 100ms, or --recovery manual"
                .to_owned(),
        )),
        RecoveryOption::Manual => Ok(Duration::ZERO),
        RecoveryOption::After(time) if (1..=u128::from(u32::MAX)).contains(&time.as_millis()) => Ok(time),
        RecoveryOption::After(_) => Err(usage(
            "the kernel takes whole milliseconds from 1ms to 49 days; give --recovery 100ms".to_owned(),
        )),
    }
}

fn print(interface: &CanInterface, json: bool) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    if json {
        return writeln!(out, "{}", object(interface));
    }
    let or_dash = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
    let rate = interface.bitrate_bps.map(|rate| match interface.sample_point_permille {
        Some(point) => format!("{rate} bit/s, sampled at {} %", f64::from(point) / 10.0),
        None => format!("{rate} bit/s"),
    });
    let state = interface.state.map(|state| match interface.counters {
        Some((sent, received)) => format!("{}, error counters {sent} and {received}", state.name()),
        None => state.name().to_owned(),
    });
    let restart = interface.restart_ms.map(|after| match after {
        0 => "manual".to_owned(),
        after => format!("after {after} ms"),
    });
    let receivers =
        if interface.receivers.is_empty() { "nobody".to_owned() } else { interface.receivers.join(", ") };
    writeln!(out, "interface       {}", interface.name)?;
    writeln!(out, "kind            {}", interface.kind)?;
    writeln!(out, "up              {}", if interface.is_up { "yes" } else { "no" })?;
    writeln!(out, "bit rate        {}", or_dash(rate))?;
    let data_rate = interface.data_bitrate_bps.map(|rate| format!("{rate} bit/s"));
    writeln!(out, "data bit rate   {}", or_dash(data_rate))?;
    writeln!(out, "mode            {}", interface.mode.map_or("-", Mode::name))?;
    writeln!(out, "error state     {}", or_dash(state))?;
    writeln!(out, "recovery        {}", or_dash(restart))?;
    writeln!(out, "receivers       {receivers}")
}

/// The same for scripts.
fn object(interface: &CanInterface) -> serde_json::Value {
    serde_json::json!({
        "interface": interface.name,
        "kind": interface.kind,
        "up": interface.is_up,
        "bitrate_bps": interface.bitrate_bps,
        "sample_point_pct": interface.sample_point_permille.map(|point| f64::from(point) / 10.0),
        "data_bitrate_bps": interface.data_bitrate_bps,
        "mode": interface.mode.map(Mode::name),
        "state": interface.state.map(cantap_trace::ErrorState::name),
        "tec": interface.counters.map(|(sent, _)| sent),
        "rec": interface.counters.map(|(_, received)| received),
        "restart_ms": interface.restart_ms,
        "receivers": interface.receivers,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The kernel step sees the values; here there may be no interface.
    #[test]
    fn its_object_has_the_keys_of_the_schema() {
        let schema: serde_json::Value =
            serde_json::from_str(include_str!("../../../docs/json.schema.json")).unwrap();
        let wanted = schema["$defs"]["interface"]["properties"].as_object().unwrap();
        let ours = object(&CanInterface::default());
        let keys =
            |object: &serde_json::Map<String, serde_json::Value>| object.keys().cloned().collect::<Vec<_>>();
        let (mut wanted, mut ours) = (keys(wanted), keys(ours.as_object().unwrap()));
        wanted.sort();
        ours.sort();
        assert_eq!(ours, wanted);
    }

    #[test]
    fn the_kernel_has_no_restart_but_after_a_time() {
        let after = |option| restart_after(option).ok();
        assert_eq!(after(RecoveryOption::Manual), Some(Duration::ZERO));
        assert_eq!(
            after(RecoveryOption::After(Duration::from_millis(100))),
            Some(Duration::from_millis(100))
        );
        assert_eq!(after(RecoveryOption::After(Duration::from_micros(100))), None);
        assert_eq!(after(RecoveryOption::After(Duration::MAX)), None);
        assert_eq!(after(RecoveryOption::Auto), None);
    }
}
