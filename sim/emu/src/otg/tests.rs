//! The controller driven with the register sequences of synopsys-usb-otg 0.4, a driver other than the firmware's: whatever it
//! does that the chip does not forgive must show here.

use super::registers::{
    dcfg, dctl, device, epctl, epint, eptsiz, gahbcfg, gccfg, gint, global, grstctl, pktsts,
};
use super::*;

const IN: u32 = device::IN_ENDPOINTS;
const OUT: u32 = device::OUT_ENDPOINTS;

fn at(base: u32, number: u32, register: u32) -> u32 {
    base + number * device::ENDPOINT_STRIDE + register
}

/// The driver's `enable`.
fn enable(otg: &mut Otg) {
    assert_ne!(otg.read(global::GRSTCTL) & grstctl::AHBIDL, 0);
    otg.write(global::GRSTCTL, grstctl::CSRST);
    assert_eq!(otg.read(global::GRSTCTL) & grstctl::CSRST, 0);
    otg.write(global::GCCFG, gccfg::PWRDWN | gccfg::NOVBUSSENS);
    otg.write(device::PCGCCTL, 0);
    otg.write(device::DCTL, dctl::SDIS);
    let speed = otg.read(device::DCFG) | 3;
    otg.write(device::DCFG, speed);
    otg.write(device::DIEPMSK, epint::XFRC);
    let mask = gint::USBRST | gint::ENUMDNE | gint::USBSUSP | gint::WKUPINT | gint::IEPINT | gint::RXFLVL;
    otg.write(global::GINTMSK, mask);
    otg.write(global::GINTSTS, !0);
    otg.write(global::GAHBCFG, gahbcfg::GINT);
    otg.write(device::DCTL, 0);
}

/// The driver's `configure_all` with a CDC-ACM function's endpoints, and what usb-device does around it.
fn configure(otg: &mut Otg) {
    otg.write(global::GRXFSIZ, 64);
    for (fifo, (depth, start)) in [(16, 64), (16, 80), (16, 96), (0, 112)].into_iter().enumerate() {
        let register = [global::DIEPTXF0, global::DIEPTXF1, global::DIEPTXF1 + 4, global::DIEPTXF3][fifo];
        otg.write(register, depth << 16 | start);
    }
    otg.write(global::GRSTCTL, grstctl::RXFFLSH | grstctl::TXFFLSH | 0x10 << grstctl::TXFNUM_SHIFT);
    otg.write(device::DAINTMSK, 0x0001_0007);
    otg.write(at(IN, 0, device::EPCTL), epctl::SNAK);
    otg.write(at(IN, 0, device::EPTSIZ), 64);
    let bulk = epctl::USBAEP | 2 << 18 | epctl::SD0PID | 64;
    for number in 1..3 {
        let control = bulk | epctl::SNAK | number << epctl::TXFNUM_SHIFT;
        otg.write(at(IN, number, device::EPCTL), control);
    }
    otg.write(at(OUT, 0, device::EPTSIZ), 1 << 29 | 1 << eptsiz::PKTCNT_SHIFT | 64);
    modify(otg, at(OUT, 0, device::EPCTL), epctl::EPENA | epctl::CNAK);
    otg.write(at(OUT, 1, device::EPCTL), bulk | epctl::CNAK | epctl::EPENA);
    let address = otg.read(device::DCFG) & !dcfg::DAD;
    otg.write(device::DCFG, address);
}

fn modify(otg: &mut Otg, register: u32, set: u32) {
    let value = otg.read(register) | set;
    otg.write(register, value);
}

/// The driver's `poll` when it sees a reset: everything is taken out of use.
fn poll_reset(otg: &mut Otg) {
    assert_ne!(otg.read(global::GINTSTS) & gint::USBRST, 0);
    otg.write(global::GINTSTS, gint::USBRST);
    for number in 0..3 {
        let register = at(IN, number, device::EPCTL);
        let control = otg.read(register) & !epctl::USBAEP;
        otg.write(register, control);
        if control & epctl::EPENA != 0 && number != 0 {
            modify(otg, register, epctl::EPDIS);
        }
        otg.write(at(IN, number, device::EPINT), 0xFF);
    }
    otg.write(global::GRSTCTL, grstctl::RXFFLSH);
}

