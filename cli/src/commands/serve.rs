//! `cantap serve`: a device for many programs at once, on this machine or on others.

#[cfg(feature = "tls")]
mod announcing;
mod doors;
#[cfg(feature = "tls")]
mod keys;
mod other_doors;
mod upkeep;
mod way;
mod web_door;

use std::io::{self, Read, Write};
#[cfg(not(unix))]
use std::net::Ipv4Addr;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use cantap::Channel;
use cantap::device::{channel_number, pipe, write_patiently};
use cantap::wire::CHANNELS;
use cantap::wire::message::capability;
use cantap_address::server::PORT;
use cantap_address::{Address, LinkError};
#[cfg(unix)]
use cantap_serve::listen;
use cantap_serve::listen::Listening;
#[cfg(unix)]
use cantap_serve::socket_file::{self, SocketError};
use cantap_serve::{Board, BoardError, News, Role, Settings, connect};

#[cfg(unix)]
use self::doors::numbered;
use self::doors::{Allowed, Door, TcpTunnelArg, TunnelArg, allow, allowed, loopback, tcp_tunnel, tunnel};
use self::other_doors::OtherDoors;
use self::upkeep::Upkeep;
use self::way::Way;
use self::web_door::WebDoor;
use crate::args;
use crate::database_args::DatabaseArgs;
use crate::protocols::ProtocolArgs;
use crate::stderr;
use crate::usage_error::usage;
use cantap_work::boards::Boards;
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::channels::Channels;
use cantap_work::interrupt;
use cantap_work::timing_options::TimingOptions;

