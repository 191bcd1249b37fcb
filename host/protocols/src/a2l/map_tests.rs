//! Curves, maps, their axes, and structures of them.

use super::*;

/// An ECU with one object of each kind; words lowest byte first.
const ECU: &str = r#"
ASAP2_VERSION 1 71
/begin PROJECT Demo ""
/begin MODULE Ecu ""
/begin MOD_COMMON "" BYTE_ORDER MSB_LAST /end MOD_COMMON
/begin MEASUREMENT Rows "" UBYTE NO_COMPU_METHOD 1 0 0 255 MATRIX_DIM 3 2 ECU_ADDRESS 0x100 /end MEASUREMENT
/begin MEASUREMENT Columns "" UBYTE NO_COMPU_METHOD 1 0 0 255 MATRIX_DIM 3 2 LAYOUT COLUMN_DIR ECU_ADDRESS 0x110 /end MEASUREMENT
/begin CHARACTERISTIC Curve "" CURVE 0x200 StandardCurve 0 Half 0 100
  /begin AXIS_DESCR STD_AXIS NO_INPUT_QUANTITY Rpm 4 0 8000 /end AXIS_DESCR /end CHARACTERISTIC
/begin CHARACTERISTIC Common "" MAP 0x300 Words 0 Half 0 100
  /begin AXIS_DESCR COM_AXIS NO_INPUT_QUANTITY Rpm 9 0 8000 AXIS_PTS_REF Speeds /end AXIS_DESCR
  /begin AXIS_DESCR FIX_AXIS NO_INPUT_QUANTITY Half 3 0 9 FIX_AXIS_PAR_DIST 4 2 3 /end AXIS_DESCR /end CHARACTERISTIC
/begin CHARACTERISTIC InTurn "" CURVE 0x400 InTurn 0 NO_COMPU_METHOD 0 100
  /begin AXIS_DESCR STD_AXIS NO_INPUT_QUANTITY NO_COMPU_METHOD 2 0 8000 /end AXIS_DESCR /end CHARACTERISTIC
/begin CHARACTERISTIC Block "" VAL_BLK 0x500 Aligned 0 NO_COMPU_METHOD 0 100 NUMBER 2 /end CHARACTERISTIC
/begin CHARACTERISTIC Down "" CURVE 0x600 Down 0 NO_COMPU_METHOD 0 100
  /begin AXIS_DESCR STD_AXIS NO_INPUT_QUANTITY NO_COMPU_METHOD 3 0 100 /end AXIS_DESCR /end CHARACTERISTIC
/begin CHARACTERISTIC Pointed "" CURVE 0x700 Pointed 0 NO_COMPU_METHOD 0 100
  /begin AXIS_DESCR STD_AXIS NO_INPUT_QUANTITY NO_COMPU_METHOD 3 0 100 /end AXIS_DESCR /end CHARACTERISTIC
/begin AXIS_PTS Speeds "" 0x280 NO_INPUT_QUANTITY Axis 0 Rpm 2 0 8000 /end AXIS_PTS
/begin AXIS_PTS Rescaled "" 0x2A0 NO_INPUT_QUANTITY Rescale 0 NO_COMPU_METHOD 9 0 255 /end AXIS_PTS
/begin RECORD_LAYOUT StandardCurve NO_AXIS_PTS_X 1 UBYTE AXIS_PTS_X 2 UWORD INDEX_INCR DIRECT
  FNC_VALUES 3 UBYTE ROW_DIR DIRECT /end RECORD_LAYOUT
/begin RECORD_LAYOUT Words FNC_VALUES 1 UWORD COLUMN_DIR DIRECT /end RECORD_LAYOUT
/begin RECORD_LAYOUT Axis AXIS_PTS_X 1 UWORD INDEX_INCR DIRECT /end RECORD_LAYOUT
/begin RECORD_LAYOUT Rescale NO_RESCALE_X 1 UBYTE RESERVED 2 BYTE AXIS_RESCALE_X 3 UBYTE 2 INDEX_INCR DIRECT /end RECORD_LAYOUT
/begin RECORD_LAYOUT InTurn AXIS_PTS_X 1 UWORD INDEX_INCR DIRECT FNC_VALUES 2 SWORD ALTERNATE_WITH_X DIRECT
  ALIGNMENT_INT64 1 ALIGNMENT_LONG 1 ALIGNMENT_WORD 1 /end RECORD_LAYOUT
