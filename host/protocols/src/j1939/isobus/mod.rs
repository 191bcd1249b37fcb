//! What agricultural machines say by ISO 11783 in groups of their own: virtual terminals (VT), task controllers (TC), tractor implement management
//! (TIM), and what control functions can do. The tables, with their sources, are `data/isobus.csv` and `data/isobus-ddi.csv`.

mod device_description;
mod identifiers;
mod layout;
mod process_data;
mod tables;

use self::tables::FILE;
use super::header::Header;
use crate::table::Table;
use crate::{Event, Field};

const VT_TO_ECU: u32 = 0xE600;
const ECU_TO_VT: u32 = 0xE700;
const PROCESS_DATA: u32 = 0xCB00;
const WORKING_SET_MASTER: u32 = 0xFE0D;
const FUNCTIONALITIES: u32 = 0xFC8E;
/// TIM of both generations, from the server and to it.
const TIM: [u32; 4] = [0x2300, 0x2400, 0x3C00, 0x3D00];

static TIM_CODES: Table = Table::new(FILE, "tim");
static FUNCTIONALITY: Table = Table::new(FILE, "functionality");

/// Adds what a message says; false if its group is none of these, or it says nothing that is known.
pub fn fields(header: Header, data: &[u8], event: &mut Event) -> bool {
    let Some(&first) = data.first() else { return false };
    match header.pgn {
        VT_TO_ECU | ECU_TO_VT => {
            let direction = if header.pgn == ECU_TO_VT { "to_vt" } else { "to_ecu" };
            let Some(layout) = layout::find(direction, first) else { return false };
            event.fields.push(Field::hex("function", first, 2).meaning(Some(layout.name)));
            layout.fields(data, &mut event.fields);
            let rest = layout.rest(data);
            if !rest.is_empty() {
                event.fields.push(Field::bytes("data", rest));
            }
            event.title = format!("{}: {}", event.title, layout.name).into();
            true
        }
        PROCESS_DATA => process_data::fields(data, event),
        WORKING_SET_MASTER => {
            event.fields.push(Field::number("members", first));
            true
        }
        FUNCTIONALITIES => functionalities(data, &mut event.fields),
        pgn if TIM.contains(&pgn) => {
            event.fields.push(Field::hex("code", first, 2).meaning(TIM_CODES.get(first)));
            event.fields.push(Field::bytes("data", &data[1..]));
            true
        }
        _ => false,
    }
}