/// The command line.
#[derive(clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_help = "Clients take -d unix:PATH, -d tcp://HOST:PORT or -d ssh://[USER@]HOST[/DEVICE] in place of a port, in \
                every command. A second device is at the same path with -2 behind its name, and at the next port.\n\n\
                Nothing is sent and nothing acknowledged while no client that may send has asked for it.\n\n\
                Examples:\n  \
                cantap serve -d /dev/ttyACM0 -b 500k\n  \
                cantap capture -d unix: -o drive.log\n  \
                cantap serve -d /dev/ttyACM0 -b 500k -b 2:250k --tcp --allow send\n  \
                cantap monitor -d tcp://127.0.0.1\n  \
                cantap capture -d ssh://me@vehicle/dev/ttyACM0 -b 500k -o drive.log\n  \
                cantap serve -d /dev/ttyACM0 -b 500k --web --db car.dbc\n  \
                cantap serve keygen keys --host vehicle --client alice:send\n  \
                cantap serve -d /dev/ttyACM0 -b 500k --tcp 192.0.2.7 \\\n      \
                --tls keys/server.pem,keys/server-key.pem --clients keys/ca.pem\n  \
                cantap serve -d /dev/ttyACM0 -b 500k --web 192.0.2.7 \\\n      \
                --tls keys/server.pem,keys/server-key.pem --clients keys/ca.pem"
)]
pub struct Args {
    #[cfg(feature = "tls")]
    #[command(subcommand)]
    keys: Option<keys::Command>,
    /// Where the device is: a serial port, or virtual. Repeat for several. Without it, the board that is connected.
    #[arg(short, long = "device", value_name = "DEVICE")]
    devices: Vec<Address>,
    /// Bit rate of the buses in bit/s: 500000, 500k, 1M; with a channel before it (2:250k), only for that channel. Can be
    /// repeated. Without it, the one saved on the device.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE")]
    bitrates: Vec<ChannelBitrate>,
    /// The maximum role of clients: listen (the default); configure, which allows choosing bit rates and storing settings, one client at a
    /// time for each channel; send, which includes acknowledging. With a listener before it (unix:send, tcp:send, socketcand:send, gvret:send,
    /// cannelloni:send, web:send), only for that one. Can be repeated. The last four are asked for no name (web: without --tls), and only listen
    /// unless they are named.
    #[arg(long = "allow", value_name = "ROLE", value_parser = allowed)]
    allowed: Vec<Allowed>,
    /// normal: the board acknowledges on its buses from the first listener on, so that no client that sends takes it off its bus for a
    /// moment.
    #[arg(long, value_name = "MODE", value_enum, default_value = "listen-only")]
    mode: Listeners,
    /// Periodic frames and replies of a client at --tcp or ssh that has said nothing for this long are stopped, as 2s; 0 for never.
    #[arg(long, value_name = "TIME", value_parser = time_limit, default_value = "2s")]
    dead_man: TimeLimit,
    /// A socketcand, GVRET or cannelloni client that has sent nothing for this long, and has the board send nothing periodically, only listens again, so
    /// that the board does not acknowledge for a program that has stopped; 0 for never.
    #[arg(long, value_name = "TIME", value_parser = time_limit, default_value = "60s")]
    idle: TimeLimit,
    /// Listen on a UNIX socket that only this user can reach; the default, at a path in the user's own
    /// folder.
    #[cfg(unix)]
    #[arg(long, value_name = "PATH")]
    unix: Option<PathBuf>,
    /// Listen on a TCP port of this computer, which all its users can reach; default 127.0.0.1:29537. Other addresses
    /// require --tls.
    #[arg(long, value_name = "ADDR:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1")]
    tcp: Option<String>,
    /// Admit clients from other computers at --tcp and --web, encrypted: this server's certificate and key (PEM).
    #[cfg(feature = "tls")]
    #[arg(long, value_name = "CERT,KEY", requires = "clients", value_parser = keys::two_files)]
    tls: Option<(PathBuf, PathBuf)>,
    /// Announce the listener at --tcp by DNS-SD to everybody on its network, so that `cantap list --network` finds it: with the board's serial number and
    /// this computer's name.
    #[cfg(feature = "tls")]
    #[arg(long, requires_all = ["tls", "tcp"])]
    announce: bool,
    /// The certificate of the authority that signed the clients' certificates.
    #[cfg(feature = "tls")]
    #[arg(long, value_name = "CA", requires = "tls")]
    clients: Option<PathBuf>,
    /// Speak the socketcand protocol, for SavvyCAN, Kayak and python-can; default 127.0.0.1:29536. At an address that other
    /// computers can reach, clients may only listen: the protocol has no authentication.
    #[arg(long, value_name = "ADDR:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1")]
    socketcand: Option<String>,
    /// Speak GVRET, for SavvyCAN, which takes the server for an ESP32RET; default 127.0.0.1:23, the only port that SavvyCAN knows, and which
    /// takes rights. At an address that other computers can reach, clients may only listen.
    #[arg(long, value_name = "ADDR:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1")]
    gvret: Option<String>,
    /// A cannelloni tunnel for a channel (without it, 1): the address here and the peer's, as 1:127.0.0.1:20000,127.0.0.1:20001. Datagrams of
    /// others are not taken. Can be repeated. If one of the two is not of this computer, the peer may only listen.
    #[arg(long = "cannelloni", value_name = "[CHANNEL:]ADDR:PORT,PEER:PORT", value_parser = tunnel)]
    tunnels: Vec<TunnelArg>,
    /// Admit cannelloni's clients over TCP to a channel (without it, 1); default 127.0.0.1:20000. Can be repeated. At an address that other computers can
    /// reach, clients may only listen.
    #[arg(long = "cannelloni-tcp", value_name = "[CHANNEL:]ADDR:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1",
          value_parser = tcp_tunnel)]
    tcp_tunnels: Vec<TcpTunnelArg>,
    /// Write candump's log lines to anyone who connects, for nc and SavvyCAN's log server; default 127.0.0.1:29538.
    #[arg(long, value_name = "ADDR:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1")]
    lines: Option<String>,
    /// Serve the page of cantap ui, for browsers on this computer; default 127.0.0.1:29540. Its address, which is printed, has a secret token
    /// in it. At an address that other computers can reach, or behind https://, with --tls: for browsers that have a client's certificate. Can be
    /// repeated.
    #[arg(long = "web", value_name = "ADDR:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1")]
    webs: Vec<String>,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    protocol: ProtocolArgs,
    /// What clients may do, by the names in their certificates: channels, identifiers, frames per second, modes, hours. The file is
    /// described in docs/serve.md, and read again at SIGHUP.
    #[cfg(feature = "tls")]
    #[arg(long, value_name = "FILE", requires = "tls")]
    permissions: Option<PathBuf>,
    /// The authority's list of revoked certificates, as `keygen --revoke` writes it; read again at SIGHUP.
    #[cfg(feature = "tls")]
    #[arg(long, value_name = "FILE", requires = "tls")]
    revoked: Option<PathBuf>,
    /// Append to this file, as JSON lines, who came, opened and sent what, and was refused.
    #[arg(long, value_name = "FILE")]
    audit: Option<PathBuf>,
    /// Give Prometheus figures at http://ADDR:PORT/metrics; default 127.0.0.1:29539. Whoever reaches another address can read them.
    #[arg(long, value_name = "ADDR:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1")]
    metrics: Option<String>,
    /// Wait for a device that is not there yet.
    #[arg(long)]
    wait: bool,
    /// Serve one client through standard input and output, as ssh starts it.
    #[arg(long)]
    stdio: bool,
}

