//! Clients on other computers: the certificate shown decides what a client may do, and without one it
//! receives nothing.
#![cfg(feature = "tls")]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use cantap::device::{Link, is_idle};
use cantap::wire::Refusal;
use cantap::wire::message::{ChannelConfig, Mode, Role};
use cantap::{Channel, Device, DeviceError};
use cantap_serve::listen::Listening;
use cantap_serve::tls::{self, Files, Keys};
use cantap_serve::{Board, Settings};
use cantap_testing::process::wait_until;
use rcgen::{
    CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, Issuer, KeyPair, date_time_ymd,
};

const BITRATE_BPS: u32 = 500_000;

struct Served {
    board: Arc<Board>,
    listening: Listening,
    said: Arc<Mutex<Vec<String>>>,
}

fn serve(folder: &Path, most: Role) -> Served {
    let options: cantap_virtual::Options = "load=60".parse().unwrap();
    let connect = Box::new(move |_: Option<&str>| Ok(cantap_virtual::start(options.clone())?.into_link()));
    let said = Arc::new(Mutex::new(Vec::new()));
    let told = Arc::clone(&said);
    let tell = move |news: cantap_serve::News| told.lock().unwrap().push(news.to_string());
    let board = Arc::new(Board::start("board", connect, Settings::at(BITRATE_BPS), tell).unwrap());
    let keys = Keys::in_folder(folder).unwrap();
    let files = keys.add_server(&["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
    let server = tls::Server::new(&files, None).unwrap();
    let listening = tls::listen(&board, "127.0.0.1:0".parse().unwrap(), most, &server).unwrap();
    Served { board, listening, said }
}

impl Served {
    fn connect(&self, host: &str, files: &Files) -> Result<Device, String> {
        let address = format!("{host}:{}", self.listening.address().unwrap().port());
        let link = tls::connect(&address, files).map_err(|error| error.to_string())?;
        Device::over(link, "far").map_err(|error| error.to_string())
    }
}

fn normal(device: &Device) -> Result<ChannelConfig, DeviceError> {
    let config = ChannelConfig::listen_only(device.timing(BITRATE_BPS)?);
    device.open_channel(Channel::Can1, Some(ChannelConfig { mode: Mode::Normal, ..config }))
}

fn refuses_to_send(device: &Device) {
    let refused = normal(device);
    let is_role =
        matches!(refused, Err(DeviceError::Refused { refusal: Refusal::NotGranted { needs: Role::Send } }));
    assert!(is_role, "{refused:?}");
}

#[test]
fn a_capture_over_tls_is_the_same_as_a_local_one_and_the_certificate_says_what_is_allowed() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path(), Role::Send);
    // Clients are added later, by the existing authority.
    let keys = Keys::in_folder(folder.path()).unwrap();
    let listener = keys.add_client("listener", Role::Listen).unwrap();
    let sender = keys.add_client("sender", Role::Send).unwrap();
    let beside = Device::over(served.board.link("near", Role::Listen).unwrap(), "near").unwrap();
    let far = served.connect("localhost", &listener).unwrap();
    for device in [&beside, &far] {
        device.listen(Channel::Can1, BITRATE_BPS).unwrap();
    }
    std::thread::sleep(Duration::from_millis(500));
    let frames = |device: &Device| {
        device.stop().unwrap();
        let counters = device.counters().channels[0];
        assert_eq!(counters.lost(), 0, "{counters:?}");
        let all = device.records().filter_map(|record| Some(record.unwrap().frame()?.to_string()));
        all.collect::<Vec<_>>()
    };
    let refused = normal(&far);
    assert!(matches!(refused, Err(DeviceError::Refused { refusal: Refusal::ChannelOpen })), "{refused:?}");
    let (far_frames, near_frames) = (frames(&far), frames(&beside));
    let at = near_frames.windows(8).position(|window| window == &far_frames[..8]).expect("common frames");
    let common = far_frames.len().min(near_frames.len() - at);
    assert!(common > 100, "{common}");
    assert_eq!(far_frames[..common], near_frames[at..at + common]);
    refuses_to_send(&served.connect("localhost", &listener).unwrap());
    normal(&served.connect("127.0.0.1", &sender).unwrap()).unwrap();
}

#[test]
fn the_server_grants_no_more_than_it_was_set_to() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path(), Role::Listen);
    let sender = Keys::in_folder(folder.path()).unwrap().add_client("sender", Role::Send).unwrap();
    let device = served.connect("localhost", &sender).unwrap();
    refuses_to_send(&device);
    device.listen(Channel::Can1, BITRATE_BPS).unwrap();
}

