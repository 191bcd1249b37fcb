//! `cantap obd`: queries a vehicle.

use std::collections::BTreeSet;
use std::io::{IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context as _, bail};
use cantap_protocols::diagnostics::{Diagnostics, parameter_name};
use cantap_protocols::{Event, Value};

use crate::keyboard::Keyboard;
use crate::speak_args::SpeakArgs;
use crate::usage_error::usage;
use crate::{args, stderr};
use cantap_trace::counted;
use cantap_work::code_texts::CodeTexts;
use cantap_work::interrupt;
use cantap_work::obd::{Table, Vehicle, is_answer};
use cantap_work::uds::Client;

/// How often keys are looked for, and how many of them.
const LOOK_FOR_KEYS: Duration = Duration::from_millis(100);
const KEYS: usize = 64;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap obd -d virtual:car\n  \
                cantap obd -d virtual:car live 0C 0D --period 500ms\n  \
                cantap obd -d virtual:car watch 0C 0D 05\n  \
                cantap obd -d /dev/ttyACM0 -b 500k codes\n  \
                cantap obd -d COM5 -b 500k clear --yes\n\n\
                Without a command: a table of the VIN, the trouble codes, and every value once. What watch writes to a file \
                or a pipe is lines, as of live. All ECUs are asked at once (7DF), and \
                where none answers, with identifiers of 29 bits (18DB33F1); if still none does, both again over UDS \
                (SAE J1979-2). It takes part in the bus: it acknowledges, \
                and sends what it is asked for here and nothing else.")]
pub struct Args {
    #[command(flatten)]
    speak: SpeakArgs,
    /// How long to wait for the beginning of an answer, and for all ECUs to answer as long as their number is unknown. ISO 15765-4 has 50 ms; gateways
    /// add to that.
    #[arg(long, value_name = "TIME", default_value = "200ms", value_parser = args::positive_duration, global = true)]
    p2: Duration,
    /// A table of the texts of trouble codes, which are listed after the codes: a line is P0133,"its text".
    #[arg(long, value_name = "FILE", global = true, value_hint = clap::ValueHint::FilePath)]
    dtc: Option<PathBuf>,
    #[command(subcommand)]
    what: Option<What>,
}

/// Which values are asked for, and how often.
#[derive(clap::Args)]
struct Polling {
    /// Parameters in hexadecimal, as 0C; default: all that are supported.
    #[arg(value_name = "PID", value_parser = pid)]
    pids: Vec<u8>,
    /// How often.
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = args::positive_duration)]
    period: Duration,
    /// How many times.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    count: Option<u32>,
}

#[derive(clap::Subcommand)]
enum What {
    /// List the parameters of each ECU.
    Supported,
    /// Current values, until Ctrl-C.
    Live {
        #[command(flatten)]
        polling: Polling,
    },
    /// Current values in a table on the terminal, with the least and the most so far, until q or Ctrl-C.
    Watch {
        #[command(flatten)]
        polling: Polling,
    },
    /// Trouble codes: stored, pending and permanent.
    Codes,
    /// The vehicle's identification number, and the names of its ECUs.
    Vin,
    /// Erase the trouble codes and the data stored with them; requires --yes.
    Clear {
        /// Confirm erasing.
        #[arg(short, long)]
        yes: bool,
    },
}

