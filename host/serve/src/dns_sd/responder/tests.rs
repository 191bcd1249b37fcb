use super::*;
use crate::dns_sd::kind_name;

const IP: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(192, 0, 2, 7));

/// A responder, and the time as it sees it.
struct Link {
    responder: Responder,
    now: Instant,
}

impl Link {
    fn new() -> Self {
        let service = |label: &str, port| Service { label: label.to_owned(), port };
        let services = [service("cantap 1.2", 1), service("cantap 3", 2)];
        let now = Instant::now();
        Self { responder: Responder::new(kind_name(), IP, "cantap-lab", &services, vec![0], now), now }
    }

    /// What is said in this time, and how long after its beginning.
    fn pass(&mut self, time: Duration) -> Vec<(Duration, Message)> {
        let (from, end) = (self.now, self.now + time);
        let mut all = Vec::new();
        while let Some(due) = self.responder.due().filter(|due| *due <= end) {
            self.now = due.max(self.now);
            let at = self.now - from;
            all.extend(self.responder.go_on(self.now).into_iter().map(|message| (at, message)));
        }
        self.now = end;
        all
    }

    fn announced() -> Self {
        let mut link = Self::new();
        link.pass(Duration::from_secs(10));
        assert_eq!(link.responder.phase, Phase::Announced);
        link
    }

    fn take(&mut self, message: &Message) {
        assert_eq!(self.responder.take(message, false, self.now), []);
    }

    /// Somebody else's host or service of this name.
    fn other(name: &Name, kind: u16) -> Message {
        Message::answer(vec![Record::new(name.clone(), kind, 120, vec![9; 4])])
    }

    fn names(&self) -> Vec<String> {
        let all = [self.responder.name(0), self.responder.name(1), self.responder.host()];
        all.iter()
            .map(|name| String::from_utf8(name.bytes()[1..=name.bytes()[0].into()].to_vec()).unwrap())
            .collect()
    }
}

#[test]
fn names_are_tried_three_times_and_then_announced_twice() {
    let mut link = Link::new();
    let said = link.pass(Duration::from_secs(10));
    let (probes, announced) = said.split_at(6);
    assert!(probes.iter().all(|(_, message)| !message.is_answer && message.proposed.len() == 3));
    assert_eq!(probes[4].0.abs_diff(probes[0].0), 2 * BETWEEN_PROBES);
    assert_eq!(announced.len(), 4);
    assert!(announced.iter().all(|(_, message)| message.is_answer));
    assert_eq!(announced[2].0.abs_diff(announced[0].0), BETWEEN_ANNOUNCEMENTS);
    // The host's address is said once each time.
    let addresses =
        announced.iter().flat_map(|(_, message)| &message.answers).filter(|record| record.kind == kind::A);
    assert_eq!(addresses.count(), 2);
    let gone = link.responder.goodbye();
    assert!(
        gone.len() == 2 && gone.iter().flat_map(|message| &message.answers).all(|record| record.ttl_s == 0)
    );
}

/// Ten thousand questions a second, of all kinds, by one who pretends to be about to take the names as well.
#[test]
fn a_flood_of_questions_is_answered_once_a_second() {
    let mut link = Link::announced();
    let mut said = 0;
    let questions = [
        Message::question(kind_name(), kind::PTR),
        Message::question(kinds(), kind::PTR),
        Message::question(link.responder.host(), kind::A),
        Message::question(link.responder.name(1), kind::ANY),
    ];
    for _ in 0..10_000 {
        for question in &questions {
            link.take(question);
        }
        said += link.pass(Duration::from_millis(1)).len();
    }
    assert!((24..=33).contains(&said), "{said} packets in 10 s, of three");
    let probe = Message { proposed: vec![link.responder.of_host()], ..questions[2].clone() };
    link.pass(Duration::from_secs(2));
    said = 0;
    for _ in 0..1000 {
        link.take(&probe);
        said += link.pass(Duration::from_millis(1)).len();
    }
    assert!((3..=5).contains(&said), "{said} packets in 1 s");
    // To addresses that somebody may have forged.
    let once: usize = (0..10_000).map(|_| link.responder.take(&questions[0], true, link.now).len()).sum();
    assert_eq!(once, MOST_LEGACY as usize);
    let now = link.now + Duration::from_secs(1);
    let answer = &link.responder.take(&Message { id: 7, ..questions[0].clone() }, true, now)[0];
    assert_eq!((answer.id, answer.questions.len()), (7, 1));
    assert!(answer.answers.iter().all(|record| record.ttl_s <= LEGACY_TTL_S && !record.is_only));
}

