use cantap::Channel;
use cantap::wire::message::{FrameKind, Modifier};
use cantap_analysis::delay::{DelayOptions, Matching, Outcome};
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};
use proptest::prelude::*;

use super::{DryRun, DryRunCounts, Map, Rules, Sent};

const MS: i64 = 1_000_000;

fn rules(text: &str) -> Rules {
    Rules::parse("rules.toml", text).unwrap_or_else(|error| panic!("{error}\n{text}"))
}

fn error(text: &str) -> String {
    Rules::parse("rules.toml", text).unwrap_err().to_string()
}

fn on(channel: u8, time_ns: i64, frame: &str) -> TraceRecord {
    let event = TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
    TraceRecord { time_ns, device_ns: None, channel, event }
}

fn dry_run(rules: &Rules, records: &[TraceRecord]) -> (Vec<Sent>, DryRunCounts) {
    let (mut run, mut sent) = (DryRun::new(rules.clone()), Vec::new());
    for record in records {
        run.push(record, &mut sent);
    }
    let counts = run.finish(&mut sent);
    (sent, counts)
}

/// What becomes of one frame on channel 1.
fn becomes(rules: &str, frame: &str) -> Option<String> {
    let (sent, _) = dry_run(&self::rules(rules), &[on(1, 0, frame)]);
    sent.first().map(|sent| sent.frame.to_string())
}

/// One rule for channel 1.
fn with(fields: &str) -> String {
    format!("[[rule]]\nfrom = 1\n{fields}\n")
}

#[test]
fn the_first_rule_that_matches_decides_and_what_none_matches_is_not_passed_on() {
    let text = "[[rule]]\nfrom = 1\nfilter = \"100\"\ndrop = true\n[[rule]]\nfrom = \"can0\"\nfilter = \"100-1FF\"\n\
                [[rule]]\nfrom = 2\n";
    assert_eq!(becomes(text, "100#11"), None);
    assert_eq!(becomes(text, "101#11").as_deref(), Some("101#11"));
    assert_eq!(becomes(text, "200#11"), None);
    assert_eq!(becomes(text, "00000101#11"), None);
    let (sent, counts) =
        dry_run(&rules(text), &[on(2, 5, "1FFFFFFF#R2"), on(3, 6, "100#"), on(1, 7, "200#")]);
    assert_eq!(
        sent.iter().map(|sent| (sent.channel, sent.time_ns)).collect::<Vec<_>>(),
        [(Channel::Can1, 5)]
    );
    assert_eq!((counts.unmatched, counts.not_received), ([1, 0], 1));
}

#[test]
fn bits_change_in_can_gws_order() {
    for (change, frame, expected) in [
        ("set.id = \"456\"", "123#11", "456#11"),
        ("set.id = \"18FEF1??\"", "123#11", "18FEF123#11"),
        ("set.id = \"4??\"", "123#11", "423#11"),
        ("and.id = \"7F0\"\nor.id = \"00A\"\nxor.id = \"00F\"", "123#11", "125#11"),
        ("set.data = \"AA.??.?5\"", "123#1122334455", "123#AA22354455"),
        ("and.data = \"0F\"\nor.data = \"A0 80\"\nxor.data = \"00.FF\"", "123#1122", "123#A15D"),
        ("set.data = \"11\"\nor.data = \"EE\"", "123#00", "123#11"),
        ("set.dlc = 2", "123#11223344", "123#1122"),
        ("set.dlc = 4", "123#1122", "123#11220000"),
        ("and.dlc = 3", "123#1122334455", "123#11"),
        ("checksum = \"2:xor\"", "123#112200", "123#112233"),
        ("set.data = \"01\"\nchecksum = \"2:sum\"", "123#112200", "123#012223"),
        ("counter = \"0.0:4\"", "123#FF", "123#F0"),
    ] {
        let text = with(&format!("filter = \"123\"\n{change}"));
        assert_eq!(becomes(&text, frame).as_deref(), Some(expected), "{change}");
    }
    // From 29 bits to 11.
    let text = with("filter = \"18FEF100\"\nset.id = \"0F1\"");
    assert_eq!(becomes(&text, "18FEF100#11").as_deref(), Some("0F1#11"));
}

#[test]
fn a_counter_counts_the_frames_of_its_rule() {
    let text = with("filter = \"123\"\ncounter = \"1.4:4\"\nchecksum = \"0:xor\"");
    let records: Vec<_> = (0..18).map(|at| on(1, at * MS, "123#00A5")).collect();
    let (sent, counts) = dry_run(&rules(&text), &records);
    let data: Vec<_> = sent.iter().map(|sent| sent.frame.data().to_vec()).collect();
    assert_eq!(
        (&data[0][..], &data[15][..], &data[17][..]),
        (&[5, 5][..], &[0xF5, 0xF5][..], &[0x15, 0x15][..])
    );
    assert_eq!((counts.rules[0].0.matched, counts.rules[0].1), (18, 18));
}

