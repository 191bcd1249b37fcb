//! The driver against firmware that nobody here wrote, on the emulated board: neither of the two is a stand-in.
//!
//! `CANTAP_GS_USB_ELF` names the ELF of a gs_usb adapter's firmware for an STM32F405 or F407 with a crystal of 8 MHz, such as candleLight's for its
//! board with an F407. Nothing of it is part of this project.

use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::path::PathBuf;

use cantap_sim::usbip::serve;
use cantap_testing::process::wait_until;
use cantap_testing::usbip::{self, Kernel};

use super::*;

/// Linux has as many reads waiting.
const READS: usize = 30;
const READ_BYTES: u32 = 128;
/// What one request may take on a busy machine.
const PATIENCE: Duration = Duration::from_mins(1);

type Stamps = Arc<Mutex<Vec<u32>>>;

/// The board, which a thread emulates.
struct Board {
    folder: tempfile::TempDir,
    ports: Vec<u16>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Board {
    /// `None` if there is no firmware for it.
    fn start() -> Option<Self> {
        let path = PathBuf::from(std::env::var_os("CANTAP_GS_USB_ELF").or_else(|| {
            eprintln!("SKIPPED: CANTAP_GS_USB_ELF names no firmware of a gs_usb adapter");
            None
        })?);
        let image = cantap_emu::Image::program(&std::fs::read(path).unwrap()).unwrap();
        let setup = cantap_sim::board::setup_for_any(&image).expect("it sets up its clocks");
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().to_owned();
        let thread = std::thread::spawn(move || serve(image, setup, &place).unwrap());
        let mut ports: Vec<u16> = Vec::new();
        wait_until("the board does not come up", || {
            let text = std::fs::read_to_string(folder.path().join("ports")).unwrap_or_default();
            ports = text.lines().filter_map(|line| line.split_once('=')?.1.parse().ok()).collect();
            ports.len() == 3 || thread.is_finished()
        });
        Some(Self { folder, ports, thread: Some(thread) })
    }

    /// Sends a line of the board's script and returns the answer.
    fn say(&self, line: &str) -> String {
        let mut stream = TcpStream::connect(("127.0.0.1", self.ports[2])).unwrap();
        writeln!(stream, "{line}").unwrap();
        let mut answer = String::new();
        BufReader::new(stream).read_line(&mut answer).unwrap();
        assert!(!answer.starts_with("error"), "{line}: {answer}");
        answer
    }

    /// A figure that is a number, since the mark.
    fn figure(&self, name: &str) -> f64 {
        let status = self.say("status");
        let (_, rest) = status.split_once(&format!("\"{name}\":")).unwrap();
        rest.split([',', '}']).next().unwrap().parse().unwrap()
    }

    /// Lets emulated time pass, which takes as long as it takes.
    fn wait(&self, seconds: f64) {
        let until = self.figure("emulated_s") + seconds;
        while self.figure("emulated_s") < until {
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Lines of a book: `taken1` has the frames that the controller received, `stamps1` when, in ns, `sent1` those that it sent.
    fn book(&self, name: &str) -> Vec<String> {
        self.say("dump book");
        let text = std::fs::read_to_string(self.folder.path().join(format!("book.{name}"))).unwrap();
        text.lines().map(str::to_owned).collect()
    }

    /// A session with our driver, and the stamps of what is received, in us, as they come.
    fn session(&self) -> (Device, Stamps) {
        let usb = self.attach();
        let stamps = Arc::clone(&usb.stamps);
        let driver = GsUsb::over(Box::new(usb), "emulated".to_owned(), Options::default(), "gs_usb:");
        (Device::over(crate::engine::start(Box::new(driver.unwrap())).unwrap(), "gs_usb:").unwrap(), stamps)
    }

    fn attach(&self) -> OverUsbIp {
        let mut kernel = Kernel::import(self.ports[0], "1-1").unwrap();
        let reply = kernel.bytes(320);
        assert_eq!(reply[4..8], [0; 4], "it is there");
        let configuration = kernel.enumerate();
        let (input, output) = (usbip::bulk(&configuration, 0x80), usbip::bulk(&configuration, 0));
        let mut usb = OverUsbIp {
            kernel,
            input,
            output,
            reads: Vec::new(),
            pieces: VecDeque::new(),
            stamps: Stamps::default(),
        };
        for _ in 0..READS {
            usb.begin_read().unwrap();
        }
        usb
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.say("quit");
            self.thread.take().unwrap().join().unwrap();
        }
    }
}

/// The adapter at the other end of USB/IP.
struct OverUsbIp {
    kernel: Kernel,
    input: u32,
    output: u32,
    reads: Vec<u32>,
    pieces: VecDeque<Piece<Vec<u8>>>,
    stamps: Stamps,
}

impl OverUsbIp {
    fn begin_read(&mut self) -> Result<(), String> {
        let read = self.kernel.submit(self.input, true, READ_BYTES, [0; 8], &[]);
        self.reads.push(read.map_err(|error| error.to_string())?);
        Ok(())
    }

    /// Takes what has ended within `wait`.
    fn pump(&mut self, wait: Duration) -> Result<(), String> {
        let mut wait = wait;
        while let Some(ended) = self.kernel.next(wait).map_err(|error| error.to_string())? {
            wait = Duration::ZERO;
            if let Some(place) = self.reads.iter().position(|seq| *seq == ended.seq) {
                self.reads.remove(place);
                if ended.status != 0 {
                    return Err(format!("a read failed: {}", ended.status));
                }
                if let Some(transfer) = wire::transfer(&ended.data, true)
                    && let (RECEIVED, Content::Frame(_), Some(stamp_us)) =
                        (transfer.echo, transfer.content, transfer.stamp_us)
                {
                    self.stamps.lock().unwrap().push(stamp_us);
                }
                self.pieces.push_back(Piece { at: Instant::now(), content: ended.data });
                self.begin_read()?;
            }
        }
        Ok(())
    }

    fn control(
        &mut self,
        kind: u8,
        request: u8,
        value: u16,
        length: u16,
        data: &[u8],
    ) -> Result<Vec<u8>, String> {
        let ([value_low, value_high], [low, high]) = (value.to_le_bytes(), length.to_le_bytes());
        let setup = [kind, request, value_low, value_high, 0, 0, low, high];
        let (status, answer) =
            self.kernel.control(setup, data, PATIENCE).map_err(|error| error.to_string())?;
        if status == 0 { Ok(answer) } else { Err(format!("request {request}: {status}")) }
    }
}

impl Usb for OverUsbIp {
    fn control_out(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), String> {
        self.control(0x41, request, value, data.len() as u16, data).map(drop)
    }

    fn control_in(
        &mut self,
        request: u8,
        value: u16,
        len: u16,
        _within: Duration,
    ) -> Result<Vec<u8>, String> {
        self.control(0xC1, request, value, len, &[])
    }

    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        if self.pieces.is_empty() {
            self.pump(wait)?;
        }
        Ok(self.pieces.pop_front())
    }

    fn write(&mut self, bytes: Vec<u8>) -> Result<bool, String> {
        let sent = self.kernel.submit(self.output, false, bytes.len() as u32, [0; 8], &bytes);
        sent.map(|_| true).map_err(|error| error.to_string())
    }
}

/// Emulated time is not this computer's: the adapter's stamps are compared with those of the bus as they came.
#[test]
fn each_frame_arrives_in_order_and_it_drives_no_bit() {
    let Some(board) = Board::start() else { return };
    let (device, stamps) = board.session();
    assert_eq!((device.hello().board.as_str(), device.hello().channels), ("gs_usb", 1));
    device.listen(Channel::Can1, 500_000).unwrap();
    // candleLight's shows a pattern with its lamps first, while it receives nothing: half a second, or three times that if it takes the crystal for
    // one of 25 MHz.
    board.wait(2.5);
    board.say("mark");
    board.say("play 1 50 mix 300");
    let mut received = Vec::new();
    for record in device.records() {
        received.extend(record.unwrap().frame().map(ToString::to_string));
        if received.len() == 300 {
            break;
        }
    }
    assert_eq!(received, board.book("taken1"));
    let status = board.say("status");
    assert!(status.contains("\"dominant_bits\":[0,0]"), "nothing is acknowledged: {status}");
    assert!(status.contains("\"odd_accesses\":0"), "{status}");
    let valid: Vec<f64> = board.book("stamps1").iter().map(|ns| ns.parse::<f64>().unwrap() / 1e3).collect();
    let stamps: Vec<f64> = stamps.lock().unwrap().iter().map(|us| f64::from(*us)).collect();
    assert_eq!(stamps.len(), valid.len());
    let span = |times: &[f64]| times[times.len() - 1] - times[0];
    let (first, speed) = (valid[0], span(&stamps) / span(&valid));
    let off =
        std::iter::zip(&stamps, &valid).map(|(stamp, valid)| (stamp - stamps[0]) / speed - (valid - first));
    let (least, most) = off.fold((f64::MAX, f64::MIN), |(least, most), off| (least.min(off), most.max(off)));
    eprintln!(
        "its clock runs at {speed:.4} of the bus's; with that, stamps are within {:.1} us",
        most - least
    );
    assert!((0.8..1.2).contains(&speed), "{speed}");
}
