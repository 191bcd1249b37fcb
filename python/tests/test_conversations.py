"""What frames mean by the protocols of their bus, and the test of a board."""

import datetime
import json
import os
import shutil
import signal
import subprocess
import threading
import warnings

import pyarrow as pa
import pytest

import cantap
from test_read import rows

# A workshop: a VIN is read while the car talks, a service is refused, one transfer breaks, and the last request is not answered.
WORKSHOP = """\
(1.000000) can0 7E0#0322F190AAAAAAAA
(1.000500) can0 123#1008112233445566
(1.002500) can0 7E8#101462F190575657
(1.003000) can0 7E0#300000AAAAAAAAAA
(1.004000) can0 7E8#215A5A5A314B5A41
(1.005000) can0 7E8#2257303030303031
(2.000000) can0 7E0#022703AAAAAAAAAA
(2.001500) can0 7E8#037F2733AAAAAAAA
(3.000000) can0 7DF#02010CAAAAAAAAAA
(3.001000) can0 7E8#04410C1AF8AAAAAA
(3.002000) can0 7E8#101462F190575657
(3.003000) can0 7E0#300000AAAAAAAAAA
(3.004000) can0 7E8#2257303030303031
(4.000000) can0 7E0#023E00AAAAAAAAAA
"""

# An engine's speed, a position, a heartbeat, and a message of J1939 in several frames.
MACHINES = [
    *(f"({second}.0{at}0000) can0 0CF0040{at}#017DA06813FFF0FF" for second in range(1, 5) for at in range(3)),
    "(5.000000) can0 1CECFF00#20120003FFCAFE00",
    "(5.100000) can0 1CEBFF00#0115FF6E00038A01",
    "(5.200000) can0 1CEBFF00#026F00050FFFFFFF",
    "(5.300000) can0 1CEBFF00#03FFFFFFFFFFFFFF",
    *(f"(6.{at}00000) can1 09F80105#80841E1D00CA9A3B" for at in range(9)),
    *(f"(7.{at}00000) can2 705#05" for at in range(9)),
]


@pytest.fixture
def workshop(tmp_path):
    path = tmp_path / "workshop.log"
    path.write_text(WORKSHOP)
    return path


@pytest.fixture
def machines(tmp_path):
    path = tmp_path / "machines.log"
    path.write_text("\n".join(MACHINES) + "\n")
    return path


def test_an_exchange_is_a_row(workshop):
    table = cantap.conversations(workshop)
    assert table.column_names == (
        "place", "time", "channel", "protocol", "kind", "from", "to", "title",
        "start", "fields", "response_ms", "data", "frames", "trouble", "trouble_text", "frames_lost",
    )  # fmt: skip
    said = rows(table)
    assert [(row["protocol"], row["kind"], row["title"]) for row in said] == [
        ("uds", "exchange", "ReadDataByIdentifier"),
        ("uds", "refusal", "SecurityAccess"),
        ("obd", "exchange", "current data"),
        ("isotp", "broken", "broken transfer"),
        ("uds", "no_response", "TesterPresent"),
    ]
    vin = said[0]
    assert (vin["from"], vin["to"], vin["response_ms"], vin["trouble"], vin["frames_lost"]) == ("7E0", "7E8", 2.5, None, False)
    assert json.loads(vin["fields"]) == {"sid": 0x22, "did": 0xF190, "value": "WVWZZZ1KZAW000001"}
    assert vin["data"] == b"\x62\xf1\x90WVWZZZ1KZAW000001"
    assert (vin["start"].timestamp(), vin["time"].timestamp()) == (1.0, 1.005)
    assert [row["trouble"] for row in said[3:]] == ["sequence", "unfinished"]
    assert table.report.frames == 14 and table.report.is_whole
    assert table["fields"].to_list()[0] == vin["fields"] and table["trouble"].to_list()[0] is None
    assert table.schema["fields"] == "text" and table.to_numpy()["fields"][0] == vin["fields"]
    assert [row["place"] for row in rows(cantap.conversations(workshop, faults=True))] == [1, 3, 4]


def test_a_field_is_a_row_if_that_is_wanted(workshop):
    table = cantap.conversations(workshop, fields="*")
    assert table.column_names == (
        "place", "time", "channel", "protocol", "kind", "from", "to", "title", "name", "value", "raw", "text", "unit",
    )  # fmt: skip
    said = {(row["place"], row["name"]): (row["value"], row["raw"], row["text"], row["unit"]) for row in rows(table)}
    assert said[0, "uds.did"] == (0xF190, 0xF190, "VIN", None)
    assert said[0, "uds.value"] == (None, None, "WVWZZZ1KZAW000001", None)
    assert said[1, "uds.nrc"] == (0x33, 0x33, "securityAccessDenied", None)
    assert said[2, "obd.engine_speed"] == (1726.0, None, None, "rpm")
    assert said[3, "isotp.data"][2] == "62 F1 90 57 56 57"
    some = cantap.conversations(workshop, fields=["uds.did", "obd.engine_*"])
    assert [row["name"] for row in rows(some)] == ["uds.did", "obd.engine_speed"]
    with pytest.warns(cantap.CantapWarning, match=r"nothing had xcp\.speed"):
        cantap.conversations(workshop, fields=["uds.did", "xcp.speed"])
    with pytest.raises(ValueError, match="begin it with its protocol"):
        cantap.conversations(workshop, fields="Speed")