#[test]
fn periods_replace_and_delays_hold_back() {
    let text = with("filter = \"123\"\nperiod = \"100ms\"\ndelay = \"5ms\"");
    let records = [0, 10, 20, 150, 400].map(|ms| on(1, ms * MS, &format!("123#{ms:04X}")));
    let (sent, counts) = dry_run(&rules(&text), &records);
    let times: Vec<_> = sent.iter().map(|sent| (sent.time_ns / MS, sent.frame.data()[1])).collect();
    assert_eq!(times, [(5, 0), (105, 20), (205, 150), (405, 400_u16 as u8)]);
    let counts = &counts.rules[0].0;
    assert_eq!((counts.matched, counts.sent, counts.overtaken, counts.lost), (5, 4, 1, 0));
}

#[test]
fn filters_are_those_of_the_grammar() {
    let one = |filter: &str| {
        let rules = rules(&with(&format!("filter = \"{filter}\"")));
        rules.rules[0].parts.iter().map(|part| part.filter).collect::<Vec<_>>()
    };
    assert_eq!(one("123").len(), 1);
    assert_eq!(one("18FEF1??")[0].mask, 0x1FFF_FF00);
    assert_eq!(one("pgn:61444")[0].id, 0x00F0_0400);
    // A mask without a length is of both.
    assert_eq!(one("123:7FF").iter().map(|filter| filter.extended).collect::<Vec<_>>(), [false, true]);
    assert_eq!(one("100-1FF").len(), 1);
    assert_eq!(one("101-1FF").len(), 8);
    let remote = rules(&with("filter = \"123\"\nremote = true"));
    assert_eq!(remote.rules[0].parts[0].filter.kind, FrameKind::Remote);
    assert_eq!(rules(&with("")).rules[0].parts.len(), 2);
}

#[test]
fn errors_name_the_line_and_the_field() {
    for (text, expected) in [
        ("", "rules.toml, line 1: there is no rule"),
        ("[[rule]]\nfrom = 3", "rules.toml, line 2: from: a channel is 1 or 2"),
        ("[[rule]]\n", "rules.toml, line 1: missing field `from`"),
        ("\n[[rule]]\nfrom = 1\ncolour = 2", "rules.toml, line 4: unknown field `colour`"),
        ("[[rule]]\nfrom = 1\nfilter = \"900\"", "rules.toml, line 3: filter: '900' has more than 11 bits"),
        ("[[rule]]\nfrom = 1\nset.id = \"100-1FF\"", "rules.toml, line 3: set.id: write one identifier"),
        ("[[rule]]\nfrom = 1\nset = { dlc = 16 }", "rules.toml, line 3: set.dlc: a DLC is 0 to 15"),
        ("[[rule]]\nfrom = 1\nand.data = \"1\"", "rules.toml, line 3: and.data: write up to 8 bytes"),
        ("[[rule]]\nfrom = 1\nand.data = \"é1\"", "rules.toml, line 3: and.data: write up to 8 bytes"),
        (
            "[[rule]]\nfrom = 1\nchecksum = \"9:xor\"",
            "rules.toml, line 3: checksum: a frame has bytes 0 to 7",
        ),
        (
            "[[rule]]\nfrom = 1\nchecksum = \"7:md5\"",
            "rules.toml, line 3: checksum: write a checksum as BYTE:xor",
        ),
        (
            "[[rule]]\nfrom = 1\nfilter = \"123\"\nperiod = \"fast\"",
            "rules.toml, line 4: period: write a time",
        ),
        ("[[rule]]\nfrom = 1\ndelay = \"1h\"", "rules.toml, line 3: delay: at most 100s"),
        (
            "[[rule]]\nfrom = 1\nfilter = \"101-1FF\"\nperiod = \"1s\"",
            "rules.toml, line 4: period: it is one for all",
        ),
        ("[[rule]]\nfrom = 1\ndrop = true\ndelay = \"1s\"", "rules.toml, line 1: drop: a rule that drops"),
        ("[[rule]]\nfrom = 1\nfilter = \"123\"\nor.id = \"00000800\"", "rules.toml, line 4: id: "),
        ("[[rule]]\nfrom = 1\nfilter = \"00000001-0FFFFFFE\"", "take 54 places, and a device has 32"),
        ("[[rule]\n", "rules.toml, line 1: "),
    ] {
        let error = error(text);
        assert!(error.contains(expected), "{text}\n{error}");
    }
}

