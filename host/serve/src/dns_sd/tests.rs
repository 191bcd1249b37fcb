use super::*;
use std::net::{Ipv4Addr, UdpSocket};
use std::sync::mpsc;

/// Multicast DNS at a port of its own, on this computer alone.
fn network() -> Network {
    let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    Network { port, with_loopback: true }
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

/// What is found while somebody says this, again and again.
fn found_while(packets: Vec<Vec<u8>>, enough: impl Fn(&Browsed) -> bool) -> Browsed {
    let network = network();
    let (done, ends) = mpsc::channel::<()>();
    let liar = std::thread::spawn(move || {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        while ends.try_recv() == Err(mpsc::TryRecvError::Empty) {
            for packet in &packets {
                let _ = socket.send_to(packet, (Ipv4Addr::LOCALHOST, network.port));
                std::thread::sleep(Duration::from_micros(500));
            }
        }
    });
    // As often as it takes on a busy computer.
    let mut browsed = Browsed::default();
    for _ in 0..20 {
        browsed = browse_on(network, Duration::from_secs(1)).unwrap();
        if enough(&browsed) {
            break;
        }
    }
    drop(done);
    liar.join().unwrap();
    browsed
}

#[test]
fn a_server_that_is_announced_is_found_with_its_serial_number() {
    let network = network();
    let address: SocketAddr = "127.0.0.1:29537".parse().unwrap();
    let announcing =
        announce_on(network, &[Listener { serial: Some("0042.A\\B".to_owned()), address }]).unwrap();
    let finds = || browse_on(network, Duration::from_secs(1)).unwrap();
    let found = std::iter::repeat_with(finds).take(20).find(|found| !found.servers.is_empty()).unwrap();
    assert_eq!((found.servers.len(), found.servers[0].place, found.unusable), (1, address, 0));
    assert!(found.servers[0].name.starts_with("cantap 0042.A\\B"), "{found:?}");
    drop(announcing);
    assert_eq!(finds(), Browsed::default());
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
        let ips: Vec<IpAddr> = ips.iter().map(|ip| ip.parse().unwrap()).collect();
        let service = ServiceInfo::new(SERVICE, "x", "host.local.", &ips[..], 7, None).unwrap();
        read(&service.as_resolved_service(), false).map(|server| server.place.to_string())
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
    let mut packets: Vec<Vec<u8>> = (1..whole.len()).step_by(7).map(|cut| whole[..cut].to_vec()).collect();
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
    assert!(found.servers.len() <= MOST_FOUND && found.is_cut, "{} {}", found.servers.len(), found.left_out);
    assert!(found.left_out > 0);
}

/// What others say is counted, a flood of it is thrown away, and what is announced is still found.
#[test]
fn records_that_nobody_asked_for_are_counted_and_survived() {
    let network = network();
    let address: SocketAddr = "127.0.0.1:29537".parse().unwrap();
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let flood = || {
        for number in 0..2 * MOST_RECORDS {
            let owner = name(&[format!("x{number}").as_bytes(), b"local"]);
            let records = answer(&[record(&owner, 1, &[127, 0, 0, 1])]);
            socket.send_to(&records, (Ipv4Addr::LOCALHOST, network.port)).unwrap();
        }
    };
    let listener = Listener { serial: None, address };
    let daemon = begin(network, &[service(&listener).unwrap()]).unwrap();
    // As often as it takes: this computer may drop some.
    let counts = std::iter::repeat_with(|| {
        flood();
        records(&daemon).unwrap()
    });
    assert!(counts.take(100).any(|count| count > MOST_RECORDS));
    daemon.shutdown().unwrap().recv().unwrap();
    let announcing = announce_on(network, &[listener]).unwrap();
    for _ in 0..100 {
        flood();
        std::thread::sleep(LOOK_EVERY);
        if announcing.begun_anew.load(Ordering::Relaxed) > 0 {
            break;
        }
    }
    assert!(announcing.begun_anew.load(Ordering::Relaxed) > 0);
    let finds = || browse_on(network, Duration::from_secs(1)).unwrap();
    let found = std::iter::repeat_with(finds).take(20).find(|found| !found.servers.is_empty()).unwrap();
    assert_eq!(found.servers[0].place, address);
    drop(announcing);
}

proptest::proptest! {
    #[test]
    fn any_name_is_cut_to_what_has_room(text in "(\\\\|\\.|é|.){0,80}") {
        proptest::prop_assert!(up_to_bytes(&text, MOST_LABEL).len() <= MOST_LABEL);
    }
}
