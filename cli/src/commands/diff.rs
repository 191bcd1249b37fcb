//! `cantap diff`: how two traces differ.

mod protocols;

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use cantap_trace::counted;
use cantap_trace::diff::{Changed, Difference, Key, Profile, compare};
use cantap_trace::filter::Filter;
use serde_json::{Value, json};

use self::protocols::Protocols;
use crate::database_args::DatabaseArgs;
use crate::exit;
use crate::input::ReadArgs;
use crate::protocols::{Known, ProtocolArgs, needs_protocols};
use cantap_work::missing::Missing;

/// The command line.
#[derive(clap::Args)]
#[command(
    mut_args(needs_protocols),
    after_help = "Examples:\n  \
                cantap diff before.log after.log\n  \
                cantap diff good.blf bad.asc --tolerance 25 --json\n  \
                cantap diff monday.log friday.log --protocols --eds drive.eds\n\n\
                Bits are shown from the highest: 0 and 1 never changed in that trace, x did. Exit code: 0, also if the \
                traces differ; with --check 3 if they do."
)]
pub struct Args {
    /// The first trace.
    a: PathBuf,
    /// The second trace.
    b: PathBuf,
    /// Mean periods count as changed if they differ by more than this many percent.
    #[arg(long, value_name = "PERCENT", default_value_t = 10.0, value_parser = percent)]
    tolerance: f64,
    /// Compare identifiers regardless of channel.
    #[arg(long)]
    ignore_channels: bool,
    /// Also compare nodes and objects, by the protocols found in each trace.
    #[arg(long)]
    protocols: bool,
    #[command(flatten)]
    protocol: ProtocolArgs,
    /// End with 3 if the traces differ.
    #[arg(long)]
    check: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    read: ReadArgs,
}

fn percent(text: &str) -> Result<f64, String> {
    let value = text.trim_end_matches('%').parse::<f64>().ok();
    value
        .filter(|value| value.is_finite() && *value >= 0.0)
        .ok_or_else(|| "write a percentage such as 10".to_owned())
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let filters = args.read.filters(&args.databases.load(false, true)?)?;
    let (a, mut missing_a, known_a) = profile(args, &args.a, &filters)?;
    let (b, missing_b, known_b) = profile(args, &args.b, &filters)?;
    let difference = compare(&a, &b, args.tolerance / 100.0);
    let known = known_a.as_ref().zip(known_b.as_ref());
    let protocols = known.map(|(a, b)| Protocols::new([a.overview(), b.overview()], args.ignore_channels));
    let is_none = difference.is_none() && protocols.as_ref().is_none_or(Protocols::is_none);
    let mut out = BufWriter::new(std::io::stdout().lock());
    if args.json {
        let mut object = to_json(&difference);
        let shares = json!([missing_a.share_pct(), missing_b.share_pct()]);
        missing_a.merge(&missing_b);
        missing_a.put_into(&mut object);
        object["missing_pct"] = shares;
        object["equal"] = is_none.into();
        if let Some(protocols) = &protocols {
            object["protocols"] = protocols.object();
        }
        writeln!(out, "{object}")?;
    } else {
        print(args, &difference, &mut out)?;
        if let Some(protocols) = &protocols {
            protocols.print(&[&args.a, &args.b].map(|path| path.display().to_string()), &mut out)?;
        }
    }
    out.flush()?;
    let failed = args.check && !is_none;
    Ok(if failed { ExitCode::from(exit::CHECK_FAILED) } else { ExitCode::SUCCESS })
}

fn profile(
    args: &Args,
    path: &Path,
    filters: &[Filter],
) -> anyhow::Result<(Profile, Missing, Option<Known>)> {
    let mut profile = if args.ignore_channels { Profile::ignoring_channels() } else { Profile::default() };
    let mut records = args.read.open(path, filters.to_vec())?;
    let mut known = args.protocols.then(|| args.protocol.known(false)).transpose()?;
    let mut batch = Vec::new();
    while records.next_batch(&mut batch)? {
        for record in &batch {
            profile.add(record);
        }
        if let Some(known) = &mut known {
            known.take(&batch, true);
        }
    }
    if let Some(known) = &mut known {
        known.take(&[], false);
    }
    Ok((profile, records.missing(), known))
}

fn name(args: &Args, key: Key) -> String {
    let channel = if args.ignore_channels { String::new() } else { format!("channel {}, ", key.channel) };
    format!(
        "{channel}{}{}",
        key.id,
        if key.remote {
            " remote"
        } else if key.fd {
            " FD"
        } else {
            ""
        }
    )
}

fn print(args: &Args, difference: &Difference, out: &mut impl Write) -> std::io::Result<()> {
    for (path, only) in [(&args.a, &difference.only_a), (&args.b, &difference.only_b)] {
        for (key, count) in only {
            writeln!(
                out,
                "{}: only in {} ({count})",
                name(args, *key),
                path.display(),
                count = counted(count, "frame")
            )?;
        }
    }
    for Changed { key, period_ns, dlcs, flags, bytes } in &difference.changed {
        let name = name(args, *key);
        if let Some((a, b)) = period_ns {
            writeln!(out, "{name}: period {:.3} ms -> {:.3} ms", a / 1e6, b / 1e6)?;
        }
        if let Some((a, b)) = dlcs {
            writeln!(out, "{name}: DLC {} -> {}", list(a), list(b))?;
        }
        if let Some((a, b)) = flags {
            writeln!(
                out,
                "{name}: FD flags {} -> {} (1: switched bit rate, 2: error passive sender)",
                list(a),
                list(b)
            )?;
        }
        for byte in bytes {
            let missing = |bits: &str| if bits.is_empty() { "none".to_owned() } else { bits.to_owned() };
            writeln!(out, "{name}: byte {} {} -> {}", byte.byte, missing(&byte.a), missing(&byte.b))?;
        }
    }
    let Difference { only_a, only_b, changed, same } = difference;
    writeln!(
        out,
        "{} only in the first, {} only in the second, {} changed, {same} the same",
        only_a.len(),
        only_b.len(),
        changed.len()
    )
}

fn list(dlcs: &[u8]) -> String {
    dlcs.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

fn to_json(difference: &Difference) -> Value {
    let kind = |key: Key| json!({ "channel": key.channel, "id": key.id.to_string(), "remote": key.remote, "fd": key.fd });
    let only = |only: &[(Key, u64)]| {
        let entries = only.iter().map(|(key, count)| {
            let mut entry = kind(*key);
            entry["count"] = (*count).into();
            entry
        });
        entries.collect::<Vec<_>>()
    };
    let changed = difference.changed.iter().map(|changed| {
        let mut entry = kind(changed.key);
        entry["period_ms"] = changed.period_ns.map_or(Value::Null, |(a, b)| json!([a / 1e6, b / 1e6]));
        entry["dlc"] = changed.dlcs.as_ref().map_or(Value::Null, |(a, b)| json!([a, b]));
        entry["fd_flags"] = changed.flags.as_ref().map_or(Value::Null, |(a, b)| json!([a, b]));
        let bytes = changed.bytes.iter().map(|byte| json!({ "byte": byte.byte, "a": byte.a, "b": byte.b }));
        entry["bytes"] = bytes.collect();
        entry
    });
    json!({
        "only_a": only(&difference.only_a),
        "only_b": only(&difference.only_b),
        "changed": changed.collect::<Vec<_>>(),
        "same": difference.same,
    })
}