#[test]
fn strangers_and_untrusted_certificates_receive_nothing() {
    let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let served = serve(folder.path(), Role::Send);
    let keys = Keys::in_folder(folder.path()).unwrap();
    let good = keys.add_client("good", Role::Listen).unwrap();
    let foreign = Keys::in_folder(other.path()).unwrap().add_client("good", Role::Send).unwrap();
    // Another authority's client; a server that is not from the authority that the client trusts; a server's key used as a
    // client's.
    let of_stranger = Files { authority: good.authority.clone(), ..foreign.clone() };
    let of_server = Keys::files(folder.path(), "server");
    for files in [&of_stranger, &foreign, &of_server] {
        let refused = served.connect("localhost", files);
        assert!(refused.is_err(), "{files:?}");
    }
    // A name that is not in the server's certificate.
    assert!(served.connect("127.0.0.2", &good).is_err());
    // Plain text, nothing, and a flood: not one byte of ours before the peer has proved who it is.
    let address = served.listening.address().unwrap();
    let mut plain = TcpStream::connect(address).unwrap();
    plain.write_all(&[0, 2, 1, 6, 3, 0x9f, 0xe2, 0x8a, 0x67, 0]).unwrap();
    let flood: Vec<TcpStream> = (0..100).map(|_| TcpStream::connect(address).unwrap()).collect();
    let started = Instant::now();
    for mut stream in std::iter::once(plain).chain(flood) {
        stream.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
        let mut heard = Vec::new();
        // Ended or cut off; at most a TLS alert, which is seven bytes.
        let _ = stream.read_to_end(&mut heard);
        assert!(heard.len() <= 7, "{heard:?}");
    }
    assert!(started.elapsed() < Duration::from_secs(50), "{:?}", started.elapsed());
    assert_eq!(served.board.clients(), 0);
    served.connect("localhost", &good).unwrap();
    let said = served.said.lock().unwrap().join("\n");
    assert!(said.contains("was not let in"), "{said}");
}

/// A certificate from the folder's authority, for `hosts` and `purpose`, valid from 1 January of one year to that of
/// another.
fn forge(
    folder: &Path,
    name: &str,
    hosts: &[&str],
    purpose: ExtendedKeyUsagePurpose,
    years: [i32; 2],
) -> Files {
    let [since, until] = years.map(|year| date_time_ymd(year, 1, 1).unix_timestamp());
    forge_for(folder, name, hosts, purpose, [since, until])
}

/// The same, valid between two times, in seconds since 1970.
fn forge_for(
    folder: &Path,
    name: &str,
    hosts: &[&str],
    purpose: ExtendedKeyUsagePurpose,
    times_s: [i64; 2],
) -> Files {
    let authority = KeyPair::from_pem(&std::fs::read_to_string(folder.join("ca-key.pem")).unwrap()).unwrap();
    let mut issuer = CertificateParams::default();
    issuer.distinguished_name = DistinguishedName::new();
    issuer.distinguished_name.push(DnType::OrganizationName, "cantap");
    issuer.distinguished_name.push(DnType::CommonName, "authority");
    let hosts: Vec<String> = hosts.iter().map(|host| (*host).to_owned()).collect();
    let mut params = CertificateParams::new(hosts).unwrap();
    params.extended_key_usages = vec![purpose];
    let at = |s: i64| date_time_ymd(1970, 1, 1) + Duration::from_secs(s.try_into().unwrap());
    let [since, until] = times_s.map(at);
    (params.not_before, params.not_after) = (since, until);
    let key = KeyPair::generate().unwrap();
    let certificate = params.signed_by(&key, &Issuer::from_params(&issuer, &authority)).unwrap();
    let files = Keys::files(folder, name);
    std::fs::write(&files.certificate, certificate.pem()).unwrap();
    std::fs::write(&files.key, key.serialize_pem()).unwrap();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        std::fs::set_permissions(&files.key, std::fs::Permissions::from_mode(0o600)).unwrap();
    }
    files
}

const ROLE: &str = "send.role.cantap.invalid";
const NOW: [i32; 2] = [2020, 2060];

