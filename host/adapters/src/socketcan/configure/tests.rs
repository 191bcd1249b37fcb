//! Setting up against a kernel in memory. The real one is asked in `sim/kernel/guest/parts/gs_usb.sh`.

use std::collections::VecDeque;

use super::*;

/// An interface that takes what it is told.
#[derive(Default)]
struct Fake {
    link: Link,
    is_gone: bool,
    receivers: Vec<String>,
    changes: Vec<Vec<u8>>,
    /// What the next changes are answered; then all are taken.
    answers: VecDeque<i32>,
    /// The bit rate that its clock comes to, if it is another one.
    comes_to: Option<u32>,
}

impl Kernel for Fake {
    fn look(&mut self) -> io::Result<Link> {
        if self.is_gone { Err(io::Error::from_raw_os_error(ENODEV)) } else { Ok(self.link.clone()) }
    }

    fn change(&mut self, message: &[u8]) -> io::Result<()> {
        self.changes.push(message.to_vec());
        match self.answers.pop_front() {
            None | Some(0) => {}
            Some(code) => return Err(io::Error::from_raw_os_error(code)),
        }
        let word = |at: usize| u32::from_ne_bytes(message[at..at + 4].try_into().unwrap());
        if message == link_change::up(7, true) || message == link_change::up(7, false) {
            self.link.is_up = word(24) != 0;
        } else {
            // Behind the headers of message, link, kind and data is the timing.
            self.link.bitrate_bps = self.comes_to.or(Some(word(52)).filter(|rate| *rate > 0));
            self.link.set_up.mode = word(message.len() - 4);
        }
        Ok(())
    }

    fn receivers(&self) -> Vec<String> {
        self.receivers.clone()
    }
}

/// One that runs at 500 kbit/s and acknowledges.
fn running() -> Fake {
    let timing = [500_000, 875, 125, 6, 7, 2, 1, 6];
    let set_up = SetUp { index: 7, timing, mode: 0x10, restart_ms: 50, ..SetUp::default() };
    let link = Link {
        is_can: true,
        is_up: true,
        kind: "can".to_owned(),
        bitrate_bps: Some(500_000),
        set_up,
        ..Link::default()
    };
    Fake { link, ..Fake::default() }
}

/// One that was just plugged in.
fn fresh() -> Fake {
    let mut fake = running();
    fake.link =
        Link { is_up: false, bitrate_bps: None, set_up: SetUp { index: 7, ..SetUp::default() }, ..fake.link };
    fake
}

const SETTINGS: InterfaceSettings = InterfaceSettings {
    bitrate_bps: 250_000,
    sample_point_permille: None,
    mode: Mode::ListenOnly,
    data_bitrate_bps: None,
    restart_after: None,
};

fn fails(fake: &mut Fake, settings: &InterfaceSettings) -> String {
    set(fake, "can0", settings, false).unwrap_err().to_string()
}

/// The message that sets these.
fn setting(settings: &InterfaceSettings) -> Vec<u8> {
    link_change::set(&wanted(&running().link, settings), settings.restart_after.is_some())
}

#[test]
fn an_interface_is_taken_down_set_and_taken_up() {
    let mut fake = running();
    assert!(set(&mut fake, "can0", &SETTINGS, false).unwrap());
    let (down, up) = (link_change::up(7, false), link_change::up(7, true));
    assert_eq!(fake.changes, [down, setting(&SETTINGS), up.clone()]);
    // One that is down already has nothing before that.
    let mut fake = fresh();
    assert!(set(&mut fake, "can0", &SETTINGS, false).unwrap());
    assert_eq!(fake.changes, [setting(&SETTINGS), up]);
}