/// The driver's `write`; returns whether there was room.
fn write_packet(otg: &mut Otg, number: u32, bytes: &[u8]) -> bool {
    let control = at(IN, number, device::EPCTL);
    if number != 0 && otg.read(control) & epctl::EPENA != 0 {
        return false;
    }
    if otg.read(at(IN, number, device::TXFSTS)) < bytes.len().div_ceil(4) as u32 {
        return false;
    }
    otg.write(at(IN, number, device::EPTSIZ), 1 << eptsiz::PKTCNT_SHIFT | bytes.len() as u32);
    modify(otg, control, epctl::CNAK | epctl::EPENA);
    for piece in bytes.chunks(4) {
        let mut word = [0; 4];
        word[..piece.len()].copy_from_slice(piece);
        otg.write(FIFOS + number * FIFO_STRIDE, u32::from_le_bytes(word));
    }
    true
}

/// Takes one entry of the receive queue: endpoint, state, bytes.
fn receive(otg: &mut Otg) -> (u8, u32, Vec<u8>) {
    assert_ne!(otg.read(global::GINTSTS) & gint::RXFLVL, 0, "nothing was received");
    let status = otg.read(global::GRXSTSP);
    let length = (status >> 4 & 0x7FF) as usize;
    let mut bytes: Vec<u8> = (0..length.div_ceil(4)).flat_map(|_| otg.read(FIFOS).to_le_bytes()).collect();
    bytes.truncate(length);
    let (endpoint, state) = ((status & 0xF) as u8, status >> 17 & 0xF);
    if state == pktsts::OUT_COMPLETE || state == pktsts::SETUP_COMPLETE {
        modify(otg, at(OUT, u32::from(endpoint), device::EPCTL), epctl::CNAK | epctl::EPENA);
    }
    (endpoint, state, bytes)
}

fn running() -> Otg {
    let mut otg = Otg::new();
    enable(&mut otg);
    assert!(otg.pulled_up(true));
    otg.bus_reset();
    poll_reset(&mut otg);
    otg.enumeration_done();
    otg.write(global::GINTSTS, gint::ENUMDNE);
    configure(&mut otg);
    otg
}

fn data(data1: bool, bytes: &[u8]) -> InReply {
    InReply::Data { data1, bytes: bytes.to_vec() }
}

#[test]
fn the_pull_up_needs_transceiver_and_soft_connect() {
    let mut otg = Otg::new();
    assert!(!otg.pulled_up(true));
    enable(&mut otg);
    assert!(otg.pulled_up(false));
    otg.write(device::DCTL, dctl::SDIS);
    assert!(!otg.pulled_up(true));
    otg.write(device::DCTL, 0);
    otg.write(global::GCCFG, gccfg::PWRDWN | gccfg::VBUSBSEN);
    assert!(otg.pulled_up(true) && !otg.pulled_up(false));
}

#[test]
fn a_packet_leaves_only_when_the_fifo_holds_it() {
    let mut otg = running();
    assert_eq!(otg.in_token(0, 2, true), InReply::Nak);
    otg.write(at(IN, 2, device::EPTSIZ), 1 << eptsiz::PKTCNT_SHIFT | 6);
    modify(&mut otg, at(IN, 2, device::EPCTL), epctl::CNAK | epctl::EPENA);
    otg.write(FIFOS + 2 * FIFO_STRIDE, 0x0403_0201);
    assert_eq!(otg.in_token(0, 2, true), InReply::Nak);
    otg.write(FIFOS + 2 * FIFO_STRIDE, 0x0605);
    assert!(!otg.irq());
    // The handshake is lost: the same packet again.
    assert_eq!(otg.in_token(0, 2, false), data(false, &[1, 2, 3, 4, 5, 6]));
    assert_eq!(otg.in_token(0, 2, true), data(false, &[1, 2, 3, 4, 5, 6]));
    assert!(otg.irq());
    assert_eq!(otg.read(device::DAINT), 1 << 2);
    assert_eq!(otg.read(at(IN, 2, device::EPCTL)) & epctl::EPENA, 0);
    otg.write(at(IN, 2, device::EPINT), epint::XFRC);
    assert!(!otg.irq());
    assert!(write_packet(&mut otg, 2, &[9]));
    assert_eq!(otg.in_token(0, 2, true), data(true, &[9]));
    assert!(write_packet(&mut otg, 2, &[]));
    assert_eq!(otg.in_token(0, 2, true), data(false, &[]));
    assert_eq!(otg.misuse(), Misuse::default());
}