/// The list of what a control function can do: number, generation and options of each.
fn functionalities(data: &[u8], fields: &mut Vec<Field>) -> bool {
    let [0xFF, count, rest @ ..] = data else { return false };
    fields.push(Field::number("functionalities", *count));
    let mut rest = rest;
    for _ in 0..*count {
        let [number, generation, length, more @ ..] = rest else { break };
        let Some((options, after)) = more.split_at_checked(usize::from(*length)) else { break };
        fields.push(Field::number("functionality", *number).meaning(FUNCTIONALITY.get(*number)));
        fields.push(Field::number("generation", *generation));
        fields.push(Field::bytes("options", options));
        rest = after;
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::j1939::J1939;
    use crate::testing::event_lines;

    fn lines(frames: &[&str]) -> Vec<String> {
        let frames: Vec<_> = frames.iter().enumerate().map(|(n, frame)| (n as f64 * 100.0, *frame)).collect();
        event_lines(J1939::new(None), &frames)
    }

    /// What follows the title.
    fn text_of(frame: &str) -> String {
        lines(&[frame]).remove(0).split_once(" > ").unwrap().1.to_owned()
    }

    /// Frames as AgIsoStack++'s client and server build them (isobus_virtual_terminal_client.cpp, isobus_virtual_terminal_server.cpp).
    #[test]
    fn a_terminal_and_its_client_say_what_they_do() {
        assert_eq!(
            text_of("14E72680#A8D204FF39300000"),
            "38 ECU to VT: change numeric value: pgn 59136, priority 5, function 0xA8 (change numeric value), object 1234, value 12345"
        );
        assert_eq!(
            text_of("14E68026#0001D204E8030AFF"),
            "128 VT to ECU: soft key activation: pgn 58880, priority 5, function 0x00 (soft key activation), key_state 1 (pressed), \
             object 1234, parent 1000, key 10"
        );
        assert_eq!(
            text_of("14E6FF26#FE80E803FFFF00A8"),
            "all VT to ECU: VT status: pgn 58880, priority 5, function 0xFE (VT status), active_master 0x80, mask 1000, \
             soft_key_mask 65535 (none), busy 0x00"
        );
        assert_eq!(
            text_of("14E68026#A8D2040139300000"),
            "128 VT to ECU: change numeric value: pgn 58880, priority 5, function 0xA8 (change numeric value), object 1234, errors 0x01, \
             value 12345"
        );
        assert!(text_of("14E72680#FF0104FFFFFFFFFF").ends_with("initiating 1, version 4"));
        assert!(text_of("14E72680#A0D20401FFFFFFFF").ends_with("object 1234, show 1 (show)"));
        assert!(
            text_of("14E72680#B4D204E803FEFF0A").ends_with("parent 1234, object 1000, x -2"),
            "what is cut is left out"
        );
        // A text in several packets, padded.
        let text =
            lines(&["1CEC2680#100A0002FF00E700", "1CEB2680#01B3D20404004F69", "1CEB2680#026C21FFFFFFFFFF"]);
        assert!(text.last().unwrap().contains("object 1234, length 4, text \"Oil!\""), "{text:?}");
        assert!(
            text_of("14E72680#7E00000000000000").contains("ECU to VT: pgn"),
            "an unknown function stays bytes"
        );
    }

    /// Frames as AgIsoStack++'s task controller client and server build them. DDI 72 is the actual volume content, in millilitres.
    #[test]
    fn process_data_has_the_name_the_value_and_the_unit_of_its_ddi() {
        assert_eq!(
            text_of("0CCBF780#33004800B0040000"),
            "247 process data: value: pgn 51968, priority 3, command 3 (value), element 3, ddi 72 (Actual Volume Content), \
             actual_volume_content 1200 ml"
        );
        assert_eq!(
            text_of("0CCB80F7#12000200FFFFFFFF"),
            "128 process data: request value: pgn 51968, priority 3, command 2 (request value), element 1, \
             ddi 2 (Actual Volume Per Area Application Rate)"
        );
        assert!(text_of("0CCB80F7#140001002A000000").ends_with("interval 42 ms"));
        assert!(text_of("0CCB80F7#18000100F4010000").ends_with("threshold 5 mm³/m²"));
        assert!(text_of("0CCB80F7#1300FEFF05000000").ends_with("ddi 65534, value 5"));
        assert!(
            text_of("0CCBFFF7#FEFFFFFF01FF00FF")
                .ends_with("command 14 (TC status), status 0x01, task 1 (active)")
        );
        assert!(text_of("0CCB80F7#1D0001000203FFFF").ends_with("errors 0x02, acknowledged 3 (value)"));
        assert!(
            text_of("0CCB80F7#1004FF1F00031006")
                .ends_with("version 4, options 0x1F, booms 3, sections 16, channels 6")
        );
        assert!(text_of("0CCBF780#D1D20400FFFFFFFF").contains("process data: designator changed"));
    }

    #[test]
    fn functionalities_and_tim_have_names() {
        assert_eq!(
            text_of("18FC8E80#FF01020401002AFF"),
            "all functionalities: pgn 64654, priority 6, functionalities 1, functionality 2 (UT working set), generation 4, options 00"
        );
        assert!(text_of("0C2400F0#F90102FFFFFFFFFF").contains("code 0xF9 (client status)"));
    }

    #[test]
    fn the_tables_are_read_whole() {
        let mut kinds = std::collections::BTreeMap::<&str, usize>::new();
        for line in crate::table::lines(FILE) {
            *kinds.entry(line.split_once(',').unwrap().0).or_default() += 1;
        }
        assert_eq!(layout::count(), kinds["to_vt"] + kinds["to_ecu"] + kinds["technical"]);
        assert_eq!(
            (TIM_CODES.get(5_u8), FUNCTIONALITY.get(16_u8)),
            (Some("auxiliary valve"), Some("TIM client"))
        );
        assert!(identifiers::count() > 700);
    }
}
