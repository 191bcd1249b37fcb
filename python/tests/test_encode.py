"""Frames out of signals, and back."""

import warnings

import can
import pyarrow as pa
import pytest

import cantap

DBC = """\
VERSION ""
BU_: ECU
BO_ 291 Engine: 8 ECU
 SG_ Speed : 0|16@1+ (0.5,0) [0|200] "km/h" ECU
 SG_ Gear : 16|4@1+ (1,0) [0|8] "" ECU
 SG_ Torque : 24|16@1- (0.1,0) [-3000|3000] "Nm" ECU
BO_ 2566844672 Climate: 8 ECU
 SG_ time : 0|8@1+ (1,0) [0|0] "min" ECU
VAL_ 291 Gear 1 "First" 2 "Second" ;
"""


@pytest.fixture
def db(tmp_path):
    (tmp_path / "car.dbc").write_text(DBC)
    return cantap.load_database(tmp_path / "car.dbc")


def test_a_frame_is_made_of_values_and_texts(db):
    frame = db.encode("Engine", {"Speed": 90.5, "Gear": "Second", "Torque": -1})
    assert (frame.id, frame.data) == (291, bytes([181, 0, 2, 246, 255, 0, 0, 0]))
    name, values = db.decode(frame)
    assert name == "Engine" and values == {"Speed": 90.5, "Gear": 2.0, "Gear.text": "Second", "Torque": -1.0}
    # What was decoded can be encoded as it is.
    assert db.encode(name, values) == frame
    assert db.encode("Engine").data == bytes(8)
    assert db.encode("Climate", {"time": 7}).extended


def test_a_frame_to_decode_is_a_text_or_a_message_of_python_can(db):
    assert db.decode("123#B500")[1]["Speed"] == 90.5
    assert db.decode(can.Message(arbitration_id=291, is_extended_id=False, data=[181, 0, 2]))[1]["Gear.text"] == "Second"
    assert db.decode("124#B500") is None
    assert db.decode(can.Message(is_error_frame=True)) is None


@pytest.mark.parametrize(
    ("message", "signals", "words"),
    [
        ("Engin", {}, "Engine"),
        ("Engine", {"Sped": 1}, "Speed"),
        ("Engine", {"Speed": 201}, "allows"),
        ("Engine", {"Gear": "Third"}, "First"),
        ("Engine", {"Speed": 1e99}, "Speed"),
    ],
)
def test_what_cannot_be_encoded_is_an_error_that_says_what_can(db, message, signals, words):
    with pytest.raises(cantap.DatabaseError, match=words):
        db.encode(message, signals)
    with pytest.raises(TypeError, match="Speed: a value is a number"):
        db.encode("Engine", {"Speed": object()})


def test_a_decoded_trace_is_encoded_to_the_same_frames(db, tmp_path):
    log = tmp_path / "drive.log"
    lines = [f"({at}.000000) can{at % 2} 123#{at:02X}000{at % 3}FFFF000000" if at % 4 else f"({at}.000000) can0 18FEF100#{at:02X}00000000000000" for at in range(40)]
    log.write_text("\n".join(lines) + "\n")
    made = cantap.encode(cantap.decode(log, db), db)
    assert pa.table(made).select(["time", "channel", "id", "extended", "data"]) == pa.table(cantap.read(log)).select(["time", "channel", "id", "extended", "data"])
    cantap.write(made, tmp_path / "again.blf")
    assert len(cantap.read(tmp_path / "again.blf")) == 40


def test_columns_of_ones_own_become_a_trace(db):
    made = cantap.encode({"Engine": {"time": [1.0, 0.5, 2.0], "Speed": [10, None, 20.5], "Gear": ["First", "Second", None]}}, db)
    rows = pa.table(made).to_pylist()
    assert [row["time"].timestamp() for row in rows] == [0.5, 1.0, 2.0]
    assert [row["data"][:3] for row in rows] == [b"\0\0\2", b"\x14\0\1", b"\x29\0\0"]
    with pytest.raises(cantap.DatabaseError, match="Engine, row 1"):
        cantap.encode({"Engine": {"time": [0.0, 1.0], "Gear": ["First", "Third"]}}, db)
    with pytest.raises(cantap.FormatError, match="time"):
        cantap.encode({"Engine": {"Gear": ["First"]}}, db)


def test_a_value_beyond_the_databases_limits_is_kept_and_warned_of(db):
    with pytest.warns(cantap.CantapWarning, match=r"Speed \(1\)"):
        made = cantap.encode({"Engine": {"time": [0.0, 1.0], "Speed": [300, 1]}}, db)
    assert pa.table(made).column("data")[0].as_py()[:2] == (600).to_bytes(2, "little")


def test_messages_of_python_can_are_decoded_and_written(db, tmp_path):
    messages = [
        can.Message(timestamp=1.25, arbitration_id=291, is_extended_id=False, data=[20, 0], channel=1),
        can.Message(timestamp=1.5, arbitration_id=0x18FEF100, data=[], channel="can0", is_rx=False),
        can.Message(timestamp=2.0, arbitration_id=1, is_extended_id=False, is_remote_frame=True, dlc=3),
        can.Message(timestamp=3.0, arbitration_id=1, is_extended_id=False, is_fd=True, bitrate_switch=True, data=range(12)),
        can.Message(timestamp=4.0, is_error_frame=True),
    ]
    assert list(cantap.decode(messages, db)["Engine"]["Speed"]) == [10.0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cantap.write(messages, tmp_path / "made.log")
    rows = pa.table(cantap.read(tmp_path / "made.log")).to_pylist()
    assert [row["event"] for row in rows] == ["frame"] * 4 + ["bus-error"]
    assert [row["channel"] for row in rows[:2]] == [2, 1] and rows[2]["remote"] and rows[2]["dlc"] == 3 and rows[3]["brs"]
    for wrong in ([object()], [can.Message(channel=-1)], 5):
        with pytest.raises((TypeError, ValueError)):
            cantap.decode(wrong, db)
