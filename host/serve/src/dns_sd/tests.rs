use super::announcing::announce_on;
use super::browse::{browse_on, usable};
use super::link::{Link, Speaker};
use super::message::{MOST_BYTES, Message, Question, Record, kind, up_to_bytes};
use super::*;
use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr, UdpSocket};
use std::sync::mpsc;
use std::time::{Duration, Instant};

const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

/// Multicast DNS at a port of its own, on this computer alone.
fn network() -> Network {
    let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    Network { port, with_loopback: true }
}

fn speaker(network: Network) -> Speaker {
    Link::of(SocketAddr::new(HERE, 0)).unwrap().listening(network).unwrap()
}

/// A name on the wire, of parts as they are.
fn name(parts: &[&[u8]]) -> Vec<u8> {
    let parts = parts.iter().map(|part| [&[part.len() as u8][..], part].concat());
    parts.chain([vec![0]]).collect::<Vec<_>>().concat()
}

fn of_service(instance: &[u8]) -> Vec<u8> {
    name(&[instance, b"_cantap", b"_tcp", b"local"])
}

fn record(owner: &[u8], kind: u16, data: &[u8]) -> Vec<u8> {
    let len = (data.len() as u16).to_be_bytes();
    [owner, &kind.to_be_bytes(), &[0x80, 1, 0, 0, 0, 120], &len, data].concat()
}

/// An answer of several records.
fn answer(records: &[Vec<u8>]) -> Vec<u8> {
    let count = (records.len() as u16).to_be_bytes();
    [&[0, 0, 0x84, 0, 0, 0][..], &count, &[0, 0, 0, 0], &records.concat()].concat()
}

/// A service: its pointer, where it is, and its address.
fn server(instance: &[u8], port: u16, ip: Ipv4Addr) -> Vec<u8> {
    let host = name(&[b"host", b"local"]);
    let place = [&[0, 0, 0, 0][..], &port.to_be_bytes(), &host].concat();
    let kind = name(&[b"_cantap", b"_tcp", b"local"]);
    let pointer = record(&kind, 12, &of_service(instance));
    let text = record(&of_service(instance), 16, &[0]);
    answer(&[pointer, record(&of_service(instance), 33, &place), text, record(&host, 1, &ip.octets())])
}