#[test]
fn one_that_runs_as_asked_is_left_alone() {
    let mut fake = running();
    fake.receivers = vec!["raw".to_owned()];
    let as_it_is = InterfaceSettings { bitrate_bps: 500_000, mode: Mode::Normal, ..SETTINGS };
    assert!(!set(&mut fake, "can0", &as_it_is, false).unwrap());
    let more = InterfaceSettings {
        sample_point_permille: Some(875),
        restart_after: Some(Duration::from_millis(50)),
        ..as_it_is
    };
    assert!(!set(&mut fake, "can0", &more, false).unwrap());
    assert_eq!(fake.changes, [[0; 0]; 0]);
    // Each of these is something else, which is not done while it is used.
    for other in [
        InterfaceSettings { mode: Mode::ListenOnly, ..as_it_is },
        InterfaceSettings { sample_point_permille: Some(800), ..as_it_is },
        InterfaceSettings { restart_after: Some(Duration::ZERO), ..as_it_is },
        InterfaceSettings { data_bitrate_bps: Some(2_000_000), ..as_it_is },
    ] {
        assert!(set(&mut fake, "can0", &other, false).is_err(), "{other:?}");
    }
}

#[test]
fn one_that_programs_receive_from_is_changed_only_with_leave() {
    let mut fake = running();
    fake.receivers = vec!["isotp".to_owned(), "raw".to_owned()];
    let error = fails(&mut fake, &SETTINGS);
    assert!(error.contains("(isotp, raw)") && error.contains("--yes") && fake.changes.is_empty(), "{error}");
    assert!(take_down(&mut fake, "can0", false).is_err() && fake.changes.is_empty());
    assert!(set(&mut fake, "can0", &SETTINGS, true).unwrap());
    assert!(take_down(&mut fake, "can0", true).unwrap() && !fake.link.is_up);
    // Nobody receives from one that is down.
    fake.changes.clear();
    assert!(set(&mut fake, "can0", &SETTINGS, false).unwrap());
    assert!(!take_down(&mut fresh(), "can0", false).unwrap());
}

/// Whatever is refused, the interface is afterwards as it was: the timing by its segments, the modes, the restart.
#[test]
fn what_was_set_before_is_set_again_if_a_step_fails() {
    let timing = [0, 0, 125, 6, 7, 2, 1, 0];
    let before = SetUp { timing, ..running().link.set_up };
    let back = [link_change::up(7, false), link_change::set(&before, false), link_change::up(7, true)];
    for (answers, words) in [
        // The driver has no listen-only, then a clock that cannot do it, then one that does not start.
        (&[0, EOPNOTSUPP][..], "what its driver or controller does not have"),
        (&[0, EDOM], "that its clock reaches"),
        (&[0, 0, nix::libc::EIO], "dmesg"),
    ] {
        let mut fake = running();
        fake.answers = answers.to_vec().into();
        let error = fails(&mut fake, &SETTINGS);
        assert!(error.contains(words) && error.ends_with("can0 runs as before"), "{error}");
        assert!(fake.changes.ends_with(&back) && fake.link.is_up, "{:?}", fake.changes);
    }
    // A driver that has no restart: it is set again only if it was to be changed.
    let mut fake = running();
    fake.answers = [0, EOPNOTSUPP].into();
    let with_restart = InterfaceSettings { restart_after: Some(Duration::from_millis(100)), ..SETTINGS };
    let error = fails(&mut fake, &with_restart);
    assert!(error.contains("250000 bit/s, listen-only, restarted 100 ms after bus-off"), "{error}");
    assert_eq!(fake.changes[3], link_change::set(&before, true));
    let mut fake = running();
    fake.comes_to = Some(244_000);
    let error = fails(&mut fake, &SETTINGS);
    assert!(error.contains("250000 bit/s as 244000") && fake.changes.ends_with(&back), "{error}");
    // A driver with a list of bit rates has no segments, and CAN FD has a timing of its own.
    let mut fake = running();
    fake.link.set_up.timing = [500_000, 0, 0, 0, 0, 0, 0, 0];
    fake.link.set_up.data_timing = [2_000_000, 750, 25, 7, 7, 5, 1, 1];
    fake.link.set_up.mode |= CAN_CTRLMODE_FD;
    fake.answers = [0, EINVAL].into();
    fails(&mut fake, &SETTINGS);
    let set_again = &fake.changes[fake.changes.len() - 2];
    let wanted = SetUp {
        timing: [500_000, 0, 0, 0, 0, 0, 0, 0],
        data_timing: [0, 0, 25, 7, 7, 5, 1, 0],
        mode: 0x30,
        restart_ms: 50,
        index: 7,
    };
    assert_eq!(*set_again, link_change::set(&wanted, false));
}