/// How channels are opened for clients that only listen.
#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Listeners {
    /// The board is not seen on the bus.
    #[value(name = "listen-only", alias = "listen")]
    ListenOnly,
    /// The board acknowledges.
    Normal,
}

/// How long a client may be silent; `None` is for ever.
#[derive(Clone, Copy)]
struct TimeLimit(Option<Duration>);

fn time_limit(text: &str) -> Result<TimeLimit, String> {
    if matches!(text, "0" | "0s") {
        return Ok(TimeLimit(None));
    }
    args::positive_duration(text).map(|after| TimeLimit(Some(after)))
}

/// How often to check whether to end.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// How many bytes of standard input may wait.
const STDIN_BYTES: usize = 16 * 1024;

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    #[cfg(feature = "tls")]
    if let Some(keys) = &args.keys {
        return keys.run();
    }
    let devices = Boards::new(&args.devices, &Channels::all())?;
    let addresses = devices.addresses();
    if args.stdio && addresses.len() > 1 {
        return Err(usage("--stdio serves one device; omit the others"));
    }
    let mut timing = TimingOptions::default();
    timing.set_bit_rates(args.bitrates.clone());
    timing.check_channels(addresses.len())?;
    let way = way(args)?;
    let tcp = args.tcp.as_deref().map(|text| match way {
        Way::Plain => loopback(text, PORT),
        #[cfg(feature = "tls")]
        Way::Encrypted(_) => doors::address(text, PORT),
    });
    let tcp = tcp.transpose()?;
    #[cfg(feature = "tls")]
    announcing::check(args.announce, tcp)?;
    let other_doors = OtherDoors::of(
        [&args.socketcand, &args.gvret, &args.lines, &args.metrics].map(Option::as_deref),
        &args.tunnels,
        &args.tcp_tunnels,
        addresses.len(),
    )?;
    let for_page = args.databases.given().or_else(|| args.protocol.given());
    if let (true, Some(option)) = (args.webs.is_empty(), for_page) {
        return Err(usage(format!("{option} is for the page; give --web, too")));
    }
    let webs = WebDoor::all(&args.webs, &way, &devices, &args.databases, &args.protocol)?;
    if way.scheme() == "tls" && tcp.is_none() && !webs.iter().any(WebDoor::is_encrypted) {
        return Err(usage("--tls is for --tcp, or for --web at an address of the network; give one of them"));
    }
    #[cfg(feature = "tls")]
    let permissions = args.permissions.as_deref();
    #[cfg(not(feature = "tls"))]
    let permissions = None;
    // Before there is another thread.
    let mut upkeep = Upkeep::new(permissions, args.audit.as_deref(), way.scheme() == "tls")?;
    // From here on, Ctrl-C ends it properly.
    interrupt::watch()?;
    #[cfg(unix)]
    take_all_descriptors();
    let mut boards = Vec::new();
    for (number, address) in addresses.iter().enumerate() {
        let board = start(args, number, address)?;
        check_bitrates(args, number, &board)?;
        boards.push(Arc::new(board));
    }
    upkeep.begin(
        &boards,
        #[cfg(feature = "tls")]
        way.server(),
    )?;
    if args.stdio {
        return serve_stdio(&boards[0], allow(&args.allowed, Door::Stdio));
    }
    let opened = webs.into_iter().map(|web| web.open(&devices, &boards, &args.allowed));
    let (urls, pages): (Vec<_>, Vec<_>) = opened.collect::<anyhow::Result<Vec<_>>>()?.into_iter().unzip();
    let (listening, encrypted) =
        listen(args, tcp.map(|tcp| (tcp, way)).as_ref(), &other_doors, &urls, &boards)?;
    #[cfg(feature = "tls")]
    let announcing = args.announce.then(|| announcing::start(&boards, &encrypted)).transpose()?;
    #[cfg(not(feature = "tls"))]
    let (announcing, _) = ((), encrypted);
    while !interrupt::requested() {
        std::thread::sleep(LOOK_EVERY);
    }
    drop((announcing, listening, pages));
    for board in &boards {
        board.end();
    }
    upkeep.finish();
    Ok(ExitCode::SUCCESS)
}

