//! Container PDUs in ARXML files.

use roxmltree::Node;

use super::{Reader, Target, content, cycle_ms, description, number, short_name, within};
use crate::container::{ContainedPdu, Container, ContainerHeader, InPdu};
use crate::fault::FaultKind;
use crate::layout::ByteOrder;
use crate::model::{Multiplexed, Signal};
use crate::{validate, xml};

impl<'a> Reader<'a> {
    /// A PDU that holds others: with headers, by which each frame says which ones, or at fixed places.
    pub(super) fn container(
        &mut self,
        pdu: Node<'a, 'a>,
        target: &mut Target,
    ) -> Result<(), (Node<'a, 'a>, FaultKind)> {
        let name = short_name(pdu);
        if target.contained.is_some() || target.container.is_some() {
            let reason = format!("{name} is a second container PDU in its frame, and is not read");
            self.warn(pdu, target.name, &reason);
            return Ok(());
        }
        let header = match content(pdu, "HEADER-TYPE").as_deref() {
            Some("SHORT-HEADER") => ContainerHeader::Short,
            Some("LONG-HEADER") => ContainerHeader::Long,
            Some("NO-HEADER") => return self.fixed_container(pdu, target),
            other => {
                let reason =
                    format!("{name} is a container PDU with an unknown header ({})", other.unwrap_or("none"));
                self.warn(pdu, target.name, &reason);
                return Ok(());
            }
        };
        let length = number(pdu, "LENGTH").and_then(|length| u16::try_from(length).ok());
        let mut container = Container {
            at: target.offset / 8,
            length: length.unwrap_or(validate::MAX_BYTES),
            header,
            order: self.header_order(),
            pdus: Vec::new(),
        };
        target.cycle_ms = target.cycle_ms.or_else(|| cycle_ms(pdu));
        let (offset, cycle_of_frame) = (std::mem::take(&mut target.offset), target.cycle_ms);
        for inner in self.contained(pdu, target) {
            let id = match header {
                ContainerHeader::Short => "HEADER-ID-SHORT-HEADER",
                ContainerHeader::Long => "HEADER-ID-LONG-HEADER",
            };
            let props = properties(inner);
            let header_id = props.and_then(|props| number(props, id)).and_then(|id| u32::try_from(id).ok());
            let inner_name = short_name(inner);
            let Some(header_id) = header_id else {
                let reason = format!("{inner_name}, which {name} may contain, has no {id}, and is not read");
                self.warn(inner, target.name, &reason);
                continue;
            };
            if let Some(known) = container.pdus.iter().find(|known| known.header_id == header_id) {
                let reason = format!(
                    "{inner_name} has the header of {}, 0x{header_id:X}, in {name}, and is not read",
                    known.name
                );
                self.warn(inner, target.name, &reason);
                continue;
            }
            let (first, place) = (target.signals.len(), container.pdus.len());
            target.cycle_ms = None;
            target.contained = Some(inner_name.clone());
            let result = self.pdu(inner, target);
            target.contained = None;
            let cycle_ms = std::mem::replace(&mut target.cycle_ms, cycle_of_frame);
            if let Err((node, kind)) = result {
                // The others of the container are none the worse for it.
                target.signals.truncate(first);
                self.warn(
                    node,
                    target.name,
                    &format!("{inner_name}, which {name} may contain: {kind}; it is not read"),
                );
                continue;
            }
            for signal in &mut target.signals[first..] {
                signal.contained = Some(InPdu { place, name: inner_name.clone() });
            }
            let length = number(inner, "LENGTH").and_then(|length| u16::try_from(length).ok());
            container.pdus.push(ContainedPdu {
                header_id,
                description: description(inner),
                length: length.unwrap_or(validate::MAX_BYTES),
                cycle_ms,
                name: inner_name,
            });
        }
        target.offset = offset;
        target.container = Some(container);
        Ok(())
    }

    /// A container without headers: each PDU has its place, and some a bit that says whether it is there.
    fn fixed_container(
        &mut self,
        pdu: Node<'a, 'a>,
        target: &mut Target,
    ) -> Result<(), (Node<'a, 'a>, FaultKind)> {
        target.cycle_ms = target.cycle_ms.or_else(|| cycle_ms(pdu));
        let start = target.offset;
        for inner in self.contained(pdu, target) {
            let props = properties(inner);
            let bytes = props.and_then(|props| number(props, "OFFSET"));
            let bits = |at: i64| {
                u16::try_from(at).ok()?.checked_add(start).filter(|at| *at < validate::MAX_BYTES * 8)
            };
            let Some(offset) = bytes.and_then(|bytes| bits(bytes.checked_mul(8)?)) else {
                let reason =
                    format!("{} has no place in {}, and is not read", short_name(inner), short_name(pdu));
                self.warn(inner, target.name, &reason);
                continue;
            };
            let update = props.and_then(|props| number(props, "UPDATE-INDICATION-BIT-POSITION"));
            let switch = update.and_then(bits).map(|bit| {
                target.signals.push(Signal {
                    is_switch: true,
                    line: self.line(inner),
                    ..Signal::new(format!("{}_update", short_name(inner)), bit, 1)
                });
                target.signals.len() - 1
            });
            let first = target.signals.len();
            target.offset = offset;
            let result = self.pdu(inner, target);
            target.offset = start;
            result?;
            if let Some(switch) = switch {
                for signal in &mut target.signals[first..] {
                    signal.multiplexed.get_or_insert(Multiplexed { switch, values: vec![1..=1] });
                }
            }
        }
        Ok(())
    }

    /// The PDUs that a container names.
    fn contained(&mut self, pdu: Node<'a, 'a>, target: &Target) -> Vec<Node<'a, 'a>> {
        let mut found = Vec::new();
        for reference in within(pdu, "CONTAINED-PDU-TRIGGERING-REF") {
            let triggering = self.by_path.get(xml::text(reference).trim()).copied();
            match triggering.and_then(|node| self.reference(node, "I-PDU-REF")) {
                Some(inner) => found.push(inner),
                None => self.warn(reference, target.name, "a PDU of a container is not in the file"),
            }
        }
        found
    }

    /// One order for the headers of all containers of a system; the most significant byte comes first where none is named.
    fn header_order(&self) -> ByteOrder {
        let order = within(self.document.root_element(), "CONTAINER-I-PDU-HEADER-BYTE-ORDER").next();
        match order.map(xml::text).as_deref().map(str::trim) {
            Some("MOST-SIGNIFICANT-BYTE-LAST") => ByteOrder::Little,
            _ => ByteOrder::Big,
        }
    }
}

/// What a PDU says of its place in containers.
fn properties<'a>(pdu: Node<'a, 'a>) -> Option<Node<'a, 'a>> {
    pdu.children().find(|node| node.tag_name().name() == "CONTAINED-I-PDU-PROPS")
}