fn pid(text: &str) -> Result<u8, String> {
    u8::from_str_radix(text.trim_start_matches("0x"), 16)
        .map_err(|_| "write a parameter as two hexadecimal digits, as 0C".to_owned())
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if matches!(args.what, Some(What::Clear { yes: false })) {
        return Err(usage(
            "clearing erases what the workshop needs to find the fault, and readiness tests start over; to go ahead, add --yes",
        ));
    }
    if args.dtc.is_some() && args.speak.json {
        return Err(usage("--json has no lines for the texts of --dtc; leave one of them out"));
    }
    if args.dtc.is_some() && !matches!(args.what, None | Some(What::Codes)) {
        return Err(usage(
            "--dtc has the texts of trouble codes, and this asks for none; cantap obd codes does, and cantap obd without a command",
        ));
    }
    let texts = args.dtc.as_deref().map(code_texts).transpose()?;
    let device = args.speak.open()?;
    let speaking = args.speak.speak(&device, Box::new(Diagnostics::new(&[], false)));
    let vehicle = Vehicle::new(args.p2);
    let client = Client::new(speaking, vehicle.transfer(), stderr::reporter());
    let mut asker = Asker { client, vehicle, texts, table: None, keyboard: None };
    asker.find()?;
    match &args.what {
        None => asker.everything(args.speak.json)?,
        Some(What::Supported) => {
            asker.lists()?;
            asker.client.show_if(|event| args.speak.json && is_answer(event))?;
            if !args.speak.json {
                asker.show_lists()?;
            }
        }
        Some(What::Live { polling }) => asker.live(polling, &mut |_| Ok(()))?,
        Some(What::Watch { polling }) => asker.watch(polling, args.speak.json)?,
        Some(What::Codes) => asker.codes()?,
        Some(What::Vin) => asker.identification()?,
        Some(What::Clear { .. }) => {
            let request = asker.vehicle.services().clear();
            // What was said to find the ECUs.
            asker.client.speaking.take_events();
            let answers = asker.client.ask_whoever(request, None)?;
            asker.client.show_if(is_answer)?;
            asker.client.all_agreed()?;
            if answers.is_empty() {
                bail!(
                    "no ECU said that it has erased its codes; some want the engine off and the ignition on"
                );
            }
        }
    }
    drop(asker);
    device.stop()?;
    Ok(ExitCode::SUCCESS)
}

fn code_texts(path: &Path) -> anyhow::Result<CodeTexts> {
    let table = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    CodeTexts::read(&table).with_context(|| format!("cannot use {}", path.display()))
}

/// The trouble codes in an event: the names before each one's status.
fn codes_of(event: &Event) -> impl Iterator<Item = String> + '_ {
    let lists = event.fields.iter().filter(|field| field.name == "codes");
    let lists = lists.filter_map(|field| match &field.value {
        Value::Text(text) => Some(text.split(", ")),
        _ => None,
    });
    let names = lists.flatten().filter_map(|code| code.split(' ').next());
    // A list of none is an empty text.
    names.filter(|name| !name.is_empty()).map(str::to_owned)
}

/// The columns and rows of the terminal.
fn screen() -> (usize, usize) {
    let size = terminal_size::terminal_size();
    size.map_or((100, usize::MAX), |(columns, rows)| (usize::from(columns.0), usize::from(rows.0)))
}

struct Asker<'d> {
    client: Client<'d>,
    vehicle: Vehicle,
    /// What trouble codes mean, if the user has a table.
    texts: Option<CodeTexts>,
    /// Takes the answers, if they are not printed one by one.
    table: Option<Table>,
    /// Where the table is left by a key.
    keyboard: Option<Keyboard>,
}