/// Takes all file descriptors that the system grants. Each listener bounds its connections, but together those of many boards are more than the
/// usual 1024, and strangers must not use up those by which the owner comes in. Without the right to more, it stays as it is.
#[cfg(unix)]
fn take_all_descriptors() {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    // Under systemd, where the unit says how many, this is not permitted and would end the server.
    if current != maximum {
        let _ = setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum });
    }
}

/// Opens a device, which must be there unless it is waited for.
fn start(args: &Args, number: usize, address: &Address) -> anyhow::Result<Board> {
    let of_buses = address.bitrates_of_buses();
    let bitrates_bps: [Option<u32>; CHANNELS] = Channel::ALL.map(|channel| {
        ChannelBitrate::of(&args.bitrates, channel_number(number, channel)).or(of_buses[channel.index()])
    });
    let settings = Settings {
        bitrates_bps,
        waits_for_board: args.wait,
        always_acknowledges: args.mode == Listeners::Normal,
        dead_man: args.dead_man.0,
        idle_sender: args.idle.0,
        ..Settings::default()
    };
    let at = address.clone();
    let connect = Box::new(move |serial: Option<&str>| {
        at.link(serial).map_err(|error| match error {
            LinkError::Device(error) => error.into(),
            error => error.into(),
        })
    });
    Board::start(&address.to_string(), connect, settings, tell).map_err(|error| {
        if error.is_absent() && !args.stdio {
            stderr::tell("cantap: with --wait, the server starts without its device and waits for it\n");
        }
        match error {
            BoardError::Device(error) => error.into(),
            BoardError::Connect(error) => anyhow::anyhow!(error),
        }
    })
}

/// Whoever runs the server sees who comes and goes; what must not be overlooked stands out.
fn tell(news: News) {
    match news {
        News::BoardLost { .. } | News::Refused { .. } | News::NotPermitted { .. } | News::DeadMan { .. } => {
            stderr::warn(&news.to_string());
        }
        news => stderr::tell(&format!("cantap: {news}\n")),
    }
}

/// If nobody may choose a bit rate, there has to be one.
fn check_bitrates(args: &Args, number: usize, board: &Board) -> anyhow::Result<()> {
    // Those saved on a board that is not there yet are not known.
    let Some(hello) = board.hello() else { return Ok(()) };
    if hello.capabilities & capability::NO_BIT_RATE != 0 {
        return Ok(());
    }
    let doors = [Door::Unix, Door::Tcp, Door::Socketcand, Door::Gvret, Door::Web, Door::Stdio];
    if doors.into_iter().any(|door| allow(&args.allowed, door) >= Role::Configure) {
        return Ok(());
    }
    let rates = board.bitrates_bps();
    let unknown: Vec<String> = Channel::ALL
        .into_iter()
        .filter(|channel| rates[channel.index()].is_none())
        .map(|channel| channel_number(number, channel).to_string())
        .collect();
    let advice = "give it with -b, or let clients choose it with --allow configure";
    match unknown.as_slice() {
        [] => Ok(()),
        [one] => {
            eprintln!(
                "cantap: the bit rate of channel {one} is not known, so nobody can listen to it: {advice}"
            );
            Ok(())
        }
        _ => bail!("no bit rate is known for '{}': {advice}", board.name()),
    }
}