/// Each is from the right authority, and differs from a good one in one respect.
#[test]
fn certificates_that_are_expired_not_valid_yet_or_name_no_role_let_nobody_in() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path(), Role::Send);
    let client = |name: &str, hosts: &[&str], years: [i32; 2]| {
        forge(folder.path(), name, hosts, ExtendedKeyUsagePurpose::ClientAuth, years)
    };
    normal(&served.connect("localhost", &client("good", &[ROLE], NOW)).unwrap()).unwrap();
    for (files, part) in [
        (client("expired", &[ROLE], [2010, 2020]), "expired"),
        (client("early", &[ROLE], [2090, 2100]), "not valid yet"),
        (client("no-role", &["localhost"], NOW), "says nothing of what it may do"),
        (client("other-role", &["root.role.cantap.invalid"], NOW), "says nothing of what it may do"),
    ] {
        let refused = served.connect("localhost", &files).err().expect("it is refused");
        wait_until("it did not come to be", || {
            let said = served.said.lock().unwrap().join("\n");
            said.contains("was not let in") && said.contains(part)
        });
        served.said.lock().unwrap().clear();
        assert!(!refused.is_empty());
    }
    assert_eq!(served.board.clients(), 0);
    // And the other way round: a client does not connect to a server whose certificate has expired or is a
    // client's.
    for (purpose, years) in
        [(ExtendedKeyUsagePurpose::ServerAuth, [2010, 2020]), (ExtendedKeyUsagePurpose::ClientAuth, NOW)]
    {
        let of_server = forge(folder.path(), "other-server", &["localhost"], purpose, years);
        let server = tls::Server::new(&of_server, None).unwrap();
        let listening =
            tls::listen(&served.board, "127.0.0.1:0".parse().unwrap(), Role::Send, &server).unwrap();
        let address = format!("localhost:{}", listening.address().unwrap().port());
        let good = Keys::files(folder.path(), "good");
        assert!(tls::connect(&address, &good).is_err(), "{years:?}");
    }
}

/// A certificate that expires while its clients are connected; and TLS lets a client come back without showing it again.
#[test]
fn a_certificate_that_expires_lets_its_clients_go_and_not_come_back() {
    use rustls::pki_types::pem::PemObject;
    use rustls::pki_types::{CertificateDer, PrivateKeyDer};
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path(), Role::Send);
    let now_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs() as i64;
    let purpose = ExtendedKeyUsagePurpose::ClientAuth;
    let files = forge_for(folder.path(), "brief", &[ROLE], purpose, [now_s - 60, now_s + 15]);
    let mut roots = rustls::RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(&files.authority).unwrap()).unwrap();
    let chain = vec![CertificateDer::from_pem_file(&files.certificate).unwrap()];
    let key = PrivateKeyDer::from_pem_file(&files.key).unwrap();
    let config =
        rustls::ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .with_root_certificates(roots)
            .with_client_auth_cert(chain, key)
            .unwrap();
    let config = Arc::new(config);
    let dial = || {
        let host = "localhost".try_into().unwrap();
        let connection = rustls::ClientConnection::new(Arc::clone(&config), host).unwrap();
        let stream = TcpStream::connect(served.listening.address().unwrap()).unwrap();
        rustls::StreamOwned::new(connection, stream)
    };
    // It is given tickets for the next time.
    let mut first = dial();
    first.flush().unwrap();
    first.sock.set_read_timeout(Some(Duration::from_millis(500))).unwrap();
    assert!(first.read(&mut [0; 100]).is_err_and(|error| is_idle(&error)));
    let device = served.connect("localhost", &files).unwrap();
    normal(&device).unwrap();
    let has_said = |wanted: &str| served.said.lock().unwrap().iter().any(|said| said.contains(wanted));
    wait_until("nobody was let go", || has_said("no longer trusted"));
    drop(device);
    let mut again = dial();
    let mut said = Vec::new();
    let _ = again.read_to_end(&mut said);
    assert_eq!(again.conn.handshake_kind(), Some(rustls::HandshakeKind::Resumed));
    let said = String::from_utf8_lossy(&said);
    assert!(said.contains("its certificate is no longer trusted"), "'{said}'");
}

