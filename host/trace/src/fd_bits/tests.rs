use super::*;
use crate::testing::fd_frame;
use proptest::prelude::*;

/// The same in the obvious way: the levels on the bus one after the other, each with its rate.
fn bit_by_bit(frame: &FdFrame) -> (FdBits, Vec<bool>) {
    let field = |value: u32, width: u32| (0..width).rev().map(move |bit| value >> bit & 1 == 1);
    let mut head: Vec<bool> = vec![false];
    let raw = frame.id().raw();
    if frame.id().is_extended() {
        head.extend(field(raw >> 18, 11));
        head.extend([true, true]);
        head.extend(field(raw & 0x3_FFFF, 18));
        head.push(false);
    } else {
        head.extend(field(raw, 11));
        head.extend([false, false]);
    }
    head.extend([true, false, frame.brs()]);
    let arbitration = head.len();
    head.push(frame.esi());
    head.extend(field(u32::from(frame.dlc()), 4));
    frame.data().iter().for_each(|byte| head.extend(field(u32::from(*byte), 8)));

    // After the last bit comes a fixed stuff bit, whatever the levels.
    let (mut line, mut nominal, mut stuff, mut run) = (Vec::new(), 0, 0, 0);
    for (at, bit) in head.iter().enumerate() {
        run = if line.last() == Some(bit) { run + 1 } else { 1 };
        line.push(*bit);
        nominal += u32::from(at < arbitration);
        if run == 5 && at + 1 < head.len() {
            line.push(!bit);
            nominal += u32::from(at + 1 < arbitration);
            stuff += 1;
            run = 1;
        }
    }
    let mut covered = line.clone();
    let gray = [0b000, 0b001, 0b011, 0b010, 0b110, 0b111, 0b101, 0b100][stuff as usize % 8];
    let parity = gray & 1 ^ gray >> 1 & 1 ^ gray >> 2;
    let count: Vec<bool> = field(gray << 1 | parity, 4).collect();
    covered.extend(&count);
    let (width, polynomial) = if frame.data_len() > 16 { (21, 0x30_2899_u64) } else { (17, 0x3_685B) };
    // Division of the whole message by the polynomial; the register starts with its highest bit set.
    let mut register = 1_u64 << (width - 1);
    for bit in &covered {
        register = register << 1 ^ if *bit { 1 << width } else { 0 };
        if register >> width & 1 == 1 {
            register ^= polynomial;
        }
    }
    let crc = register as u32 & ((1 << width) - 1);
    let behind: Vec<bool> = count.into_iter().chain(field(crc, width)).collect();
    let mut fixed_stuff = 0;
    for (at, bit) in behind.into_iter().enumerate() {
        if at % 4 == 0 {
            line.push(!line[line.len() - 1]);
            fixed_stuff += 1;
        }
        line.push(bit);
    }
    // The last bits of the CRC are followed by a stuff bit too; 21 and 25 are not multiples of four.
    line.push(true);
    let data = line.len() as u32 - nominal;
    let tail = [false, true].into_iter().chain([true; 10]);
    line.extend(tail);
    let nominal = nominal + 12;
    let (nominal, data) = if frame.brs() { (nominal, data) } else { (nominal + data, 0) };
    (FdBits { nominal, data, stuff, fixed_stuff, crc }, line)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(5_000))]
    #[test]
    fn any_frame_agrees_with_the_bit_by_bit_model(frame in fd_frame(), sparse: bool) {
        // Sparse data cause many stuff bits.
        let data: Vec<u8> = frame.data().iter().map(|byte| if sparse { byte & 0x81 } else { *byte }).collect();
        let frame = FdFrame::new(frame.id(), frame.brs(), frame.esi(), &data).unwrap();
        let (bits, line) = bit_by_bit(&frame);
        prop_assert_eq!(FdBits::of(&frame), bits);
        prop_assert_eq!(line.len() as u32, bits.total());
        // The rule of the bus: never six equal levels, up to the CRC delimiter.
        let stuffed = &line[..line.len() - 12];
        prop_assert!(stuffed.windows(6).all(|six| six.iter().any(|bit| *bit != six[0])));
    }
}

fn frame(text: &str) -> FdFrame {
    *text.parse::<crate::TraceFrame>().unwrap().fd().unwrap()
}

/// Both CRCs have published check values, of the text "123456789" and a register that starts at zero (the catalogue of
/// parametrised CRC algorithms, CRC-17/CAN-FD and CRC-21/CAN-FD).
#[test]
fn the_polynomials_have_their_published_check_values() {
    for (bits, polynomial, check) in [(17, CRC17_POLYNOMIAL, 0x0_4F03), (21, CRC21_POLYNOMIAL, 0x0E_D841)] {
        let mut register = Register { value: 0, bits, polynomial };
        for byte in b"123456789" {
            (0..8).rev().for_each(|bit| register.push(u32::from(*byte) >> bit & 1));
        }
        assert_eq!(register.value, check);
    }
}

/// Linux counts the same fields in `include/linux/can/length.h`: 67 bits with CRC-17 for a standard frame without data and
/// stuff bits, 86 for an extended one, where CRC-17 needs five fewer than CRC-21 with its fixed stuff bit.
#[test]
fn fields_add_up_as_in_linux() {
    let without_stuff = |text: &str| {
        let bits = FdBits::of(&frame(text));
        (bits.total() - bits.stuff, bits.fixed_stuff)
    };
    let id = ["2AA", "0AAAAAAA"];
    let crc17 = 1 + 11 + 1 + 1 + 1 + 1 + 1 + 1 + 4 + 4 + 17 + 1 + 6 + 1 + 1 + 7 + 3;
    assert_eq!(without_stuff(&format!("{}##1", id[0])), (crc17, 6));
    assert_eq!(without_stuff(&format!("{}##1", id[1])), (crc17 + 19, 6));
    let twenty = "AA".repeat(20);
    assert_eq!(without_stuff(&format!("{}##1{twenty}", id[0])), (crc17 + 160 + 5, 7));
    let most = "AA".repeat(64);
    assert_eq!(without_stuff(&format!("{}##0{most}", id[1])), (crc17 + 19 + 512 + 5, 7));
}

#[test]
fn a_duration_takes_each_bit_at_its_own_rate() {
    let bits = FdBits { nominal: 30, data: 100, stuff: 0, fixed_stuff: 6, crc: 0 };
    assert_eq!(bits.duration_ns(500_000, 2_000_000), 60_000 + 50_000);
    // 30/3 + 100/7 µs: rounded once.
    assert_eq!(bits.duration_ns(3_000_000, 7_000_000), 24_285);
    assert_eq!(FdBits::of(&frame("123##011")).data, 0);
    assert_eq!(FdBits::of(&frame("123##111")).nominal, 17 + 12);
}