#[test]
fn what_cannot_be_put_back_is_said() {
    let mut fake = running();
    fake.answers = [0, EINVAL, 0, ENODEV].into();
    let error = fails(&mut fake, &SETTINGS);
    assert!(
        error.contains("could not be put back") && error.contains("ip -details link show can0"),
        "{error}"
    );
    let mut fake = fresh();
    fake.answers = [EINVAL].into();
    let error = fails(&mut fake, &SETTINGS);
    assert!(error.contains("had no bit rate before") && !fake.link.is_up, "{error}");
}

#[test]
fn without_rights_nothing_is_changed_and_the_lines_for_root_are_said() {
    let mut fake = running();
    fake.link.set_up.mode |= CAN_CTRLMODE_LOOPBACK | CAN_CTRLMODE_FD;
    fake.answers = [EPERM].into();
    let more = InterfaceSettings {
        sample_point_permille: Some(875),
        restart_after: Some(Duration::from_millis(100)),
        ..SETTINGS
    };
    let error = fails(&mut fake, &more);
    let line = "As root: ip link set can0 down && ip link set can0 up type can bitrate 250000 sample-point 0.875 fd off listen-only on loopback off restart-ms 100;";
    assert!(error.contains(line) && error.contains("setcap cap_net_admin=ep /"), "{error}");
    assert_eq!(fake.changes.len(), 1);
    let mut fake = fresh();
    fake.answers = [EPERM].into();
    let with_fd = InterfaceSettings { data_bitrate_bps: Some(2_000_000), mode: Mode::Normal, ..SETTINGS };
    let error = fails(&mut fake, &with_fd);
    let line = "As root: ip link set can0 up type can bitrate 250000 dbitrate 2000000 fd on;";
    assert!(error.contains(line), "{error}");
    let mut fake = running();
    fake.answers = [EPERM].into();
    assert!(take_down(&mut fake, "can0", false).unwrap_err().to_string().contains("ip link set can0 down;"));
}

#[test]
fn what_is_virtual_or_not_there_says_so() {
    let mut fake = running();
    fake.link.kind = "vcan".to_owned();
    let error = fails(&mut fake, &SETTINGS);
    assert!(error.contains("'can0' is virtual (vcan)") && fake.changes.is_empty(), "{error}");
    let mut fake = running();
    fake.is_gone = true;
    assert!(matches!(set(&mut fake, "can7", &SETTINGS, true), Err(InterfaceError::NotThere { .. })));
    let mut fake = running();
    fake.link.is_can = false;
    assert!(matches!(take_down(&mut fake, "lo", true), Err(InterfaceError::NotThere { .. })));
}

#[test]
fn only_one_that_is_off_its_bus_is_restarted() {
    let refused = |fake: &mut Fake| restart(fake, "can0").unwrap_err().to_string();
    let mut fake = running();
    assert!(refused(&mut fake).contains("the kernel does it 50 ms after bus-off"));
    fake.link.set_up.restart_ms = 0;
    fake.link.state = Some(ErrorState::Passive);
    assert!(refused(&mut fake).contains("error state: passive"));
    assert!(refused(&mut fresh()).contains("it is down"));
    assert!(fake.changes.is_empty());
    fake.link.state = Some(ErrorState::BusOff);
    restart(&mut fake, "can0").unwrap();
    assert_eq!(fake.changes, [link_change::restart(7)]);
    fake.answers = [EPERM].into();
    assert!(refused(&mut fake).contains("ip link set can0 type can restart;"));
}

#[test]
fn an_interface_is_described_as_the_kernel_has_it() {
    let fake = running();
    let is = described("can0", fake.link.clone(), vec!["raw".to_owned()]);
    assert_eq!((is.bitrate_bps, is.sample_point_permille), (Some(500_000), Some(875)));
    assert_eq!((is.mode, is.restart_ms, is.is_up), (Some(Mode::Normal), Some(50), true));
    let is = described("can0", fresh().link, Vec::new());
    assert_eq!((is.bitrate_bps, is.sample_point_permille, is.is_up), (None, None, false));
    let virtual_one = Link { kind: "vcan".to_owned(), ..Link::default() };
    let is = described("vcan0", virtual_one, Vec::new());
    assert_eq!((is.mode, is.restart_ms), (None, None));
}
