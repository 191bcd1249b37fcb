//! The three transmit mailboxes and TSR (RM0090 Rev 21 §32.7.2, §32.9.3).

use cantap_can::{Frame, Id};

/// Transmit mailboxes of a controller.
pub const MAILBOXES: usize = 3;

const RQCP: u32 = 1;
const TXOK: u32 = 1 << 1;
const ALST: u32 = 1 << 2;
const TERR: u32 = 1 << 3;
const ABRQ: u32 = 1 << 7;
/// TIxR.TXRQ.
const TXRQ: u32 = 1;

/// How an attempt to send ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attempt {
    /// Sent and acknowledged.
    Sent,
    /// Another node's identifier was lower.
    LostArbitration,
    /// An error hit it.
    Failed,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Phase {
    #[default]
    Empty,
    /// Requested, as the n-th request.
    Pending(u64),
    /// On the bus.
    Sending(u64),
}

#[derive(Clone, Copy, Debug, Default)]
struct Mailbox {
    /// TIxR without TXRQ, TDTxR, TDLxR, TDHxR.
    registers: [u32; 4],
    phase: Phase,
    /// RQCP, TXOK, ALST, TERR in place.
    status: u32,
    abort: bool,
}

impl Mailbox {
    fn frame(&self) -> Frame {
        let [id, length, low, high] = self.registers;
        let mut data = [0; 8];
        data[..4].copy_from_slice(&low.to_le_bytes());
        data[4..].copy_from_slice(&high.to_le_bytes());
        let remote = id & 2 != 0;
        let id = if id & 4 != 0 { Id::extended_truncated(id >> 3) } else { Id::standard_truncated(id >> 21) };
        Frame::from_bus(id, remote, length as u8, data)
    }

    /// The lowest is sent first: these are the bits in arbitration order.
    fn rank(&self) -> u64 {
        let id = self.registers[0];
        let (base, low) = (u64::from(id >> 21), u64::from(id >> 3 & 0x3_FFFF));
        let (extended, remote) = (u64::from(id >> 2 & 1), u64::from(id >> 1 & 1));
        // Base ID, then RTR or SRR, then IDE, then the rest of an extended ID and its RTR.
        if extended == 1 { base << 21 | 0b11 << 19 | low << 1 | remote } else { base << 21 | remote << 20 }
    }

    fn complete(&mut self, status: u32) {
        self.phase = Phase::Empty;
        self.abort = false;
        self.status = RQCP | status;
    }
}

/// All three mailboxes and the order in which they are sent.
#[derive(Clone, Debug, Default)]
pub struct Mailboxes {
    boxes: [Mailbox; MAILBOXES],
    requests: u64,
}

impl Mailboxes {
    /// TSR.
    pub fn status(&self, by_request: bool) -> u32 {
        let mut tsr = 0;
        for (n, mailbox) in self.boxes.iter().enumerate() {
            tsr |= (mailbox.status | if mailbox.abort { ABRQ } else { 0 }) << (8 * n);
            if mailbox.phase == Phase::Empty {
                tsr |= 1 << (26 + n);
            }
        }
        let waiting = self.boxes.iter().filter(|mailbox| mailbox.phase != Phase::Empty).count();
        let last = self.in_order(by_request).last();
        if let (true, Some(last)) = (waiting > 1, last) {
            tsr |= 1 << (29 + last);
        }
        let code = self.boxes.iter().position(|mailbox| mailbox.phase == Phase::Empty).or(last).unwrap_or(0);
        tsr | (code as u32) << 24
    }

    /// A write to TSR: clears flags, requests aborts. Only an empty or pending mailbox can be aborted at
    /// once; one on the bus is aborted when its attempt fails.
    pub fn control(&mut self, value: u32) {
        for (n, mailbox) in self.boxes.iter_mut().enumerate() {
            let bits = value >> (8 * n);
            if bits & RQCP != 0 {
                mailbox.status = 0;
            }
            mailbox.status &= !(bits & (TXOK | ALST | TERR));
            if bits & ABRQ != 0 {
                match mailbox.phase {
                    Phase::Empty => {}
                    Phase::Pending(_) => mailbox.complete(0),
                    Phase::Sending(_) => mailbox.abort = true,
                }
            }
        }
    }

    /// Reads TIxR, TDTxR, TDLxR or TDHxR of mailbox `n`.
    pub fn read(&self, n: usize, register: usize) -> u32 {
        let mailbox = &self.boxes[n];
        let requested = register == 0 && mailbox.phase != Phase::Empty;
        mailbox.registers[register] | if requested { TXRQ } else { 0 }
    }

    /// Writes one of them; `None` if the mailbox is not empty, since the hardware then would not accept
    /// it.
    pub fn write(&mut self, n: usize, register: usize, value: u32) -> Option<()> {
        let mailbox = &mut self.boxes[n];
        if mailbox.phase != Phase::Empty {
            return None;
        }
        mailbox.registers[register] = if register == 0 { value & !TXRQ } else { value };
        if register == 0 && value & TXRQ != 0 {
            self.requests += 1;
            mailbox.phase = Phase::Pending(self.requests);
            mailbox.status = 0;
        }
        Some(())
    }

