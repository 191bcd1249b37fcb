//! Values whose names do not come from a database, such as the fields of a protocol's messages.

/// A value with a name of its own, for [`SignalCollector::push_named`](super::SignalCollector::push_named).
#[derive(Clone, Copy, Debug)]
pub struct NamedValue<'a> {
    /// When it came: nanoseconds, as in records.
    pub time_ns: i64,
    /// The channel, from 1.
    pub channel: u8,
    /// Its name.
    pub name: &'a str,
    /// What else tells it from others of that name, such as who sent it: each combination is a curve. As many, and in the same order, for every
    /// value of a name; those that differ are added to the curves' names.
    pub parts: &'a [String],
    /// Empty without one.
    pub unit: &'a str,
    /// The value; not a number where there is none.
    pub value: f64,
    /// What the value stands for.
    pub text: Option<&'a str>,
}

/// What is one curve.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Named {
    pub name: String,
    parts: Vec<String>,
}

impl Named {
    pub fn of(value: &NamedValue<'_>) -> Self {
        Self { name: value.name.to_owned(), parts: value.parts.to_vec() }
    }
}

/// The names with those parts in which they differ from others of the same channel; `None` for what has no name of its own.
pub(super) fn distinct_names(all: &[Option<(u8, &Named)>]) -> Vec<Option<String>> {
    let name = |&(channel, named): &(u8, &Named)| {
        let same = all.iter().flatten().filter(|(other_channel, other)| {
            (*other_channel, &other.name) == (channel, &named.name) && other.parts != named.parts
        });
        let others: Vec<_> = same.map(|(_, other)| other).collect();
        let differs =
            |place: usize, part: &String| others.iter().any(|other| other.parts.get(place) != Some(part));
        let parts =
            named.parts.iter().enumerate().filter(|(place, part)| !part.is_empty() && differs(*place, part));
        let parts: Vec<_> = parts.map(|(_, part)| part.as_str()).collect();
        if parts.is_empty() { named.name.clone() } else { format!("{} ({})", named.name, parts.join(", ")) }
    };
    all.iter().map(|one| one.as_ref().map(name)).collect()
}

#[cfg(test)]
mod tests {
    use super::super::testing::frame;
    use super::*;
    use crate::plot::SignalCollector;
    use cantap_signals::Decoder;

    #[test]
    fn values_of_one_name_from_several_senders_are_several_curves() {
        let decoder = Decoder::new(Vec::new());
        let mut collector = SignalCollector::new(&decoder);
        let parts = |from: &str, title: &str| [from.to_owned(), title.to_owned()];
        for n in 0..10 {
            collector.push(&frame(n * 10, "123#00"));
            for (from, value) in [("0 > all", 600.0), ("1 > all", 900.0)] {
                collector.push_named(&NamedValue {
                    time_ns: n * 10_000_000,
                    channel: 1,
                    name: "j1939.engine_speed",
                    parts: &parts(from, "EEC1"),
                    unit: "rpm",
                    value: value + n as f64,
                    text: None,
                });
            }
            collector.push_named(&NamedValue {
                time_ns: n * 10_000_000,
                channel: 1,
                name: "j1939.gear",
                parts: &parts("0 > all", "ETC2"),
                unit: "",
                value: (n % 2) as f64,
                text: Some(if n % 2 == 0 { "neutral" } else { "first" }),
            });
        }
        let plot = collector.finish(String::new());
        let curves = plot.panes.iter().flat_map(|pane| pane.content.curves());
        assert_eq!(
            curves.map(|curve| curve.name.as_str()).collect::<Vec<_>>(),
            ["j1939.engine_speed (0 > all)", "j1939.engine_speed (1 > all)", "j1939.gear"]
        );
        let speed = &plot.panes[0].content.curves()[1].series;
        assert_eq!((plot.panes[0].label.as_str(), speed.points()[9].y), ("rpm", 909.0));
        let gear = &plot.panes[1].content.curves()[0];
        assert!(gear.stepped);
        assert_eq!(gear.texts, [(0.0, "neutral".to_owned()), (1.0, "first".to_owned())]);
    }
}
