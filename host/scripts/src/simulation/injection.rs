//! What goes wrong with the nodes and buses of a simulation.

use std::sync::Arc;

use super::Simulation;
use crate::faults::{Fault, PlannedFault};
use crate::node::{Node, ScriptError};

/// Who has ended a run when what was to go wrong cannot.
const FAULTS: &str = "--bus";
/// How long a node takes until its script begins, in nanoseconds: so that time passes however often nodes switch each other off and on.
const START_NS: u64 = 1_000_000;

impl Simulation {
    /// Whether what is to go wrong can: nodes of other names are none of this run.
    pub(crate) fn check_faults(&self) -> Result<(), ScriptError> {
        let wrong = self.faults.iter().find_map(|planned| self.node_of(planned).err());
        wrong.map_or(Ok(()), |reason| Err(ScriptError::Fault { reason }))
    }

    fn node_of(&self, planned: &PlannedFault) -> Result<Option<usize>, String> {
        planned.node.as_deref().map(|name| self.known.find(name, planned.fault)).transpose()
    }

    /// What is planned to go wrong now does, and what is over is.
    pub(super) fn inject_faults(&mut self) {
        let now_ns = self.now_ns;
        while let Some(planned) = self.faults.pop_front_if(|planned| planned.at_ns <= now_ns) {
            match self.node_of(&planned) {
                Ok(node) => self.take_fault(node, planned.fault),
                Err(reason) => self.results.report.errors.push((FAULTS.to_owned(), reason)),
            }
        }
        for place in 0..self.places.len() {
            if self.places[place].power_on_ns.is_some_and(|at_ns| at_ns <= now_ns) {
                self.power_on(place);
            }
        }
        for wire in &mut self.buses {
            let is_free = wire.bus.is_free();
            wire.nodes.iter_mut().chain([&mut wire.own]).for_each(|node| node.recover(now_ns, is_free));
        }
    }

    pub(super) fn take_fault(&mut self, node: Option<usize>, fault: Fault) {
        let now_ns = self.now_ns;
        match (fault, node) {
            (Fault::ErrorBurst { channel, for_ns }, _) => {
                self.buses[channel.index()].bus.destroy_until(now_ns.saturating_add(for_ns));
            }
            (Fault::BusOff { channel }, Some(place)) => {
                self.buses[channel.index()].nodes[place].disturb();
            }
            (Fault::PowerOff { for_ns }, Some(place)) => self.power_off(place, for_ns),
            (Fault::PowerOn, Some(place)) if self.nodes[place].has_ended => {
                self.nodes[place].comes_back = true;
                self.places[place].power_on_ns = Some(now_ns.saturating_add(START_NS));
            }
            (Fault::Stall { for_ns }, Some(place)) => {
                self.places[place].intake.stall_until(now_ns.saturating_add(for_ns));
            }
            (Fault::Stall { for_ns }, None) => {
                let until_ns = now_ns.saturating_add(for_ns);
                self.intake.stall_until(until_ns);
                self.places.iter_mut().for_each(|place| place.intake.stall_until(until_ns));
            }
            (Fault::Lose(losing), Some(place)) => self.places[place].intake.lose(losing, now_ns),
            (Fault::Lose(losing), None) => self.losses.add(losing, now_ns),
            // It has it; and nobody writes the others without a node.
            (Fault::PowerOn, Some(_))
            | (Fault::BusOff { .. } | Fault::PowerOff { .. } | Fault::PowerOn, None) => {}
        }
    }

    fn power_off(&mut self, place: usize, for_ns: Option<u64>) {
        self.note_error(place);
        self.end(place);
        self.nodes[place].comes_back = for_ns.is_some();
        self.places[place].power_on_ns =
            for_ns.map(|for_ns| self.now_ns.saturating_add(for_ns.max(START_NS)));
        self.set_power(place, false);
    }

    /// A node whose script has ended, or that has no power, gets it, and its script begins.
    fn power_on(&mut self, place: usize) {
        self.note_error(place);
        let own = &mut self.places[place];
        own.power_on_ns = None;
        own.restarts += 1;
        // With random numbers of its own, as those of another script.
        let number = place as u64 | own.restarts << 32;
        match Node::start_nth(number, &own.script, &self.surroundings, Arc::default()) {
            Ok(node) => self.nodes[place] = node,
            Err(error) => {
                self.nodes[place].comes_back = false;
                self.results.report.errors.push((self.nodes[place].name.clone(), error.to_string()));
            }
        }
        self.drop_waiting(place);
        self.set_power(place, true);
    }

    /// The error with which a script has ended is in the report, whatever becomes of its node.
    fn note_error(&mut self, place: usize) {
        let node = &mut self.nodes[place];
        self.results.report.errors.extend(node.error.take().map(|error| (node.name.clone(), error)));
    }

    fn set_power(&mut self, place: usize, is_powered: bool) {
        for wire in &mut self.buses {
            wire.nodes[place].set_power(is_powered, wire.bus.is_free());
        }
    }
}
