//! Against a stand-in that does what AN3156 says of the ROM, and may be told to do it badly.

use super::*;

const FLASH: u32 = 0x0800_0000;
const TRANSFER: usize = 2048;
/// Data are being read.
const UPLOAD_IDLE: u8 = 9;

/// A chip's bootloader.
struct Chip {
    layout: Layout,
    flash: Vec<u8>,
    state: u8,
    status: u8,
    pointer: u32,
    /// What the next request for the status does.
    work: Option<(u16, Vec<u8>)>,
    erased: Vec<u32>,
    started: bool,
    slept: Duration,
    /// A byte that keeps one of its bits.
    stuck: Option<usize>,
    /// A sector that cannot be erased.
    protected: Option<u32>,
    /// It stops answering after this many requests.
    answers: usize,
    /// It is gone as soon as it was asked to leave.
    leaves_at_once: bool,
}

impl Chip {
    fn new() -> Self {
        Self {
            layout: Layout::parse("@Internal Flash  /0x08000000/04*016Kg,01*064Kg,07*128Kg").unwrap(),
            flash: vec![0; 1 << 20],
            state: IDLE,
            status: 0,
            pointer: 0,
            work: None,
            erased: Vec::new(),
            started: false,
            slept: Duration::ZERO,
            stuck: None,
            protected: None,
            answers: usize::MAX,
            leaves_at_once: false,
        }
    }

    fn answer(&mut self) -> Result<(), PortError> {
        self.answers = self.answers.checked_sub(1).ok_or("unplugged")?;
        Ok(())
    }

    fn fail(&mut self, status: u8) {
        (self.state, self.status) = (ERROR, status);
    }

    fn place(&self, number: u16) -> usize {
        (self.pointer - FLASH) as usize + usize::from(number - FIRST_BLOCK) * TRANSFER
    }

    /// What was downloaded is done while the status is asked for.
    fn work(&mut self, number: u16, data: &[u8]) {
        match (number, data) {
            (0, [SET_ADDRESS, address @ ..]) => {
                self.pointer = u32::from_le_bytes(address.try_into().unwrap());
            }
            (0, [ERASE, address @ ..]) => {
                let address = u32::from_le_bytes(address.try_into().unwrap());
                if self.protected == Some(address) {
                    return self.fail(11);
                }
                let sector = self.layout.sectors(address, address + 1).unwrap()[0];
                assert_eq!(sector.address, address);
                let from = (address - FLASH) as usize;
                self.flash[from..from + sector.length as usize].fill(0xFF);
                self.erased.push(address);
            }
            (2.., []) => self.started = true,
            (2.., data) => {
                let from = self.place(number);
                for (at, byte) in (from..).zip(data) {
                    // Flash only loses bits.
                    self.flash[at] &= byte;
                    if self.stuck == Some(at) {
                        self.flash[at] |= 1;
                    }
                }
            }
            _ => self.fail(15),
        }
    }
}

impl Port for Chip {
    fn send(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), PortError> {
        self.answer()?;
        match (request, self.state) {
            (DNLOAD, IDLE | DOWNLOAD_IDLE) => {
                assert!(data.len() <= TRANSFER);
                self.work = Some((value, data.to_vec()));
                self.state = 3;
                if data.is_empty() && self.leaves_at_once {
                    self.answers = 0;
                    self.started = true;
                }
            }
            (CLRSTATUS, ERROR) => (self.state, self.status) = (IDLE, 0),
            (ABORT, IDLE | DOWNLOAD_IDLE | UPLOAD_IDLE) => self.state = IDLE,
            _ => return Err("stalled".into()),
        }
        Ok(())
    }