def test_machines_boats_and_plants_have_values(machines):
    said = rows(cantap.conversations(machines, fields=["j1939.engine_speed", "nmea2000.l*"]))
    speed = [row["value"] for row in said if row["name"] == "j1939.engine_speed"]
    assert speed == [621.0] * 12
    position = {row["name"]: (row["value"], row["unit"]) for row in said if row["channel"] == 2}
    assert position["nmea2000.latitude"] == (48.8539264, "deg") and position["nmea2000.longitude"][0] == 100.0
    transfer = [row for row in rows(cantap.conversations(machines)) if row["frames"] > 1]
    assert [(row["protocol"], row["frames"], len(row["data"])) for row in transfer] == [("j1939", 4, 18)]
    # Heartbeats that tell nothing new are one state.
    [plant] = rows(cantap.conversations(machines, channel=3))
    assert (plant["protocol"], plant["kind"], plant["from"], plant["title"]) == ("canopen", "state", "5", "operational")
    late = rows(cantap.conversations(machines, protocol="j1939", start=2.5, end=3.5))
    assert {row["channel"] for row in late} == {1} and len(late) == 3


def test_it_says_what_the_command_says(workshop, machines):
    command = os.environ.get("CANTAP_COMMAND") or shutil.which("cantap")
    if not command:
        pytest.skip("there is no cantap command: name it in CANTAP_COMMAND")
    for path in (workshop, machines):
        text = subprocess.run([command, "conversations", str(path), "--json", "--quiet"], capture_output=True, check=True).stdout
        theirs = [json.loads(line) for line in text.splitlines()]
        ours = rows(cantap.conversations(path))
        assert len(theirs) == len(ours)
        for one, row in zip(theirs, ours):
            for key in ("channel", "protocol", "kind", "from", "to", "title", "frames"):
                assert one[key] == row[key]
            assert one["fields"] == json.loads(row["fields"]) and one["data"] == row["data"].hex().upper()
            assert one.get("response_ms") == row["response_ms"] and one.get("trouble") == row["trouble"]
            assert one.get("frames_lost", False) == row["frames_lost"]
            assert one["time_s"] == pytest.approx(row["time"].timestamp(), abs=1e-6)


def test_tables_lists_and_other_tables_are_sources_too(workshop, tmp_path):
    expected = rows(cantap.conversations(workshop))
    assert rows(cantap.conversations(cantap.read(workshop))) == expected
    assert rows(cantap.conversations(cantap.read(workshop).to_polars())) == expected
    assert rows(cantap.conversations(cantap.scan(workshop))) == expected
    # An exchange goes on in the next file.
    lines = WORKSHOP.splitlines(keepends=True)
    (tmp_path / "1.log").write_text("".join(lines[:4]))
    (tmp_path / "2.log").write_text("".join(lines[4:]))
    assert rows(cantap.conversations(str(tmp_path / "?.log"))) == expected
    with pytest.raises(ValueError, match="rows"):
        cantap.conversations(cantap.read(workshop), channel=1)
    with pytest.raises(ValueError, match="protocol"):
        cantap.conversations(workshop, protocol="odb")
    with pytest.raises(TypeError):
        cantap.conversations(5)


def test_what_is_known_about_a_bus_is_taken(workshop, tmp_path):
    log = tmp_path / "pair.log"
    log.write_text("(1.000000) can0 612#F1022233\n(1.000500) can0 6F1#12032213141\n".replace("12032213141", "1203221314"))
    assert len(cantap.conversations(log, protocol="uds", pair="6F1/12:612/F1"))
    for argument in ("eds", "odx", "a2l"):
        with pytest.raises(OSError):
            cantap.conversations(workshop, **{argument: tmp_path / "missing"})
    with pytest.raises(ValueError, match="pair"):
        cantap.conversations(workshop, pair="nonsense")
    (tmp_path / "no.eds").write_text("nothing")
    with pytest.raises(cantap.DatabaseError, match="not an EDS"):
        cantap.conversations(workshop, eds=f"5:{tmp_path / 'no.eds'}")


def test_what_nobody_understands_is_a_warning(tmp_path):
    log = tmp_path / "noise.log"
    log.write_text("(1.000000) can0 123#1122\n")
    with pytest.warns(cantap.CantapWarning, match="nothing that a protocol explains"):
        assert len(cantap.conversations(log)) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(cantap.conversations(log, protocol="uds")) == 0


def test_a_device_is_understood_while_it_is_read():
    with cantap.open("virtual:wire=joined,load=0,ack=yes", 500_000, mode="normal") as device:
        said = device.conversations(0.05, protocol="uds")
        frames = ["7E0#0322F190AAAAAAAA", "7E8#0462F19041AAAAAA"]
        sender = threading.Thread(target=lambda: [device.send(1, frame) for frame in frames])
        sender.start()
        table = next(said)
        sender.join()
        first = rows(table)[0]
        assert (first["title"], first["from"]) == ("ReadDataByIdentifier", "7E0")
        device.close()
        assert all(len(table) for table in said)