#[test]
fn a_devices_rules_have_its_units() {
    let text = with("filter = \"123\"\nperiod = \"100ms\"\ndelay = \"1us\"\ncounter = \"7\"");
    let pass = rules(&text).of_device(Channel::Can1, 12_000_000)[0].pass.clone().unwrap();
    assert_eq!((pass.period_ticks, pass.delay_ticks), (1_200_000, 12));
    assert_eq!(pass.modifiers[..], [Modifier::Counter { byte: 7, low_bit: 0, bits: 8 }]);
    assert!(rules(&text).of_device(Channel::Can2, 12_000_000).is_empty());
}

/// What the dry run sends is found by `delay` with the same rules.
fn found_again(rules: &Rules, records: &[TraceRecord]) -> (Outcome, DryRunCounts) {
    let (sent, counts) = dry_run(rules, records);
    let mut all = [records, &sent.iter().map(Sent::record).collect::<Vec<_>>()].concat();
    all.sort_by_key(|record| record.time_ns);
    let map = Map::new(rules, Channel::Can1);
    let options = DelayOptions { from: 1, to: 2, within_ns: 100 * MS };
    let mut matching = Matching::new(options, |frame: &TraceFrame| map.expected(frame));
    for record in &all {
        matching.push(record, true);
    }
    (matching.finish(), counts)
}

prop_compose! {
    /// A rule for its own identifiers, that sends identifiers of its own: what comes from two rules cannot be told apart.
    fn any_rule(number: usize)(
        drop in prop::bool::weighted(0.1),
        id in any::<bool>(),
        extended in any::<bool>(),
        data in prop::option::of("[0-9A-F?]{4}"),
        xor in prop::option::of("[0-9A-F]{6}"),
        dlc in prop::option::of(0_u8..9),
        counter in prop::option::weighted(0.3, 0_u8..8),
        checksum in prop::option::weighted(0.3, (0_u8..8, prop::sample::select(vec!["xor", "sum", "crc8"]))),
        period in prop::option::weighted(0.3, 1_u32..200),
        delay in prop::option::weighted(0.3, 1_u32..200),
    ) -> String {
        let mut fields = vec![format!("filter = \"{number}??\"")];
        if drop {
            fields.push("drop = true".to_owned());
        } else {
            let to = if extended { format!("1800{number}0??") } else { format!("{}??", 4 + number) };
            fields.extend(id.then(|| format!("set.id = \"{to}\"")));
            fields.extend(data.map(|data| format!("set.data = \"{data}\"")));
            fields.extend(xor.map(|data| format!("xor.data = \"{data}\"")));
            fields.extend(dlc.map(|dlc| format!("set.dlc = {dlc}")));
            fields.extend(counter.map(|byte| format!("counter = \"{byte}\"")));
            fields.extend(checksum.map(|(byte, kind)| format!("checksum = \"{byte}:{kind}\"")));
            fields.extend(period.map(|ms| format!("period = \"{ms}ms\"")));
            fields.extend(delay.map(|ms| format!("delay = \"{ms}ms\"")));
        }
        with(&fields.join("\n"))
    }
}

fn any_rules() -> impl Strategy<Value = String> {
    (any_rule(0), any_rule(1), any_rule(2)).prop_map(|(a, b, c)| [a, b, c].concat())
}

proptest! {
    #[test]
    fn what_a_dry_run_sends_is_found_again(
        text in any_rules(),
        frames in prop::collection::vec((0_i64..40_000, 0_u32..0x400, prop::collection::vec(0_u8..3, 0..9)), 1..80),
    ) {
        let rules = rules(&text);
        let mut now = 0;
        let records: Vec<_> = frames.iter().map(|(us, id, data)| {
            now += us * 1_000;
            let data: Vec<_> = data.iter().map(|byte| format!("{byte:02X}")).collect();
            on(1, now, &format!("{id:03X}#{}", data.concat()))
        }).collect();
        let (outcome, counts) = found_again(&rules, &records);
        let sum = |of: fn(&cantap::wire::message::RuleCounts) -> u32| {
            u64::from(counts.rules.iter().map(|(rule, _)| of(rule)).sum::<u32>())
        };
        let total = &outcome.total;
        prop_assert_eq!(sum(|rule| rule.lost), 0);
        prop_assert_eq!((total.missing, total.extra, total.undecided.total()), (0, 0, 0), "{}\n{:?}", text, outcome);
        prop_assert_eq!((total.matched, total.replaced), (sum(|rule| rule.sent), sum(|rule| rule.overtaken)));
        prop_assert_eq!(total.matched + total.replaced + outcome.not_expected, records.len() as u64);
    }

    /// Whatever a file contains, it is rules or an error.
    #[test]
    fn no_text_is_a_panic(text in "(\\[\\[rule\\]\\]\nfrom = [0-4]\n(filter|set.id|set.data|counter|checksum|period) = \"[0-9A-F?:.smxé-]{0,9}\"\n){1,3}") {
        let _ = Rules::parse("rules.toml", &text);
    }
}