    fn receive(&mut self, request: u8, value: u16, length: usize) -> Result<Vec<u8>, PortError> {
        self.answer()?;
        match (request, self.state) {
            (GETSTATUS, _) => {
                if self.state == 3 {
                    // The first answer says how long it takes; the second, that it is done.
                    self.state = if self.work.as_ref().is_some_and(|(_, data)| data.is_empty()) {
                        MANIFEST
                    } else {
                        DOWNLOAD_BUSY
                    };
                } else if self.state == DOWNLOAD_BUSY {
                    self.state = DOWNLOAD_IDLE;
                }
                if let Some((number, data)) = self.work.take() {
                    self.work(number, &data);
                }
                let poll = if self.state == DOWNLOAD_BUSY { 5 } else { 0 };
                Ok(vec![self.status, poll, 0, 0, self.state, 0])
            }
            (UPLOAD, IDLE | UPLOAD_IDLE) => {
                self.state = UPLOAD_IDLE;
                let from = self.place(value);
                Ok(self.flash[from..from + length].to_vec())
            }
            _ => Err("stalled".into()),
        }
    }

    fn pause(&mut self, time: Duration) {
        self.slept += time;
    }

    fn transfer_bytes(&self) -> usize {
        TRANSFER
    }

    fn layout(&self) -> &Layout {
        &self.layout
    }
}

fn image() -> Vec<u8> {
    (0..70_001_u32).map(|at| (at * 7 + at / 256) as u8).collect()
}

#[test]
fn an_image_is_erased_written_verified_and_started() {
    let mut chip = Chip::new();
    let mut steps = Vec::new();
    write(&mut chip, FLASH, &image(), |step, done, all| {
        assert!(done <= all);
        steps.push((step, done == all));
    })
    .unwrap();
    assert!(chip.started && chip.flash.starts_with(&image()));
    // Only the sectors of the image: settings further up survive.
    assert_eq!(chip.erased, [0, 0x4000, 0x8000, 0xC000, 0x1_0000].map(|offset| FLASH + offset));
    assert!(chip.flash[0x2_0000..].iter().all(|byte| *byte == 0));
    assert!(chip.slept >= Duration::from_millis(5 * 40));
    steps.retain(|(_, whole)| *whole);
    assert_eq!(steps, [(Step::Erase, true), (Step::Write, true), (Step::Verify, true)]);
}

#[test]
fn a_bootloader_left_in_the_middle_by_another_program_is_used_all_the_same() {
    for state in [ERROR, DOWNLOAD_IDLE, UPLOAD_IDLE] {
        let mut chip = Chip::new();
        (chip.state, chip.status) = (state, if state == ERROR { 15 } else { 0 });
        write(&mut chip, FLASH, &image(), |_, _, _| {}).unwrap();
        assert!(chip.started, "{state}");
    }
    let mut chip = Chip { leaves_at_once: true, ..Chip::new() };
    write(&mut chip, FLASH, &image(), |_, _, _| {}).unwrap();
    assert!(chip.started);
}

#[test]
fn what_was_not_written_is_never_started() {
    let mut worn = Chip { stuck: Some(5_001), ..Chip::new() };
    let error = write(&mut worn, FLASH, &image(), |_, _, _| {}).unwrap_err();
    assert!(matches!(error, DfuError::Differs(0x0800_1389)) && !worn.started, "{error}");
    let mut protected = Chip { protected: Some(FLASH + 0x4000), ..Chip::new() };
    let error = write(&mut protected, FLASH, &image(), |_, _, _| {}).unwrap_err().to_string();
    assert!(error.contains("refused to erase a sector: the flash is protected"), "{error}");
    assert!(!protected.started && protected.state == IDLE);
    let mut chip = Chip::new();
    let error = write(&mut chip, FLASH, &vec![0; (1 << 20) + 1], |_, _, _| {}).unwrap_err();
    assert!(matches!(error, DfuError::NoRoom(0x0810_0000)) && chip.erased.is_empty(), "{error}");
}

#[test]
fn unplugged_at_any_time_it_is_an_error() {
    let requests = {
        let mut chip = Chip { answers: 1_000_000, ..Chip::new() };
        write(&mut chip, FLASH, &image(), |_, _, _| {}).unwrap();
        1_000_000 - chip.answers
    };
    // The last one is the status after which it goes.
    for answers in 0..requests - 1 {
        let mut chip = Chip { answers, ..Chip::new() };
        let error = write(&mut chip, FLASH, &image(), |_, _, _| {}).unwrap_err();
        assert!(matches!(error, DfuError::Port(_)) && !chip.started, "{answers}: {error}");
    }
}