/// Opens every listener and prints it. Returns also where the encrypted ones are, one for each board.
fn listen(
    args: &Args,
    tcp: Option<&(SocketAddr, Way)>,
    other_doors: &OtherDoors,
    pages: &[String],
    boards: &[Arc<Board>],
) -> anyhow::Result<(Vec<Listening>, Vec<SocketAddr>)> {
    let (mut ways, mut encrypted) = (Vec::new(), Vec::new());
    let mut said = Vec::new();
    // On systems without UNIX sockets, one for this computer only takes their place.
    #[cfg(not(unix))]
    let loopback = (SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), PORT), Way::Plain);
    #[cfg(not(unix))]
    let tcp = tcp.or(Some(&loopback));
    for (number, board) in boards.iter().enumerate() {
        let (mut names, mut roles) = (Vec::new(), Vec::new());
        #[cfg(unix)]
        if tcp.is_none() || args.unix.is_some() {
            let path = numbered(&args.unix.clone().unwrap_or_else(connect::default_socket), number);
            let role = allow(&args.allowed, Door::Unix);
            let folder = args.unix.is_none().then(connect::default_folder);
            let ready = folder.map_or(Ok(()), |folder| socket_file::private_folder(&folder));
            let way = ready.and_then(|()| listen::unix(board, &path, role)).map_err(|error| match error {
                SocketError::InUse => anyhow::anyhow!(
                    "another server is at '{}' already; end it, or give another path with --unix",
                    path.display()
                ),
                error => anyhow::anyhow!(
                    "no socket can be made at '{}': {error}; give another path with --unix",
                    path.display()
                ),
            })?;
            roles.push(role);
            names.push(format!("unix:{}", path.display()));
            ways.push(way);
        }
        if let Some((first, way)) = tcp {
            let port = match first.port() {
                0 => 0,
                port => port + number as u16,
            };
            let address = SocketAddr::new(first.ip(), port);
            let scheme = way.scheme();
            let way = way
                .listen(board, address, allow(&args.allowed, Door::Tcp))
                .with_context(|| format!("nobody can listen at {address}; give another port with --tcp"))?;
            let address = way.address().unwrap_or(address);
            names.push(format!("{scheme}://{address}"));
            encrypted.extend((scheme == "tls").then_some(address));
            roles.push(allow(&args.allowed, Door::Tcp));
            ways.push(way);
        }
        said.push((board.name(), names, roles));
    }
    let other = other_doors.listen(&args.allowed, boards)?;
    let mut out = io::stdout().lock();
    for (_, names, _) in &said {
        for name in names {
            writeln!(out, "{name}")?;
        }
    }
    for (name, way) in other {
        writeln!(out, "{name}")?;
        ways.push(way);
    }
    for page in pages {
        writeln!(out, "{page}")?;
    }
    out.flush()?;
    for (board, names, roles) in &said {
        // One role for all is said once.
        let first = roles.first().copied().unwrap_or(Role::Listen);
        let is_one = roles.iter().all(|role| *role == first);
        let ways: Vec<String> = names
            .iter()
            .zip(roles)
            .map(|(name, role)| if is_one { name.clone() } else { format!("{name} ({role})") })
            .collect();
        let may = if is_one { format!("clients may {first}; ") } else { String::new() };
        eprintln!("cantap: '{board}' is shared at {}; {may}Ctrl-C ends it", ways.join(" and "));
    }
    Ok((ways, encrypted))
}

/// As the options have it.
#[cfg(feature = "tls")]
fn way(args: &Args) -> anyhow::Result<Way> {
    let (Some(files), Some(authority)) = (&args.tls, &args.clients) else { return Ok(Way::Plain) };
    keys::server(files, authority, args.revoked.as_deref()).map(Way::Encrypted)
}

/// As the options have it.
#[cfg(not(feature = "tls"))]
#[expect(clippy::unnecessary_wraps, reason = "as with TLS")]
const fn way(_args: &Args) -> anyhow::Result<Way> {
    Ok(Way::Plain)
}

/// Serves the client at the other end of standard input and output until that is closed.
fn serve_stdio(board: &Board, role: Role) -> anyhow::Result<ExitCode> {
    let (input, mut to_input) = pipe(STDIN_BYTES);
    // Standard input can only be waited for without a time limit.
    std::thread::Builder::new().name("cantap-stdin".to_owned()).spawn(move || {
        let mut bytes = [0; 4096];
        let mut stdin = io::stdin().lock();
        while let Ok(len @ 1..) = stdin.read(&mut bytes) {
            if write_patiently(&mut to_input, &bytes[..len], Duration::MAX).is_err() {
                return;
            }
        }
    })?;
    let mut stdout = io::stdout();
    // The client has been waiting for this, since getting here may have taken a while.
    stdout.write_all(&connect::READY)?;
    stdout.flush()?;
    board.admit_remote(input, stdout, "the client", role)?;
    while board.clients() > 0 && !interrupt::requested() {
        std::thread::sleep(LOOK_EVERY);
    }
    Ok(ExitCode::SUCCESS)
}