impl Asker<'_> {
    /// Finds out which ECUs answer.
    fn find(&mut self) -> anyhow::Result<()> {
        while let Some(request) = self.vehicle.search() {
            self.client.set_transfer(self.vehicle.transfer());
            self.vehicle.take_search(&self.client.ask_unknown(&request)?);
        }
        let servers = self.vehicle.servers();
        if servers.is_empty() {
            bail!(
                "no ECU answers, neither to 7DF nor to 18DB33F1, by OBD-II's own services or over UDS; {}; check that the ignition is on, and the bit rate: vehicles have 500k \
                 or 250k; --p2 waits longer",
                self.client.speaking.circumstances()
            );
        }
        self.client.set_servers(servers);
        Ok(())
    }

    /// Reads the lists after the first one, as far as they go.
    fn lists(&mut self) -> anyhow::Result<()> {
        while let Some((request, servers)) = self.vehicle.list() {
            self.vehicle.take_list(&self.client.ask_whoever(&request, Some(servers))?);
        }
        Ok(())
    }

    fn show_lists(&self) -> anyhow::Result<()> {
        let mut out = std::io::stdout().lock();
        for (pid, servers) in self.vehicle.parameters() {
            let name = parameter_name(pid).unwrap_or("(no name known)");
            let servers: Vec<_> = servers.iter().map(ToString::to_string).collect();
            writeln!(out, "{pid:02X}  {name:<40}  {}", servers.join(", "))?;
        }
        Ok(())
    }

    /// Prints the wanted events of what was asked here, or puts them into the table.
    fn show(&mut self, mut is_wanted: impl FnMut(&Event) -> bool) -> std::io::Result<()> {
        let Some(table) = &mut self.table else { return self.client.show_if(is_wanted) };
        let options = self.vehicle.transfer();
        let events = self.client.speaking.take_events();
        events
            .iter()
            .filter(|event| options.is_ours(event) && is_wanted(event))
            .for_each(|event| table.take(event));
        Ok(())
    }

    /// Shows values in a table that stays where it is on a terminal. Elsewhere, and for scripts, answers are lines as in [`Self::live`].
    fn watch(&mut self, polling: &Polling, is_json: bool) -> anyhow::Result<()> {
        self.table = (!is_json && std::io::stdout().is_terminal()).then(Table::default);
        self.keyboard = self.table.as_ref().and_then(|_| Keyboard::open());
        let mut shown = 0;
        self.live(polling, &mut |table| {
            let (columns, rows) = screen();
            // What has left the top of the screen could not be drawn over, and the cursor takes a line.
            let lines = table.lines(true, (columns, rows.saturating_sub(1)));
            let mut out = std::io::stdout().lock();
            if shown > 0 {
                // To the first line of the table before this one, which is erased.
                write!(out, "\x1b[{shown}F\x1b[J")?;
            }
            shown = lines.len();
            writeln!(out, "{}", lines.join("\n"))?;
            out.flush()
        })
    }

    /// Shows values, each as soon as it is there; `round` is called after each round with the table, if there is one.
    fn live(
        &mut self,
        polling: &Polling,
        round: &mut dyn FnMut(&Table) -> std::io::Result<()>,
    ) -> anyhow::Result<()> {
        self.lists()?;
        self.client.speaking.take_events();
        let Polling { pids: wanted, period, count } = polling;
        let pids = if wanted.is_empty() { self.all_pids() } else { wanted.clone() };
        if let Some(pid) = pids.iter().find(|pid| self.vehicle.having(**pid) == 0) {
            bail!("no ECU has the parameter {pid:02X}; `cantap obd supported` shows those that there are");
        }
        let started = Instant::now();
        let mut rounds = 0;
        let mut silent = pids.clone();
        while count.is_none_or(|count| rounds < count) && !interrupt::requested() {
            if let Some(table) = &mut self.table {
                table.begin_round();
            }
            let answered = self.values(&pids)?;
            silent.retain(|pid| !answered.contains(pid));
            // After Ctrl-C, what was not asked any more would look as if it had not been answered.
            if let Some(table) =
                self.table.as_ref().filter(|table| !table.is_empty() && !interrupt::requested())
            {
                round(table)?;
            }
            rounds += 1;
            if count.is_none_or(|count| rounds < count)
                && self.is_left_by((*period * rounds).saturating_sub(started.elapsed()))?
            {
                break;
            }
        }
        // Before the end of the first round, Ctrl-C is why.
        if rounds > 0 && !silent.is_empty() && !(rounds == 1 && interrupt::requested()) {
            let silent: Vec<_> = silent.iter().map(|pid| format!("{pid:02X}")).collect();
            bail!("no ECU has ever answered {}; {}", silent.join(", "), self.client.speaking.circumstances());
        }
        Ok(())
    }

    /// Listens for this long; returns whether the user wants no more.
    fn is_left_by(&mut self, mut left: Duration) -> anyhow::Result<bool> {
        loop {
            let now = if self.keyboard.is_some() { left.min(LOOK_FOR_KEYS) } else { left };
            self.client.speaking.listen(now)?;
            left -= now;
            let keys = std::iter::from_fn(|| self.keyboard.as_mut()?.next());
            if interrupt::requested() || keys.take(KEYS).any(|key| key == 'q') {
                return Ok(true);
            }
            if left.is_zero() {
                return Ok(false);
            }
        }
    }

    fn all_pids(&self) -> Vec<u8> {
        self.vehicle.parameters().into_keys().collect()
    }

    /// Shows values, and returns those parameters for which there was an answer.
    fn values(&mut self, pids: &[u8]) -> anyhow::Result<Vec<u8>> {
        let mut answered = Vec::new();
        for pid in pids {
            let servers = self.vehicle.having(*pid);
            let asked = self.client.ask_whoever(&self.vehicle.services().value(*pid), Some(servers));
            if interrupt::requested() {
                return Ok(answered);
            }
            let answers = asked?.len();
            if answers > 0 {
                answered.push(*pid);
            }
            self.show(is_answer)?;
            // A table shows it in its rows.
            if answers < servers && self.table.is_none() {
                eprintln!(
                    "cantap: {pid:02X}: {answers} of {servers} answered",
                    servers = counted(servers, "ECU")
                );
            }
        }
        Ok(answered)
    }

    fn codes(&mut self) -> anyhow::Result<()> {
        let mut any = false;
        let mut codes = BTreeSet::new();
        for (kind, request) in self.vehicle.services().codes() {
            let answers = self.client.ask_whoever(request, Some(self.vehicle.servers().len()))?;
            let sid = f64::from(request[0]);
            self.show(|event| {
                let is_wanted = is_answer(event)
                    && event.field("sid").is_some_and(|of| of.value.as_number() == Some(sid));
                if is_wanted {
                    codes.extend(codes_of(event));
                }
                is_wanted
            })?;
            any |= !answers.is_empty();
            if answers.is_empty() {
                eprintln!("cantap: no ECU tells {kind} codes");
            }
        }
        if !any {
            bail!("no ECU tells any codes; {}", self.client.speaking.circumstances());
        }
        if let Some(texts) = &self.texts {
            let mut out = std::io::stdout().lock();
            for code in codes {
                writeln!(out, "{code:<8}  {}", texts.get(&code).unwrap_or("(not in the table)"))?;
            }
        }
        Ok(())
    }

    fn identification(&mut self) -> anyhow::Result<()> {
        let mut any = false;
        let requests = self.vehicle.services().identification();
        let sid = f64::from(requests[0][0]);
        // What was asked to find the ECUs may be of the same service.
        self.client.speaking.take_events();
        for request in &requests {
            any |= !self.client.ask_whoever(request, None)?.is_empty();
        }
        self.show(|event| {
            is_answer(event) && event.field("sid").is_some_and(|of| of.value.as_number() == Some(sid))
        })?;
        if !any {
            bail!("no ECU tells who it is; vehicles before 2005 often do not");
        }
        Ok(())
    }

    /// As a table, unless it is for scripts.
    fn everything(&mut self, is_json: bool) -> anyhow::Result<()> {
        self.table = (!is_json).then(Table::default);
        let asked = self.ask_everything();
        // What was answered before something went wrong is worth showing.
        if let Some(table) = self.table.take().filter(|table| !table.is_empty()) {
            let columns = if std::io::stdout().is_terminal() { screen().0 } else { usize::MAX };
            writeln!(std::io::stdout(), "{}", table.lines(false, (columns, usize::MAX)).join("\n"))?;
        }
        asked
    }

    fn ask_everything(&mut self) -> anyhow::Result<()> {
        if let Err(error) = self.identification() {
            eprintln!("cantap: {error}");
        }
        self.codes()?;
        self.lists()?;
        self.client.speaking.take_events();
        let pids = self.all_pids();
        self.values(&pids).map(|_| ())
    }
}