#[test]
fn a_second_packet_waits_for_the_first() {
    let mut otg = running();
    assert!(write_packet(&mut otg, 2, &[7; 64]));
    assert_eq!(otg.read(at(IN, 2, device::TXFSTS)), 0);
    assert!(!write_packet(&mut otg, 2, &[8; 64]));
    assert_eq!(otg.in_token(0, 2, true), data(false, &[7; 64]));
    assert!(write_packet(&mut otg, 2, &[8; 64]));
}

#[test]
fn out_packets_queue_with_their_completion_and_hold_off_the_next() {
    let mut otg = running();
    assert_eq!(otg.out(0, 1, false, b"hello"), OutReply::Ack);
    assert!(otg.irq());
    // It is not armed again until the completion has been taken.
    assert_eq!(otg.out(0, 1, true, b"world"), OutReply::Nak);
    assert_eq!(receive(&mut otg), (1, pktsts::OUT_DATA, b"hello".to_vec()));
    assert_eq!(otg.out(0, 1, true, b"world"), OutReply::Nak);
    assert_eq!(receive(&mut otg), (1, pktsts::OUT_COMPLETE, vec![]));
    assert!(!otg.irq());
    // The host missed our handshake and repeats the packet: acknowledged, not delivered.
    assert_eq!(otg.out(0, 1, false, b"hello"), OutReply::Ack);
    assert!(!otg.irq());
    assert_eq!(otg.out(0, 1, true, b"world"), OutReply::Ack);
    assert_eq!(receive(&mut otg), (1, pktsts::OUT_DATA, b"world".to_vec()));
}

#[test]
fn an_unread_packet_keeps_the_line_asserted() {
    let mut otg = running();
    assert_eq!(otg.out(0, 1, false, &[1]), OutReply::Ack);
    otg.write(global::GINTSTS, !0);
    assert!(otg.irq(), "RXFLVL follows the FIFO and cannot be cleared");
}

#[test]
fn a_new_address_counts_from_the_end_of_the_status_stage() {
    let mut otg = running();
    assert_eq!(otg.setup(0, [0, 5, 42, 0, 0, 0, 0, 0]), OutReply::Ack);
    assert_eq!(receive(&mut otg), (0, pktsts::SETUP_DATA, vec![0, 5, 42, 0, 0, 0, 0, 0]));
    assert_eq!(receive(&mut otg).1, pktsts::SETUP_COMPLETE);
    let address = otg.read(device::DCFG) | 42 << dcfg::DAD_SHIFT;
    otg.write(device::DCFG, address);
    assert!(write_packet(&mut otg, 0, &[]));
    assert_eq!(otg.in_token(42, 0, true), InReply::Silence);
    assert_eq!(otg.in_token(0, 0, true), data(true, &[]));
    assert_eq!(otg.in_token(0, 0, true), InReply::Silence);
    assert_eq!(otg.in_token(42, 0, true), InReply::Nak);
}