    /// The mailbox that sends next and its frame. By identifier, or with TXFP (`by_request`) in the order
    /// of the requests.
    pub fn next(&self, by_request: bool) -> Option<(usize, Frame)> {
        let n = self.in_order(by_request).next()?;
        Some((n, self.boxes[n].frame()))
    }

    /// The frame in mailbox `n`.
    pub fn frame_in(&self, n: usize) -> Frame {
        self.boxes[n].frame()
    }

    /// Mailbox `n` is on the bus from now on.
    pub fn start(&mut self, n: usize) {
        if let Phase::Pending(request) = self.boxes[n].phase {
            self.boxes[n].phase = Phase::Sending(request);
        }
    }

    /// The attempt of mailbox `n` ended. If it failed, the frame waits for the next attempt, unless `once`
    /// (NART) is set or an abort was requested.
    pub fn finish(&mut self, n: usize, attempt: Attempt, once: bool) {
        let mailbox = &mut self.boxes[n];
        let Phase::Sending(request) = mailbox.phase else { return };
        let failure = match attempt {
            Attempt::Sent => return mailbox.complete(TXOK),
            Attempt::LostArbitration => ALST,
            Attempt::Failed => TERR,
        };
        if once || mailbox.abort {
            mailbox.complete(failure);
        } else {
            mailbox.status = mailbox.status & RQCP | failure;
            mailbox.phase = Phase::Pending(request);
        }
    }

    /// The controller was reset in the middle of an attempt: the frame waits for the next attempt.
    pub fn cut_off(&mut self) {
        for mailbox in &mut self.boxes {
            mailbox.abort = false;
            if let Phase::Sending(request) = mailbox.phase {
                mailbox.phase = Phase::Pending(request);
            }
        }
    }

    /// Whether a request has completed and its flag has not been cleared.
    pub fn irq(&self) -> bool {
        self.boxes.iter().any(|mailbox| mailbox.status & RQCP != 0)
    }

    fn in_order(&self, by_request: bool) -> impl Iterator<Item = usize> + use<> {
        let mut waiting: Vec<(u64, usize)> = self
            .boxes
            .iter()
            .enumerate()
            .filter_map(|(n, mailbox)| match mailbox.phase {
                Phase::Empty => None,
                Phase::Pending(request) | Phase::Sending(request) => {
                    Some((if by_request { request } else { mailbox.rank() }, n))
                }
            })
            .collect();
        waiting.sort_unstable();
        waiting.into_iter().map(|(_, n)| n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(mailboxes: &mut Mailboxes, n: usize, id: u32) {
        mailboxes.write(n, 0, id << 21 | TXRQ).unwrap();
    }

    #[test]
    fn the_lowest_identifier_goes_first_or_the_oldest_request() {
        let mut mailboxes = Mailboxes::default();
        for (n, id) in [(0, 0x300), (1, 0x100), (2, 0x200)] {
            request(&mut mailboxes, n, id);
        }
        assert_eq!(mailboxes.next(false).unwrap().0, 1);
        assert_eq!(mailboxes.next(true).unwrap().0, 0);
        assert_eq!(mailboxes.status(false) >> 26, 0b001_000, "all full, mailbox 0 has the lowest priority");
        assert_eq!(mailboxes.status(true) >> 26, 0b100_000);
    }

    #[test]
    fn a_failed_attempt_is_repeated_unless_once_or_aborted() {
        let mut mailboxes = Mailboxes::default();
        request(&mut mailboxes, 0, 1);
        mailboxes.start(0);
        mailboxes.finish(0, Attempt::Failed, false);
        assert_eq!(mailboxes.status(false) & 0xF, TERR);
        assert!(mailboxes.next(false).is_some() && !mailboxes.irq());
        mailboxes.start(0);
        mailboxes.finish(0, Attempt::LostArbitration, true);
        assert_eq!(mailboxes.status(false) & 0xF, RQCP | ALST);
        assert!(mailboxes.next(false).is_none() && mailboxes.irq());
        mailboxes.control(RQCP);
        assert_eq!(mailboxes.status(false) & 0xF, 0);
    }

    #[test]
    fn an_abort_on_the_bus_waits_for_the_attempt() {
        let mut mailboxes = Mailboxes::default();
        request(&mut mailboxes, 0, 1);
        request(&mut mailboxes, 1, 2);
        mailboxes.start(0);
        mailboxes.control(ABRQ | ABRQ << 8);
        assert_eq!(mailboxes.status(false) & 0x0F0F, RQCP << 8, "the pending one is gone at once");
        mailboxes.finish(0, Attempt::Sent, false);
        assert_eq!(mailboxes.status(false) & 0xF, RQCP | TXOK);
    }

    #[test]
    fn a_mailbox_in_use_is_not_written() {
        let mut mailboxes = Mailboxes::default();
        request(&mut mailboxes, 0, 1);
        assert_eq!(mailboxes.write(0, 2, 5), None);
    }
}