/begin RECORD_LAYOUT Aligned IDENTIFICATION 1 UBYTE FNC_VALUES 2 UWORD ROW_DIR DIRECT ALIGNMENT_WORD 4 /end RECORD_LAYOUT
/begin RECORD_LAYOUT Down AXIS_PTS_X 1 UBYTE INDEX_DECR DIRECT FNC_VALUES 2 UBYTE ROW_DIR DIRECT /end RECORD_LAYOUT
/begin RECORD_LAYOUT Pointed AXIS_PTS_X 1 UBYTE INDEX_INCR PWORD FNC_VALUES 2 UBYTE ROW_DIR DIRECT /end RECORD_LAYOUT
/begin RECORD_LAYOUT Byte FNC_VALUES 1 UBYTE ROW_DIR DIRECT /end RECORD_LAYOUT
/begin COMPU_METHOD Rpm "" LINEAR "%5.0" "rpm" COEFFS_LINEAR 10 0 /end COMPU_METHOD
/begin COMPU_METHOD Half "" LINEAR "%5.1" "Nm" COEFFS_LINEAR 0.5 0 /end COMPU_METHOD

/begin INSTANCE Engine "" T_Engine 0x1000 ECU_ADDRESS_EXTENSION 1
  /begin OVERWRITE Speed 0 CONVERSION Half LIMITS 0 9 /end OVERWRITE /end INSTANCE
/begin INSTANCE Alone "" T_Byte 0x1100 MATRIX_DIM 2 /end INSTANCE
/begin INSTANCE Nothing "" T_Missing 0x1200 /end INSTANCE
/begin TYPEDEF_STRUCTURE T_Engine "" 32
  /begin STRUCTURE_COMPONENT Speed T_Word 0 /end STRUCTURE_COMPONENT
  /begin STRUCTURE_COMPONENT Cylinder T_Cylinder 2 MATRIX_DIM 2 2 /end STRUCTURE_COMPONENT
  /begin STRUCTURE_COMPONENT Far T_Word 30 ADDRESS_TYPE PLONG /end STRUCTURE_COMPONENT
  /begin STRUCTURE_COMPONENT x T_Axis 14 /end STRUCTURE_COMPONENT
  /begin STRUCTURE_COMPONENT curve T_Curve 16 /end STRUCTURE_COMPONENT
  /begin STRUCTURE_COMPONENT text T_Text 20 MATRIX_DIM 2 /end STRUCTURE_COMPONENT
/end TYPEDEF_STRUCTURE
/begin TYPEDEF_STRUCTURE T_Cylinder "" 3
  /begin STRUCTURE_COMPONENT Pressure T_Byte 0 /end STRUCTURE_COMPONENT
  /begin STRUCTURE_COMPONENT Flags T_Flags 1 MATRIX_DIM 2 /end STRUCTURE_COMPONENT
/end TYPEDEF_STRUCTURE
/begin TYPEDEF_MEASUREMENT T_Word "" UWORD Rpm 1 0 0 8000 /end TYPEDEF_MEASUREMENT
/begin TYPEDEF_MEASUREMENT T_Byte "" UBYTE NO_COMPU_METHOD 1 0 0 255 /end TYPEDEF_MEASUREMENT
/begin TYPEDEF_MEASUREMENT T_Flags "" UBYTE NO_COMPU_METHOD 1 0 0 255 BIT_MASK 0xF0 /end TYPEDEF_MEASUREMENT
/begin TYPEDEF_AXIS T_Axis "" NO_INPUT_QUANTITY ByteAxis 0 Rpm 2 0 8000 /end TYPEDEF_AXIS
/begin TYPEDEF_CHARACTERISTIC T_Text "" ASCII Byte 0 NO_COMPU_METHOD 0 255 NUMBER 3 /end TYPEDEF_CHARACTERISTIC
/begin TYPEDEF_CHARACTERISTIC T_Curve "" CURVE Byte 0 NO_COMPU_METHOD 0 255
  /begin AXIS_DESCR COM_AXIS NO_INPUT_QUANTITY Rpm 2 0 8000 AXIS_PTS_REF THIS.x /end AXIS_DESCR /end TYPEDEF_CHARACTERISTIC