#[test]
fn a_setup_ends_a_stall_of_endpoint_0_and_only_a_setup_does() {
    let mut otg = running();
    modify(&mut otg, at(IN, 0, device::EPCTL), epctl::STALL);
    assert_eq!(otg.in_token(0, 0, true), InReply::Stall);
    let control = otg.read(at(IN, 0, device::EPCTL)) & !epctl::STALL;
    otg.write(at(IN, 0, device::EPCTL), control);
    assert_eq!(otg.in_token(0, 0, true), InReply::Stall);
    assert_eq!(otg.setup(0, [0; 8]), OutReply::Ack);
    assert_eq!(otg.in_token(0, 0, true), InReply::Nak);
}

#[test]
fn a_reset_takes_endpoints_out_of_use_and_leaves_transfers_armed() {
    let mut otg = running();
    assert!(write_packet(&mut otg, 2, &[1; 64]));
    otg.bus_reset();
    assert_eq!(otg.in_token(0, 2, true), InReply::Silence);
    assert_ne!(otg.read(at(IN, 2, device::EPCTL)) & epctl::EPENA, 0);
    poll_reset(&mut otg);
    assert_eq!(otg.read(at(IN, 2, device::EPCTL)) & epctl::EPENA, 0);
}

/// synopsys-usb-otg 0.4: a write between reset and enumeration done arms a transfer whose bytes the
/// driver's own configuration then flushes. EPENA cannot be cleared by writing 0, so the endpoint is
/// dead until something disables it.
#[test]
fn a_write_between_reset_and_enumeration_done_kills_the_endpoint() {
    let mut otg = running();
    otg.bus_reset();
    poll_reset(&mut otg);
    assert!(write_packet(&mut otg, 2, &[1; 64]));
    otg.enumeration_done();
    configure(&mut otg);
    assert!(!write_packet(&mut otg, 2, &[2; 64]));
    assert_eq!(otg.in_token(0, 2, true), InReply::Nak);
    // What firmware can do about it.
    modify(&mut otg, at(IN, 2, device::EPCTL), epctl::EPDIS);
    assert!(write_packet(&mut otg, 2, &[2; 64]));
    assert_eq!(otg.in_token(0, 2, true), data(false, &[2; 64]));
}

#[test]
fn suspend_and_resume_raise_their_flags_once() {
    let mut otg = running();
    otg.bus_idle();
    otg.bus_idle();
    assert_ne!(otg.read(global::GINTSTS) & gint::USBSUSP, 0);
    assert_eq!(otg.read(device::DSTS) & 1, 1);
    otg.write(global::GINTSTS, gint::USBSUSP);
    otg.bus_idle();
    assert_eq!(otg.read(global::GINTSTS) & gint::USBSUSP, 0);
    otg.resume();
    assert_ne!(otg.read(global::GINTSTS) & gint::WKUPINT, 0);
    assert!(otg.irq());
}

#[test]
fn what_the_chip_does_not_forgive_is_counted() {
    let mut otg = running();
    otg.read(FIFOS);
    for _ in 0..17 {
        otg.write(FIFOS + 2 * FIFO_STRIDE, 0);
    }
    otg.read(0x440);
    let misuse = Misuse { tx_overflows: 1, rx_misreads: 1, unknown_registers: 1, ..Misuse::default() };
    assert_eq!(otg.misuse(), misuse);
}

#[test]
fn a_transfer_of_several_packets_leaves_packet_by_packet_and_ends_once() {
    let mut otg = running();
    otg.write(global::DIEPTXF1 + 4, 64 << 16 | 0x60);
    otg.write(at(IN, 2, device::EPTSIZ), 3 << eptsiz::PKTCNT_SHIFT | 0x82);
    modify(&mut otg, at(IN, 2, device::EPCTL), epctl::CNAK | epctl::EPENA);
    let words = (0..33u32).map(|n| otg.write(FIFOS + 2 * FIFO_STRIDE, n * 0x0101_0101)).count();
    assert_eq!(words, 33);
    let InReply::Data { data1: false, bytes } = otg.in_token(0, 2, true) else { panic!() };
    assert_eq!((bytes.len(), bytes[4], otg.irq()), (64, 1, false));
    let InReply::Data { data1: true, bytes } = otg.in_token(0, 2, true) else { panic!() };
    assert_eq!((bytes.len(), bytes[0], otg.irq()), (64, 16, false));
    // A third before its end, what is left can be read.
    assert_eq!(otg.read(at(IN, 2, device::EPTSIZ)) >> eptsiz::PKTCNT_SHIFT, 1);
    assert_eq!(otg.in_token(0, 2, true), data(false, &[32, 32]));
    assert!(otg.irq());
}

