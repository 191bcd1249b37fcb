//! Finds the ECUs that answer.

use std::io::Write as _;
use std::time::Duration;

use anyhow::anyhow;
use cantap_protocols::active::server_scan::{FoundServer, Questions, ScanTimes, ServerReply, ServerScan};
use cantap_protocols::diagnostics::{Diagnostics, reason};
use cantap_protocols::iso_tp::{Endpoint, Maker};
use cantap_trace::counted;
use cantap_work::uds::TransferOptions;
use serde_json::{Value, json};

use crate::args;
use crate::speak_args::SpeakArgs;

/// The command line.
#[derive(clap::Args, Clone)]
pub struct ScanArgs {
    /// Also ask by the identifiers of this maker (bmw, vag and so on, as `cantap conversations --help` lists them), or of all.
    #[arg(value_name = "MAKER", value_parser = makers)]
    makers: Vec<Makers>,
}

/// One maker, or all.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Makers(Vec<Maker>);

fn makers(text: &str) -> Result<Makers, String> {
    let all = Maker::all();
    if text.eq_ignore_ascii_case("all") {
        return Ok(Makers(all));
    }
    let maker = all.into_iter().find(|maker| maker.name().eq_ignore_ascii_case(text));
    maker.map(|maker| Makers(vec![maker])).ok_or_else(|| format!("the makers are {}, or all", Maker::names()))
}

/// Listening before the first question: most of what is sent periodically has been there by then.
const LISTEN: Duration = Duration::from_millis(500);
/// Fifty questions a second, of which each is 1 % of a second's bits at 500 kbit/s at most.
const PACE: Duration = Duration::from_millis(20);

/// The addresses to ask, and a description of them.
fn questions(args: &ScanArgs, options: &TransferOptions) -> Questions {
    let mut questions = Questions::standard();
    for maker in args.makers.iter().flat_map(|makers| &makers.0) {
        questions.add_maker(*maker);
    }
    questions.add_pair(options.pair);
    if options.functional {
        questions.only_to_all();
    }
    questions
}

/// Asks, and shows who answered; an error if nobody did.
pub fn run(speak: &SpeakArgs, args: &ScanArgs, options: &TransferOptions) -> anyhow::Result<()> {
    let questions = questions(args, options);
    let times = ScanTimes {
        listen_ns: args::nanoseconds(LISTEN),
        pace_ns: args::nanoseconds(PACE),
        wait_ns: args::nanoseconds(options.p2),
    };
    announce(&questions, times);
    let device = speak.open()?;
    let mut speaking = speak.speak(&device, Box::new(Diagnostics::new(&[], false)));
    let mut scan = ServerScan::new(&questions, times);
    let ran = speaking.run(&mut scan);
    // What was found until Ctrl-C, or until the bus failed, was found.
    show(speak, &questions, &scan)?;
    report(&scan);
    let circumstances = speaking.circumstances();
    let deaf = speaking.judge();
    drop(speaking);
    device.stop()?;
    ran?;
    deaf?;
    if scan.found().next().is_none() {
        return Err(anyhow!(
            "nobody answered; {circumstances}; check the ignition and the bit rate; a gateway may want identifiers of its maker, as `scan vag`"
        ));
    }
    Ok(())
}

fn addresses(count: usize) -> String {
    if count == 1 { "1 address".to_owned() } else { format!("{count} addresses") }
}

/// Says what will be sent, before anything is.
fn announce(questions: &Questions, times: ScanTimes) {
    let all = questions.all();
    let to_all: Vec<_> = all
        .iter()
        .filter(|question| question.servers.is_empty())
        .map(|question| question.request.to_string())
        .collect();
    let seconds = times.longest_ns(questions).div_ceil(1_000_000_000);
    eprintln!(
        "cantap: asks {} 'tester present' (3E 00), which changes no state, in {seconds} s: to all with {}, then one by one; Ctrl-C ends it",
        addresses(all.len()),
        to_all.join(", "),
    );
    if questions.left_out() > 0 {
        eprintln!(
            "cantap: {} of large ranges are not asked; name a pair of them with --pair",
            addresses(questions.left_out())
        );
    }
}

/// What was not asked, and what was heard that is no answer.
fn report(scan: &ServerScan) {
    let list = |endpoints: &[Endpoint]| {
        let names: Vec<_> = endpoints.iter().take(8).map(ToString::to_string).collect();
        let more = if endpoints.len() > names.len() { ", …" } else { "" };
        format!("{}{more}", names.join(", "))
    };
    if !scan.not_asked().is_empty() {
        eprintln!(
            "cantap: {} not asked, because others send with their identifiers: {}",
            addresses(scan.not_asked().len()),
            list(scan.not_asked())
        );
    }
    let unasked: Vec<_> = scan.unasked().collect();
    if !unasked.is_empty() {
        eprintln!(
            "cantap: sent answers that nobody asked for here, as if there was another tester: {}",
            list(&unasked)
        );
    }
    if scan.too_many() > 0 {
        eprintln!("cantap: {} of more senders than are kept", counted(scan.too_many() as usize, "answer"));
    }
}

fn show(speak: &SpeakArgs, questions: &Questions, scan: &ServerScan) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    if speak.json {
        let servers: Vec<_> = scan.found().map(object).collect();
        let names = |endpoints: &mut dyn Iterator<Item = Endpoint>| {
            endpoints.map(|endpoint| endpoint.to_string()).collect::<Vec<_>>()
        };
        let found = json!({
            "channel": speak.channel().number(),
            "addresses": questions.all().len(),
            "servers": servers,
            "not_asked": names(&mut scan.not_asked().iter().copied()),
            "unasked": names(&mut scan.unasked()),
        });
        return writeln!(out, "{found}");
    }
    for found in scan.found() {
        let is_unasked = scan.unasked().any(|server| server == found.server);
        writeln!(out, "{}", line(found, is_unasked))?;
    }
    out.flush()
}

fn object(found: &FoundServer) -> Value {
    let refusal = match found.reply {
        ServerReply::Positive => None,
        ServerReply::Refusal(code) => Some(code),
    };
    json!({
        "request": found.request.map(|request| request.to_string()),
        "answer": found.server.to_string(),
        "functional": found.functional,
        "nrc": refusal,
        "after_ms": found.after_ns as f64 / 1e6,
        "answers": found.answers,
    })
}

fn line(found: &FoundServer, is_unasked: bool) -> String {
    let pair = match found.request {
        Some(request) => format!("--pair {request}:{}", found.server),
        None => format!("{}, which answers only questions to all", found.server),
    };
    let reply = match found.reply {
        ServerReply::Positive => "is there".to_owned(),
        ServerReply::Refusal(code) => format!("is there, refuses: {} ({code:02X})", reason(code)),
    };
    let to_all = if found.functional && found.request.is_some() { ", also to all" } else { "" };
    // One to each question that it may have answered.
    let flood =
        if found.answers > 4 { format!(", {}", counted(found.answers, "answer")) } else { String::new() };
    let unasked = if is_unasked { ", also unasked" } else { "" };
    format!("{pair:<32}  {reply}, after {:.1} ms{to_all}{unasked}{flood}", found.after_ns as f64 / 1e6)
}