/// Peers that stop in the middle: in TLS's first message, during the handshake a byte at a time, and after it without sending
/// anything of ours.
#[test]
fn half_open_peers_are_let_go_and_the_others_are_served_meanwhile() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path(), Role::Send);
    let good = Keys::in_folder(folder.path()).unwrap().add_client("good", Role::Listen).unwrap();
    let address = served.listening.address().unwrap();
    // TLS's record header for a first message that never arrives.
    let begun = |rest: &[u8]| {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.write_all(&[0x16, 3, 1, 2, 0]).unwrap();
        stream.write_all(rest).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(12))).unwrap();
        stream
    };
    let mut silent = begun(&[]);
    let mut slow = begun(&[1]);
    let mut drip = slow.try_clone().unwrap();
    std::thread::spawn(move || {
        while drip.write_all(&[0]).is_ok() {
            std::thread::sleep(Duration::from_millis(30));
        }
    });
    let started = Instant::now();
    // Completes the handshake, then sends nothing.
    let mute = tls::connect(&format!("localhost:{}", address.port()), &good).unwrap();
    wait_until("the half-open ones are still there", || served.board.clients() == 1);
    let device = served.connect("localhost", &good).unwrap();
    device.listen(Channel::Can1, BITRATE_BPS).unwrap();
    for stream in [&mut silent, &mut slow] {
        let mut heard = Vec::new();
        let _ = stream.read_to_end(&mut heard);
        assert!(heard.len() <= 7, "{heard:?}");
    }
    let Link { mut reader, .. } = mute;
    let mut heard = [0; 64];
    let closed = loop {
        match reader.read(&mut heard) {
            Err(error) if is_idle(&error) => {}
            closed => break closed,
        }
    };
    assert!(matches!(closed, Ok(0) | Err(_)), "{closed:?}");
    assert!(started.elapsed() < Duration::from_secs(50), "{:?}", started.elapsed());
    assert_eq!(served.board.clients(), 1);
    assert!(device.counters().channels[0].received > 100);
    assert_eq!(device.counters().channels[0].lost(), 0);
}

#[test]
fn keys_are_secret_and_nothing_is_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let keys = Keys::in_folder(folder.path()).unwrap();
    let files = keys.add_client("alice", Role::Listen).unwrap();
    #[cfg(unix)]
    for key in [files.key, folder.path().join("ca-key.pem")] {
        use std::os::unix::fs::PermissionsExt;
        assert_eq!(std::fs::metadata(key).unwrap().permissions().mode() & 0o777, 0o600);
    }
    assert!(keys.add_client("alice", Role::Send).unwrap_err().to_string().contains("already exists"));
    for name in ["", "../x", "a b", "ca-key"] {
        assert!(keys.add_client(name, Role::Listen).is_err(), "{name}");
    }
    let missing = Keys::files(folder.path(), "nobody");
    assert!(tls::Server::new(&missing, None).err().unwrap().to_string().contains("nobody"));
}

/// Peers that connect and say nothing, and come again whenever they are let go, keep nobody out.
#[test]
fn silent_peers_keep_nobody_out() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path(), Role::Listen);
    let files = Keys::in_folder(folder.path()).unwrap().add_client("good", Role::Listen).unwrap();
    let address = served.listening.address().unwrap();
    let is_over = Arc::new(std::sync::atomic::AtomicBool::new(false));
    let strangers: Vec<_> = (0..100)
        .map(|_| {
            let is_over = Arc::clone(&is_over);
            std::thread::spawn(move || {
                while !is_over.load(std::sync::atomic::Ordering::Relaxed) {
                    let Ok(mut stream) = TcpStream::connect(address) else { continue };
                    let _ = stream.set_read_timeout(Some(Duration::from_millis(200)));
                    while !is_over.load(std::sync::atomic::Ordering::Relaxed)
                        && !matches!(stream.read(&mut [0]), Ok(0))
                    {}
                }
            })
        })
        .collect();
    std::thread::sleep(Duration::from_millis(300));
    for _ in 0..5 {
        // Of those that have not spoken, the oldest goes first: on a computer that is slow enough, that may be the one that is about to.
        wait_until("a client gets in", || served.connect("localhost", &files).is_ok());
    }
    is_over.store(true, std::sync::atomic::Ordering::Relaxed);
    for stranger in strangers {
        stranger.join().unwrap();
    }
}

#[cfg(unix)]
#[test]
fn a_key_that_others_can_read_is_refused() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let files = Keys::in_folder(folder.path()).unwrap().add_server(&["localhost".to_owned()]).unwrap();
    assert!(tls::Server::new(&files, None).is_ok());
    std::fs::set_permissions(&files.key, PermissionsExt::from_mode(0o644)).unwrap();
    let refused = tls::Server::new(&files, None).err().unwrap().to_string();
    assert!(refused.ends_with("other users can use it; `chmod 600` it"), "{refused}");
}

#[test]
fn a_server_s_certificate_is_for_named_computers() {
    let folder = tempfile::tempdir().unwrap();
    let keys = Keys::in_folder(folder.path()).unwrap();
    for host in ["*", "*.example", "", "a b"] {
        let refused = keys.add_server(&["localhost".to_owned(), host.to_owned()]);
        assert!(refused.is_err_and(|error| error.to_string().contains("one computer")), "{host}");
    }
}