/begin RECORD_LAYOUT ByteAxis AXIS_PTS_X 1 UBYTE INDEX_INCR DIRECT /end RECORD_LAYOUT
/end MODULE
/end PROJECT
"#;

fn ecu() -> Description {
    Description::parse(ECU).unwrap().remove(0)
}

fn fields(extension: u8, address: u32, bytes: &[u8]) -> Vec<String> {
    ecu().fields(extension, address, bytes, None).iter().map(ToString::to_string).collect()
}

/// The values of an object, by the name and the place of each.
fn places(object: &MemoryObject) -> Vec<String> {
    let place = |at| {
        format!(
            "{} {:X}",
            object.element_name(at),
            object.address + object.offset + object.element_offset(at)
        )
    };
    (0..object.count()).map(place).collect()
}

#[test]
fn arrays_are_in_rows_or_in_columns() {
    let expected =
        ["Rows[0][0] 1", "Rows[1][0] 2", "Rows[2][0] 3", "Rows[0][1] 4", "Rows[1][1] 5", "Rows[2][1] 6"];
    assert_eq!(fields(0, 0x100, &[1, 2, 3, 4, 5, 6]), expected);
    let expected = ["Columns[0][0] 1", "Columns[0][1] 2", "Columns[1][0] 3", "Columns[1][1] 4"];
    assert_eq!(fields(0, 0x110, &[1, 2, 3, 4]), expected);
    let ecu = ecu();
    assert_eq!(
        ecu.element("Rows[2][1]").map(|(object, at)| (object.name.as_str(), at)),
        Some(("Rows", Some(5)))
    );
    for wrong in ["Rows[3][0]", "Rows[1]", "Rows[1][1][1]", "Rows[x][1]", "Rows]"] {
        assert!(ecu.element(wrong).is_none(), "{wrong}");
    }
}

/// Its values begin behind as many points as there are, of which there may be four.
#[test]
fn what_a_curve_is_depends_on_how_many_points_it_has_now() {
    let ecu = ecu();
    let curve = ecu.object("Curve").unwrap();
    assert_eq!(curve.numbers(), [Some("Curve.NO_AXIS_PTS_X".to_owned())]);
    let now = curve.with_points(&[Some(2)]).unwrap();
    assert_eq!(places(&now), ["Curve[0] 206", "Curve[1] 207"]);
    assert_eq!(places(&curve.with_points(&[None]).unwrap()).last().unwrap(), "Curve[3] 20D");
    assert!(curve.with_points(&[Some(0)]).is_err() && curve.with_points(&[Some(5)]).is_err());
    let axis = ecu.object("Curve.AXIS_PTS_X").unwrap().with_points(&[Some(2)]).unwrap();
    assert_eq!(places(&axis), ["Curve.AXIS_PTS_X[0] 202", "Curve.AXIS_PTS_X[1] 204"]);
    // A listener does not know how many there are: values are named only where they always are.
    let known = ["Curve.NO_AXIS_PTS_X 2", "Curve.AXIS_PTS_X[0] 10 rpm", "Curve.AXIS_PTS_X[1] 20 rpm"];
    assert_eq!(fields(0, 0x200, &[2, 0, 1, 0, 2, 0]), known);
    // With a static layout, the values are where they are with the most.
    let fixed = ECU.replace(
        "FNC_VALUES 3 UBYTE ROW_DIR DIRECT /end",
        "FNC_VALUES 3 UBYTE ROW_DIR DIRECT STATIC_RECORD_LAYOUT /end",
    );
    let fixed = Description::parse(&fixed).unwrap().remove(0);
    let now = fixed.object("Curve").unwrap().with_points(&[Some(2)]).unwrap();
    assert_eq!(places(&now), ["Curve[0] 20A", "Curve[1] 20B"]);
}

