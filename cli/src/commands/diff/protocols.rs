//! Which nodes and objects are on two buses, and how they differ.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;

use cantap_protocols::{KnownObject, Overview, Protocol};
use serde_json::{Value, json};

use crate::protocols::named;

/// Channel (0 if irrelevant), protocol and node.
type Node = (u8, Protocol, String);

/// The difference.
#[derive(Default)]
pub(super) struct Protocols {
    nodes: [Vec<Node>; 2],
    objects: [Vec<(Node, String)>; 2],
    /// Values that change in neither trace, but differ between them.
    values: Vec<(Node, String, [String; 2])>,
    same: usize,
}

impl Protocols {
    pub fn new([a, b]: [&Overview; 2], ignore_channels: bool) -> Self {
        let key = |(channel, protocol, node): (u8, Protocol, String)| {
            (if ignore_channels { 0 } else { channel }, protocol, node)
        };
        let nodes =
            [a, b].map(|overview| overview.nodes().map(|(node, _)| key(node)).collect::<BTreeSet<_>>());
        let objects = [a, b].map(|overview| {
            let mut objects = BTreeMap::<(Node, String), KnownObject>::new();
            for ((channel, protocol, node, object), known) in overview.objects() {
                let entry = objects.entry((key((channel, protocol, node)), object.to_owned()));
                let merged = entry.or_insert_with(|| known.clone());
                merged.varies |= known.varies || merged.value != known.value;
            }
            objects
        });
        let mut this = Self::default();
        for (side, other) in [(0, 1), (1, 0)] {
            this.nodes[side] = nodes[side].difference(&nodes[other]).cloned().collect();
            // The objects of a node that the other trace does not have add nothing to the node itself.
            let only = objects[side].keys().filter(|key| !objects[other].contains_key(*key));
            this.objects[side] = only.filter(|(node, _)| nodes[other].contains(node)).cloned().collect();
        }
        for (key, one) in &objects[0] {
            let Some(two) = objects[1].get(key) else { continue };
            match (&one.value, &two.value) {
                (Some(a), Some(b)) if a != b && !one.varies && !two.varies => {
                    this.values.push((key.0.clone(), key.1.clone(), [a.clone(), b.clone()]));
                }
                _ => this.same += 1,
            }
        }
        this
    }

    pub fn is_none(&self) -> bool {
        self.nodes.iter().all(Vec::is_empty)
            && self.objects.iter().all(Vec::is_empty)
            && self.values.is_empty()
    }

    pub fn print(&self, names: &[String; 2], out: &mut impl Write) -> std::io::Result<()> {
        let name = |(channel, protocol, node): &Node| match channel {
            0 => format!("{protocol} node {node}"),
            channel => format!("channel {channel}, {protocol} node {node}"),
        };
        for (side, trace) in names.iter().enumerate() {
            for node in &self.nodes[side] {
                writeln!(out, "{}: only in {trace}", name(node))?;
            }
            for (node, object) in &self.objects[side] {
                writeln!(out, "{}, {object}: only in {trace}", name(node))?;
            }
        }
        for (node, object, [a, b]) in &self.values {
            writeln!(out, "{}, {object}: {a} -> {b}", name(node))?;
        }
        let both =
            |lists: &[usize; 2]| format!("{} only in the first, {} only in the second", lists[0], lists[1]);
        writeln!(
            out,
            "nodes: {}; objects: {}, {} changed, {} the same",
            both(&[self.nodes[0].len(), self.nodes[1].len()]),
            both(&[self.objects[0].len(), self.objects[1].len()]),
            self.values.len(),
            self.same
        )
    }

    pub fn object(&self) -> Value {
        let key = |node: &Node| named((node.0, node.1, &node.2));
        let with = |node: &Node, object: &str| {
            let mut key = key(node);
            key["object"] = object.into();
            key
        };
        let nodes = |side: usize| self.nodes[side].iter().map(key).collect::<Vec<_>>();
        let objects = |side: usize| {
            self.objects[side].iter().map(|(node, object)| with(node, object)).collect::<Vec<_>>()
        };
        let values = self.values.iter().map(|(node, object, [a, b])| {
            let mut entry = with(node, object);
            (entry["a"], entry["b"]) = (a.as_str().into(), b.as_str().into());
            entry
        });
        json!({
            "nodes_only_a": nodes(0), "nodes_only_b": nodes(1), "objects_only_a": objects(0), "objects_only_b": objects(1),
            "changed": values.collect::<Vec<_>>(), "same": self.same,
        })
    }
}
