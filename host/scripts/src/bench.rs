//! Scripts as nodes on simulated buses, in simulated time.

use std::path::PathBuf;
use std::sync::Arc;

use cantap_can::CHANNELS;
use cantap_signals::Decoder;
use cantap_trace::TraceRecord;
use cantap_virtual::Options;

use crate::faults::{BenchNodes, PlannedFault};
use crate::files::GrantedFiles;
use crate::node::{Script, ScriptError};
use crate::report::{Message, Report};
use crate::results::AFTER_NS;
use crate::simulation::Simulation;
use crate::surroundings::Surroundings;

/// How long frames that are under way at the end may take to be on the bus: as long as what follows a failure is of interest.
const FAREWELL_NS: u64 = AFTER_NS;

/// What a run on simulated buses needs.
#[derive(Clone, Debug)]
pub struct Bench {
    /// What else is on the buses, as in the address of a virtual device: `load=0` for nothing, `car` for a vehicle.
    pub options: Options,
    /// What goes wrong on them.
    pub faults: Vec<PlannedFault>,
    /// The bit rates of the buses, in bit/s, where the options do not fix them.
    pub bitrates_bps: [u32; CHANNELS],
    /// The databases for messages and signals.
    pub decoder: Arc<Decoder>,
    /// Selects another sequence of random numbers; each script has its own.
    pub seed: u64,
    /// Keys that are typed during the run, and when, in nanoseconds of simulated time.
    pub keys: Vec<(u64, char)>,
    /// The folder of which scripts may read the files; none for no files at all.
    pub readable: Option<PathBuf>,
    /// When the run ends, in nanoseconds of simulated time; scripts with tests end it earlier.
    pub duration_ns: u64,
}

impl Bench {
    /// Runs scripts until the tests are done, all scripts have ended, or the time is up. Each frame on a bus goes to `on_record`, each line that a
    /// script logs to `on_message`, when `goes_on` returns false the run ends.
    ///
    /// The same scripts, options and seed give the same frames at the same times.
    ///
    /// # Errors
    /// If a script is not in the language; what goes wrong later is in the report.
    pub fn run(
        &self,
        scripts: &[Script],
        on_record: &mut dyn FnMut(TraceRecord),
        on_message: &mut dyn FnMut(Message),
        goes_on: &mut dyn FnMut() -> bool,
    ) -> Result<Report, ScriptError> {
        if scripts.is_empty() {
            return Err(ScriptError::None);
        }
        let mut simulation = self.start();
        for script in scripts {
            simulation.add(script)?;
        }
        simulation.check_faults()?;
        let mut hand_over = |simulation: &mut Simulation| {
            simulation.take_records().into_iter().for_each(&mut *on_record);
            simulation.take_messages().into_iter().for_each(&mut *on_message);
        };
        while simulation.now_ns() < self.duration_ns && !simulation.is_over() && goes_on() {
            let goes = simulation.step(self.duration_ns);
            hand_over(&mut simulation);
            if !goes {
                break;
            }
        }
        let until_ns = simulation.now_ns() + FAREWELL_NS;
        while simulation.is_over() && simulation.now_ns() < until_ns && goes_on() {
            let is_expected = simulation.is_sending() || simulation.results.is_tracing(simulation.now_ns());
            if !is_expected || !simulation.step(until_ns) {
                break;
            }
            hand_over(&mut simulation);
        }
        simulation.end_stall();
        hand_over(&mut simulation);
        let (report, messages) = simulation.finish();
        messages.into_iter().for_each(on_message);
        Ok(report)
    }

    /// The same, step by step, for a caller that takes part itself and adds scripts as it likes. [`Self::duration_ns`] is its business.
    pub fn start(&self) -> Simulation {
        let mut options = self.options.clone();
        let buses = [0, 1].map(|channel| {
            let bitrate_bps = options.bitrate_of_bus(channel).unwrap_or(self.bitrates_bps[channel]);
            (options.bus(channel), bitrate_bps)
        });
        let surroundings = Surroundings {
            decoder: Arc::clone(&self.decoder),
            seed: self.seed,
            files: Arc::new(GrantedFiles::under(self.readable.clone())),
            replies: None,
            nodes: Some(BenchNodes::default()),
        };
        Simulation::new(buses, surroundings, self.keys.clone(), self.faults.clone())
    }
}