#[test]
fn nak_taken_back_before_the_end_of_the_transfer_is_counted() {
    let mut otg = running();
    assert_eq!(otg.out(0, 1, false, b"hello"), OutReply::Ack);
    let between = otg.read(global::GRXSTSP);
    assert_eq!(between >> 17 & 0xF, pktsts::OUT_DATA);
    otg.read(FIFOS);
    otg.read(FIFOS);
    modify(&mut otg, at(OUT, 1, device::EPCTL), epctl::CNAK);
    assert_eq!(otg.misuse().early_cnaks, 1);
    assert_eq!(receive(&mut otg).1, pktsts::OUT_COMPLETE);
    assert_eq!(otg.misuse().early_cnaks, 1, "after the end it may be");
}

#[test]
fn an_endpoint_disabled_out_of_order_is_counted() {
    let mut otg = running();
    assert!(write_packet(&mut otg, 2, &[7; 64]));
    modify(&mut otg, at(IN, 2, device::EPCTL), epctl::EPDIS | epctl::SNAK);
    assert_eq!(otg.misuse().unruly_disables, 1, "NAK was not effective yet");
    otg.write(global::GRSTCTL, grstctl::TXFFLSH | 2 << grstctl::TXFNUM_SHIFT);
    assert!(write_packet(&mut otg, 2, &[7; 64]));
    otg.write(global::GRSTCTL, grstctl::TXFFLSH | 2 << grstctl::TXFNUM_SHIFT);
    assert_eq!(otg.misuse().unruly_disables, 2, "flushed under a transfer");
    modify(&mut otg, at(IN, 2, device::EPCTL), epctl::SNAK);
    assert_ne!(otg.read(at(IN, 2, device::EPINT)) & epint::INEPNE, 0);
    modify(&mut otg, at(IN, 2, device::EPCTL), epctl::EPDIS | epctl::SNAK);
    otg.write(global::GRSTCTL, grstctl::TXFFLSH | 2 << grstctl::TXFNUM_SHIFT);
    assert_eq!(otg.misuse(), Misuse { unruly_disables: 2, ..Misuse::default() });
}

#[test]
fn fifos_that_are_too_small_or_overlap_are_counted() {
    for (register, value, bad) in [
        (global::DIEPTXF1 + 4, 16 << 16 | 0x60, false),
        (global::DIEPTXF1 + 4, 15 << 16 | 0x60, true),
        (global::DIEPTXF1 + 4, 16 << 16 | 0x5F, true),
        (global::DIEPTXF3, 16 << 16 | 0x131, true),
        (global::GRXFSIZ, 34, true),
    ] {
        let mut otg = running();
        otg.write(register, value);
        modify(&mut otg, at(IN, 2, device::EPCTL), epctl::EPENA);
        assert_eq!(otg.misuse().bad_fifo_layout > 0, bad, "{register:#x} {value:#x}");
    }
}

#[test]
fn a_toggle_that_is_not_expected_is_acknowledged_and_dropped_until_it_is_reset() {
    let mut otg = running();
    assert_eq!(otg.out(0, 1, false, b"one"), OutReply::Ack);
    assert_eq!(receive(&mut otg).2, b"one");
    receive(&mut otg);
    // The host starts over and the device does not: the packet is lost.
    assert_eq!(otg.out(0, 1, false, b"two"), OutReply::Ack);
    assert!(!otg.irq());
    assert_eq!(otg.thrown_away(), 1);
    modify(&mut otg, at(OUT, 1, device::EPCTL), epctl::SD0PID);
    assert_eq!(otg.out(0, 1, false, b"two"), OutReply::Ack);
    assert_eq!(receive(&mut otg).2, b"two");
}