/// Somebody on the link, until this is dropped.
struct Somebody {
    done: Option<mpsc::Sender<()>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Drop for Somebody {
    fn drop(&mut self) {
        self.done = None;
        let ended = self.thread.take().unwrap().join();
        assert!(ended.is_ok() || std::thread::panicking());
    }
}

/// Who does something with each message that is said.
fn somebody(
    network: Network,
    mut hear: impl FnMut(&Speaker, &Message, SocketAddr) + Send + 'static,
) -> Somebody {
    let speaker = speaker(network);
    let (done, ends) = mpsc::channel::<()>();
    let thread = std::thread::spawn(move || {
        let mut bytes = vec![0; MOST_BYTES];
        while ends.try_recv() == Err(mpsc::TryRecvError::Empty) {
            let heard = speaker.hear_within(&mut bytes, Duration::from_millis(20)).unwrap();
            let Some((len, from)) = heard else { continue };
            if let Some(message) = Message::read(&bytes[..len]) {
                hear(&speaker, &message, from);
            }
        }
    });
    Somebody { done: Some(done), thread: Some(thread) }
}

/// What is found while somebody answers with this, whatever is asked.
fn found_while(packets: Vec<Vec<u8>>, enough: impl Fn(&Browsed) -> bool) -> Browsed {
    let network = network();
    let _liar = somebody(network, move |speaker, message, from| {
        for packet in &packets {
            let mut packet = packet.clone();
            packet.splice(..2, message.id.to_be_bytes());
            speaker.tell_bytes(from, &packet);
            std::thread::sleep(Duration::from_micros(500));
        }
    });
    found(network, enough)
}

/// What is found, asking as often and as long as it takes on a busy computer.
fn found(network: Network, enough: impl Fn(&Browsed) -> bool) -> Browsed {
    let mut browsed = Browsed::default();
    for seconds in 1..20 {
        browsed = browse_on(network, Duration::from_secs(seconds)).unwrap();
        if enough(&browsed) {
            break;
        }
    }
    browsed
}

fn address(port: u16) -> SocketAddr {
    SocketAddr::new(HERE, port)
}

fn listener(serial: &str, port: u16) -> Listener {
    Listener { serial: Some(serial.to_owned()), address: address(port) }
}

#[test]
fn servers_that_are_announced_are_found_with_their_serial_numbers() {
    let network = network();
    let announcing =
        announce_on(network, &[listener("0042.A\\B", 29_537), listener("0043", 29_538)]).unwrap();
    let found = found(network, |found| found.servers.len() == 2);
    let places: Vec<SocketAddr> = found.servers.iter().map(|server| server.place).collect();
    assert_eq!((places, found.unusable), (vec![address(29_537), address(29_538)], 0), "{found:?}");
    assert!(found.servers[0].name.starts_with("cantap 0042.A\\B"), "{found:?}");
    drop(announcing);
    assert_eq!(browse_on(network, Duration::from_secs(1)).unwrap(), Browsed::default());
}

/// A listener of IPv6 is not at the address of IPv4 that the host's other name has.
#[test]
fn each_kind_of_address_has_a_host_s_name_of_its_own() {
    let six: IpAddr = "fd00::2".parse().unwrap();
    assert_ne!(announcing::host_label(HERE), announcing::host_label(six));
}

/// Another computer has the names already, and says so when they are tried.
#[test]
fn a_name_that_another_responder_has_is_left_to_it() {
    let network = network();
    let theirs = |question: &Question| {
        let is_host = question.name.first_before(&Name::of(&["local"])).is_some();
        let data = if is_host { vec![192, 0, 2, 99] } else { vec![0] };
        let kind = if is_host { kind::A } else { kind::TXT };
        Record::new(question.name.clone(), kind, 120, data)
    };
    let mut had = BTreeSet::new();
    let _other = somebody(network, move |speaker, message, _| {
        let tried = message.questions.iter().filter(|_| !message.is_answer && !message.proposed.is_empty());
        let tried: Vec<&Question> = tried.collect();
        // It has one of each, and not those that are taken then.
        if had.is_empty() {
            had.extend(tried.iter().map(|question| question.name.clone()));
        }
        let own: Vec<Record> =
            tried.into_iter().filter(|question| had.contains(&question.name)).map(theirs).collect();
        if !own.is_empty() {
            speaker.tell_all(&Message::answer(own));
        }
    });
    let _announcing = announce_on(network, &[listener("7", 29_537)]).unwrap();
    let found = found(network, |found| !found.servers.is_empty());
    let [server] = &found.servers[..] else { panic!("{found:?}") };
    assert_eq!(server.place, address(29_537));
    assert!(server.name.starts_with("cantap 7") && server.name.ends_with("(2)"), "{found:?}");
}

/// Another program's responder, which has the name first; each finds both.
#[test]
fn a_responder_of_somebody_else_s_keeps_its_name() {
    use mdns_sd::{IfKind, ServiceDaemon, ServiceEvent, ServiceInfo};
    let network = network();
    let daemon = ServiceDaemon::new_with_port(network.port).unwrap();
    daemon.disable_interface(IfKind::All).unwrap();
    daemon.enable_interface(IfKind::Addr(HERE)).unwrap();
    let label = announcing::service(&listener("7", 1)).label;
    let theirs = ServiceInfo::new(SERVICE, &label, "other.local.", HERE, 2, None).unwrap();
    daemon.register(theirs).unwrap();
    let first = found(network, |found| !found.servers.is_empty());
    let place =
        |found: &Browsed, number: usize| (found.servers[number].place, found.servers[number].name.clone());
    assert_eq!(place(&first, 0), (address(2), label.clone()), "{first:?}");
    let announcing = announce_on(network, &[listener("7", 1)]).unwrap();
    let both = found(network, |found| found.servers.len() == 2);
    assert_eq!(place(&both, 0), (address(2), label.clone()), "{both:?}");
    assert_eq!(place(&both, 1), (address(1), format!("{label} (2)")), "{both:?}");
    // And it finds us.
    let events = daemon.browse(SERVICE).unwrap();
    let mut ports = BTreeSet::new();
    while ports.len() < 2 {
        if let ServiceEvent::ServiceResolved(service) = events.recv_timeout(Duration::from_secs(30)).unwrap()
        {
            ports.insert(service.port);
        }
    }
    assert_eq!(ports, BTreeSet::from([1, 2]));
    drop(announcing);
    let gone = |event| matches!(event, ServiceEvent::ServiceRemoved(_, name) if name.contains("(2)"));
    while !gone(events.recv_timeout(Duration::from_secs(30)).unwrap()) {}
    daemon.shutdown().unwrap().recv().unwrap();
}

/// Two servers of ours with the same board's name, on one link.
#[test]
fn two_servers_that_want_one_name_have_two() {
    let network = network();
    let _one = announce_on(network, &[listener("7", 1)]).unwrap();
    let _other = announce_on(network, &[listener("7", 2)]).unwrap();
    let found = found(network, |found| found.servers.len() == 2);
    let names: BTreeSet<&str> = found.servers.iter().map(|server| server.name.as_str()).collect();
    assert_eq!((found.servers.len(), names.len()), (2, 2), "{found:?}");
}

/// Nothing that everybody hears is said more than once a second, however often it is asked for.
#[test]
fn a_flood_of_questions_is_no_flood_of_answers() {
    let network = network();
    let _announcing = announce_on(network, &[listener("7", 1)]).unwrap();
    found(network, |found| !found.servers.is_empty());
    let here = speaker(network);
    let question = Message::question(kind_name(), kind::PTR);
    let (began, mut asked, mut answered) = (Instant::now(), 0, 0);
    let mut bytes = vec![0; MOST_BYTES];
    while began.elapsed() < Duration::from_secs(3) {
        here.tell_all(&question);
        asked += 1;
        while let Some((len, _)) = here.hear_within(&mut bytes, Duration::from_millis(1)).unwrap() {
            answered += u32::from(Message::read(&bytes[..len]).unwrap().is_answer);
        }
    }
    let most = began.elapsed().as_secs() as u32 + 2;
    assert!(asked > 50 && (1..=most).contains(&answered), "{asked} questions, {answered} answers");
}

/// A stranger's question that reaches the link from another network: nobody there is told of the board.
#[test]
fn a_question_from_another_network_is_not_answered() {
    let far =
        Link::all().unwrap().into_iter().map(|link| link.ip()).find(|ip| ip.is_ipv4() && !ip.is_loopback());
    let Some(far) = far else { return eprintln!("skipped: this computer has one address") };
    let network = network();
    let _announcing = announce_on(network, &[listener("7", 1)]).unwrap();
    let asking = |from: IpAddr| {
        let socket = UdpSocket::bind((from, 0)).unwrap();
        socket2::SockRef::from(&socket).set_multicast_if_v4(&Ipv4Addr::LOCALHOST).unwrap();
        socket.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        socket
    };
    let (near, far) = (asking(HERE), asking(far));
    let question = Message::question(kind_name(), kind::PTR).bytes();
    let ask = |socket: &UdpSocket| socket.send_to(&question, ("224.0.0.251", network.port)).unwrap();
    let is_answered = |socket: &UdpSocket| socket.recv(&mut [0; MOST_BYTES]).is_ok();
    let mut asked_before = 0;
    // Once the names have been tried, whoever is on the link is answered: the other one's questions were there before.
    let answered = (0..200).any(|_| {
        asked_before += 1;
        ask(&far);
        ask(&near);
        is_answered(&near)
    });
    assert!(answered && asked_before > 0 && !is_answered(&far));
}

/// Loopback's network has 16 million addresses, so that nothing on this computer comes from elsewhere; but an answer that nobody could know to
/// give is not believed.
#[test]
fn answers_to_another_question_are_not_believed() {
    let network = network();
    let _liar = somebody(network, move |speaker, message, from| {
        let mut packet = server(b"liar", 4, Ipv4Addr::LOCALHOST);
        packet.splice(..2, message.id.wrapping_add(1).to_be_bytes());
        speaker.tell_bytes(from, &packet);
        // Nor is one from another port than that of multicast DNS.
        packet.splice(..2, message.id.to_be_bytes());
        UdpSocket::bind("127.0.0.1:0").unwrap().send_to(&packet, from).unwrap();
    });
    assert_eq!(browse_on(network, Duration::from_secs(2)).unwrap(), Browsed::default());
}

#[test]
fn names_of_strangers_are_cleaned_and_places_that_lead_nowhere_are_counted() {
    let local = Ipv4Addr::LOCALHOST;
    let long = [b'x'; 63];
    let packets = vec![
        server("\u{1b}[2Jx\u{202e}\\.".as_bytes(), 1, local),
        server(&long, 2, local),
        server(b"no port", 0, local),
    ];
    let found = found_while(packets, |found| found.servers.len() == 2 && found.unusable == 1);
    let names: BTreeSet<&str> = found.servers.iter().map(|server| server.name.as_str()).collect();
    assert!(names.iter().all(|name| !name.contains(['\u{1b}', '\u{202e}'])), "{names:?}");
    assert!(names.contains("x".repeat(63).as_str()) && names.len() == 2, "{names:?}");
    assert_eq!((found.unusable, found.is_cut), (1, false));
}

/// An address that leads back to whoever tries it, to everybody or to nobody.
#[test]
fn addresses_that_no_other_computer_can_have_are_not_believed() {
    let place = |ips: &[&str]| {
        let ips = ips.iter().map(|ip| ip.parse().unwrap()).collect();
        usable(7, &ips, false).map(|place| place.to_string())
    };
    for ip in [
        "127.0.0.1",
        "127.9.9.9",
        "0.0.0.0",
        "255.255.255.255",
        "224.0.0.251",
        "::1",
        "::",
        "ff02::fb",
        "fe80::1",
        "::ffff:127.0.0.1",
    ] {
        assert_eq!(place(&[ip]), None, "{ip}");
    }
    assert_eq!(place(&["127.0.0.1", "fd00::2", "192.0.2.7"]).as_deref(), Some("192.0.2.7:7"));
    assert_eq!(place(&["::1", "fd00::2"]).as_deref(), Some("[fd00::2]:7"));
}

#[test]
fn names_that_lead_in_circles_and_packets_that_end_too_early_keep_no_server_from_being_found() {
    let whole = server(b"true", 4, Ipv4Addr::LOCALHOST);
    let mut packets: Vec<Vec<u8>> = (2..whole.len()).step_by(7).map(|cut| whole[..cut].to_vec()).collect();
    // A pointer to itself, two that point to each other, one behind the end, and a record that says it is longer.
    for pointers in [&[0xC0, 12][..], &[0xC0, 14, 0xC0, 12], &[0xFF, 0xFF]] {
        packets.push(answer(&[record(pointers, 12, pointers)]));
    }
    packets.push([&whole[..12], &name(&[b"x"]), &[0, 12, 0x80, 1, 0, 0, 0, 1, 0xFF, 0xFF]].concat());
    packets.push(vec![0xFF; 9000]);
    packets.push(whole);
    let found = found_while(packets, |found| !found.servers.is_empty());
    assert_eq!(
        found.servers,
        [AnnouncedServer { place: "127.0.0.1:4".parse().unwrap(), name: "true".to_owned() }]
    );
}

#[test]
fn whoever_invents_servers_by_the_thousand_fills_no_list() {
    let packets =
        (0..1500).map(|number| server(format!("liar {number}").as_bytes(), 9, Ipv4Addr::LOCALHOST)).collect();
    let found = found_while(packets, |found| found.is_cut);
    assert!(found.servers.len() <= 256 && found.is_cut, "{} {}", found.servers.len(), found.left_out);
    assert!(found.left_out > 0);
}

proptest::proptest! {
    #[test]
    fn any_name_is_cut_to_what_has_room(text in "(\\\\|\\.|é|.){0,80}") {
        proptest::prop_assert!(up_to_bytes(&text, 63).len() <= 63);
    }
}