#[test]
fn what_whoever_asks_knows_is_not_said_again() {
    let mut link = Link::announced();
    let mut question = Message::question(kind_name(), kind::PTR);
    question.answers = vec![link.responder.pointer(0)];
    link.take(&question);
    let said = link.pass(Duration::from_secs(1));
    assert!(said.len() == 1 && said[0].1.answers[0] == link.responder.pointer(1), "{said:?}");
    // Unless it is about to forget it.
    question.answers[0].ttl_s /= 3;
    link.take(&question);
    assert_eq!(link.pass(Duration::from_secs(2)).len(), 2);
    // A type that the host does not have.
    link.take(&Message::question(link.responder.host(), kind::AAAA));
    let said = link.pass(Duration::from_secs(1));
    assert!(said[0].1.additional.iter().any(|record| record.kind == kind::NSEC), "{said:?}");
    for other in [Message::question(Name::of(&["x", "local"]), kind::ANY), Message::default()] {
        link.take(&other);
    }
    assert_eq!(link.pass(Duration::from_secs(2)), []);
}

#[test]
fn a_name_that_somebody_has_is_left_to_them() {
    let mut link = Link::new();
    link.pass(Duration::from_millis(300));
    let (host, first) = (link.responder.host(), link.responder.name(0));
    link.take(&Link::other(&host, kind::A));
    link.take(&Link::other(&first, kind::SRV));
    assert_eq!(link.names(), ["cantap 1.2 (2)", "cantap 3", "cantap-lab-2"]);
    // The next one as well.
    link.pass(Duration::from_millis(300));
    let second = link.responder.name(0);
    link.take(&Link::other(&second, kind::TXT));
    assert_eq!(link.names(), ["cantap 1.2 (3)", "cantap 3", "cantap-lab-2"]);
    let said = link.pass(Duration::from_secs(10));
    let last = &said.last().unwrap().1;
    assert!(said.iter().filter(|(_, message)| message.is_answer).count() == 4 && last.is_answer);
    assert_eq!(said[0].1.questions[0].name, link.responder.name(0), "tried again under the new name");
}

#[test]
fn a_name_that_is_taken_later_is_tried_again_and_changed_only_if_they_stand_by_it() {
    let mut link = Link::announced();
    let host = link.responder.host();
    // What it has said itself comes back, and others say the same of the same computer.
    let own = link.responder.packet(0, true);
    link.take(&own);
    assert_eq!(link.responder.phase, Phase::Announced);
    // Whoever goes does not contradict.
    let mut gone = Link::other(&host, kind::A);
    gone.answers[0].ttl_s = 0;
    link.take(&gone);
    assert_eq!(link.responder.phase, Phase::Announced);
    link.take(&Link::other(&host, kind::A));
    assert_eq!(link.responder.phase, Phase::Probing(0));
    assert_eq!(link.responder.goodbye(), []);
    link.pass(Duration::from_millis(400));
    assert_eq!(link.names()[2], "cantap-lab");
    link.take(&Link::other(&host, kind::A));
    assert_eq!(link.names()[2], "cantap-lab-2");
    link.pass(Duration::from_secs(10));
    assert_eq!(link.responder.phase, Phase::Announced);
}

#[test]
fn of_two_that_want_a_name_at_once_one_waits() {
    let mut link = Link::new();
    link.pass(Duration::from_millis(300));
    let greater = Record::address(link.responder.host(), 120, IpAddr::from([192, 0, 2, 8]));
    let proposal = |record: &Record| Message {
        proposed: vec![record.clone()],
        ..Message::question(record.name.clone(), kind::ANY)
    };
    // Its own, which comes back, and a smaller one.
    let own = link.responder.probe(0);
    link.take(&own);
    link.take(&proposal(&Record::address(greater.name.clone(), 120, IpAddr::from([192, 0, 2, 6]))));
    assert!(matches!(link.responder.phase, Phase::Probing(1..)));
    link.take(&proposal(&greater));
    assert_eq!(link.responder.due(), Some(link.now + GIVE_WAY));
    assert_eq!(link.names()[2], "cantap-lab");
}

/// Somebody who contradicts without end makes no flood of tries.
#[test]
fn after_many_conflicts_each_try_waits() {
    let mut link = Link::new();
    let mut said = 0;
    for _ in 0..60_000 {
        let host = link.responder.host();
        link.take(&Link::other(&host, kind::A));
        said += link.pass(Duration::from_millis(1)).len();
    }
    assert!(said < 200, "{said} packets in a minute");
    let names = link.names();
    assert!(names[2].len() <= MOST_LABEL, "{names:?}");
}

#[test]
fn a_name_and_its_number_have_room() {
    let own = Own { base: "é".repeat(40), number: 1234 };
    let label = own.label(" (", ")");
    assert!(label.len() <= MOST_LABEL && label.ends_with("é (1234)"), "{label}");
}