#[test]
fn axes_are_common_fixed_in_turn_or_backwards() {
    let ecu = ecu();
    let map = ecu.object("Common").unwrap();
    assert_eq!(
        places(map)[..4],
        ["Common[0][0] 300", "Common[0][1] 302", "Common[0][2] 304", "Common[1][0] 306"]
    );
    let [Axis::Stored(x), Axis::Fixed(y)] = &map.axes[..] else { panic!("{:?}", map.axes) };
    assert_eq!(places(ecu.object(x).unwrap()), ["Speeds[0] 280", "Speeds[1] 282"]);
    let y: Vec<_> = y.iter().map(ToString::to_string).collect();
    assert_eq!(y, ["Common.AXIS_PTS_Y[0] 2 Nm", "Common.AXIS_PTS_Y[1] 3 Nm", "Common.AXIS_PTS_Y[2] 4 Nm"]);
    let turns = ["InTurn.AXIS_PTS_X[0] 1", "InTurn[0] -1", "InTurn.AXIS_PTS_X[1] 2", "InTurn[1] -2"];
    assert_eq!(fields(0, 0x400, &[1, 0, 0xFF, 0xFF, 2, 0, 0xFE, 0xFF]), turns);
    assert_eq!(places(ecu.object("Block").unwrap()), ["Block[0] 504", "Block[1] 506"]);
    assert_eq!(fields(0, 0x600, &[7, 8, 9])[0], "Down.AXIS_PTS_X[2] 7");
    assert_eq!(fields(0, 0x2A2, &[1, 2]), ["Rescaled[0][0] 1", "Rescaled[0][1] 2"]);
}

#[test]
fn members_of_structures_are_named_by_their_path() {
    let bytes = [20, 0, 1, 0x2F, 0x3F, 4];
    let expected = [
        "Engine.Speed 10 Nm",
        "Engine.Cylinder[0][0].Pressure 1",
        "Engine.Cylinder[0][0].Flags[0] 2",
        "Engine.Cylinder[0][0].Flags[1] 3",
        "Engine.Cylinder[1][0].Pressure 4",
    ];
    assert_eq!(fields(1, 0x1000, &bytes), expected);
    assert_eq!(fields(0, 0x1000, &bytes), [""; 0], "it has an address extension");
    assert_eq!(fields(1, 0x1008, &[9]), ["Engine.Cylinder[0][1].Pressure 9"]);
    assert_eq!(fields(1, 0x1010, &[1, 2]), ["Engine.curve[0] 1", "Engine.curve[1] 2"]);
    assert_eq!(fields(1, 0x1017, b"ab\0"), ["Engine.text[1] \"ab\""]);
    assert_eq!(fields(0, 0x1100, &[1, 2]), ["Alone[0] 1", "Alone[1] 2"]);
    let ecu = ecu();
    let [Axis::Stored(axis)] = &ecu.object("Engine.curve").unwrap().axes[..] else { panic!() };
    assert_eq!(axis, "Engine.x");
    assert_eq!(ecu.object("Engine.Speed").unwrap().limits, (0.0, 9.0));
    assert_eq!(
        ecu.issues,
        [
            "Engine.Far: it is behind a pointer",
            "Nothing: there is no type T_Missing",
            "Pointed: points behind pointers"
        ]
    );
}

#[test]
fn structures_without_end_are_bounded() {
    let structure = |name: &str, of: &str| {
        format!(
            "/begin TYPEDEF_STRUCTURE {name} \"\" 4 /begin STRUCTURE_COMPONENT a {of} 0 MATRIX_DIM 100 100 /end STRUCTURE_COMPONENT /end TYPEDEF_STRUCTURE "
        )
    };
    let text = ECU.replace(
        "/begin INSTANCE Engine",
        &format!(
            "{}{}/begin INSTANCE Endless \"\" Round 0 /end INSTANCE /begin INSTANCE Engine",
            structure("Round", "Trip"),
            structure("Trip", "Round")
        ),
    );
    let description = Description::parse(&text).unwrap().remove(0);
    assert!(
        description.issues.iter().any(|issue| issue.contains("too many structures")),
        "{:?}",
        description.issues.len()
    );
}

#[test]
fn addresses_count_units_of_the_granularity() {
    let words = ECU.replace(
        "/begin MOD_COMMON",
        "/begin IF_DATA XCP /begin PROTOCOL_LAYER 0x0100 25 25 0 0 0 0 0 8 8 BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_WORD /end PROTOCOL_LAYER /end IF_DATA /begin MOD_COMMON",
    );
    let description = Description::parse(&words).unwrap().remove(0);
    assert_eq!(description.granularity(), 2);
    let fields: Vec<_> =
        description.fields(0, 0x101, &[3, 4], None).iter().map(ToString::to_string).collect();
    assert_eq!(fields, ["Rows[2][0] 3", "Rows[0][1] 4"]);
}