def test_a_column_without_any_text_has_no_text(tmp_path):
    (tmp_path / "a.dbc").write_text('VERSION ""\nBU_:\nBO_ 291 A: 8 E\n SG_ S : 0|8@1+ (1,0) [0|0] "" E\n')
    (tmp_path / "a.log").write_text("(1.000000) can0 123#11\n")
    table = cantap.read(tmp_path / "a.log", db=tmp_path / "a.dbc")
    assert table["unit"].to_list() == [None] and table[0]["unit"] is None


MCAP = "(1772409590.000000) can0 123#0A01\n(1772409590.500000) can0 124#01\n(1772409591.000000) can0 20000004#0001000000000000\n(1772409592.000000) can0 123#0B02\n"
DBC = """\
VERSION ""
BU_: A
BO_ 291 Engine: 8 A
 SG_ Speed : 0|8@1+ (0.5,0) [0|127] "km/h" A
 SG_ Gear : 8|8@1+ (1,0) [0|255] "" A
VAL_ 291 Gear 1 "First" ;
"""


def test_decoded_signals_become_an_mcap_file(tmp_path):
    make_reader = pytest.importorskip("mcap.reader", reason="pip install mcap").make_reader
    (tmp_path / "a.log").write_text(MCAP)
    (tmp_path / "a.dbc").write_text(DBC)
    out = tmp_path / "a.mcap"
    with pytest.warns(cantap.CantapWarning, match="frames that no database has"):
        left_out = cantap.write(cantap.scan(tmp_path / "a.log"), out, db=tmp_path / "a.dbc")
    assert left_out == {"frames that no database has": 1}

    def messages():
        with open(out, "rb") as file:
            return [(channel.topic, message.log_time, json.loads(message.data)) for _, channel, message in make_reader(file).iter_messages()]

    engine = [(time, content) for topic, time, content in messages() if topic == "/channel1/Engine"]
    first = 1_772_409_590_000_000_000
    assert engine == [
        (first, {"id": 291, "Speed": 5, "Gear": 1, "Gear.text": "First"}),
        (first + 2_000_000_000, {"id": 291, "Speed": 5.5, "Gear": 2}),
    ]
    assert [content["event"] for topic, _, content in messages() if topic == "/events"] == ["lost"]
    table = cantap.read(tmp_path / "a.log", filter="123")
    assert cantap.write(table, out, db=cantap.load_database(tmp_path / "a.dbc"), signals="Speed") == {}
    assert messages()[0] == ("/channel1/Engine", first, {"id": 291, "Speed": 5})
    early = {"time": [datetime.datetime(1960, 1, 1, tzinfo=datetime.timezone.utc)], "id": [291], "data": [b"\x01"]}
    with pytest.warns(cantap.CantapWarning, match="before 1970"):
        cantap.write(early, out, db=tmp_path / "a.dbc")


def test_a_file_of_signals_needs_a_database_and_one_of_frames_none(tmp_path):
    frames = pa.table({"time": [0.0], "id": [0x123], "data": [b"\x11"]})
    (tmp_path / "a.dbc").write_text(DBC)
    with pytest.raises(ValueError, match="db="):
        cantap.write(frames, tmp_path / "a.mcap")
    with pytest.raises(ValueError, match="mcap"):
        cantap.write(frames, tmp_path / "a.blf", db=tmp_path / "a.dbc")
    with pytest.raises(ValueError, match="signals"):
        cantap.write(frames, tmp_path / "a.blf", signals="Speed")
    assert [path.name for path in tmp_path.iterdir()] == ["a.dbc"]


def test_a_board_is_tested_as_by_the_command():
    report = cantap.selftest("virtual:load=0", load_time="300ms")
    assert report["passed"] and report["board"] == "virtual"
    outcomes = {step["name"]: step["outcome"] for step in report["steps"]}
    assert outcomes["channel 2 by itself, 1000000 bit/s"] == "pass" and outcomes["channel 1 to channel 2"] == "skip"
    report = cantap.selftest("virtual:load=0,ack=no", loop=True, load_time=0.1)
    failed = [step["name"] for step in report["steps"] if step["outcome"] == "FAIL"]
    assert not report["passed"] and "channel 1 to channel 2 and back, 500000 bit/s" in failed
    with pytest.raises(ValueError, match="load_time"):
        cantap.selftest("virtual", load_time=0)
    with pytest.raises(cantap.DeviceError):
        cantap.selftest("/dev/nothing-here")


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="it needs a signal that comes by itself")
def test_ctrl_c_ends_the_test_of_a_board():
    class Enough(Exception):
        pass

    def interrupt(*_):
        raise Enough

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.5)
        with pytest.raises(Enough):
            cantap.selftest("virtual:load=0", load_time="1h")
    finally:
        signal.signal(signal.SIGALRM, before)
