"""ECUs of the virtual car, and bit rates that are found by listening."""

import pathlib
import pickle
import threading

import pytest

import cantap


def test_an_ecu_of_the_virtual_car_answers():
    with cantap.open("virtual:car", mode="normal") as device:
        device.open_channel(1, mode="normal")
        ecu = device.ecu(1)
        assert len(ecu.vin()) == 17
        assert ecu.request("01 0C")[:2] == b"\x41\x0c" and len(ecu.obd(0x0C)) == 2
        assert all(len(code) == 5 and code[0] in "PCBU" for code in ecu.trouble_codes())
        answers = ecu.request_all("01 00")
        assert "7E8" in answers and answers["7E8"][:2] == b"\x41\x00"
        # Everything else goes on.
        assert device.read(timeout=1) is not None


def test_a_refusal_names_its_reason():
    with cantap.open("virtual:car") as device:
        device.open_channel(1, mode="normal")
        with pytest.raises(cantap.NegativeResponse, match="refused") as refusal:
            device.ecu(1).request("BA 00")
        assert refusal.value.service == 0xBA and refusal.value.code in (0x10, 0x11, 0x7F)
        again = pickle.loads(pickle.dumps(refusal.value))
        assert (again.code, str(again)) == (refusal.value.code, str(refusal.value))


def test_nobody_who_answers_is_an_error_that_says_what_to_check():
    with cantap.open("virtual:car") as device:
        device.open_channel(1, mode="normal")
        with pytest.raises(cantap.DeviceError, match="ignition"):
            device.ecu(1, 0x700, 0x701, p2=0.05).request("3E00")
        for wrong in ("", b"", "xyz", [256]):
            with pytest.raises(ValueError):
                device.ecu(1).request(wrong)
        for wrong in (-1, 1 << 29):
            with pytest.raises(ValueError, match="identifier"):
                device.ecu(1, wrong)
        with pytest.raises(ValueError, match="time to wait"):
            device.ecu(1, p2=-1).request("3E00")
    with pytest.raises(cantap.DeviceError, match="closed"):
        device.ecu(1).request("3E00")


def test_a_channel_that_only_listens_asks_nothing():
    with cantap.open("virtual:car") as device:
        device.open_channel(1)
        with pytest.raises(cantap.DeviceError):
            device.ecu(1).request("3E00")


def test_two_programs_threads_ask_at_the_same_time():
    with cantap.open("virtual:car") as device:
        device.open_channel(1, mode="normal")
        found = []
        threads = [threading.Thread(target=lambda: found.append(len(device.ecu(1).request_all("01 00")))) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(found) == 2 and all(found)


def test_a_bit_rate_is_found_by_listening():
    with cantap.open("virtual:bitrate=125k,load=30") as device:
        assert device.autobaud(1) == 125_000
        # What was received on the way belongs to nobody.
        assert device.read(timeout=0.1) is None
        assert device.open_channel(1, "auto") == 125_000
        assert device.read(timeout=120).event == "frame"
        with pytest.raises(ValueError, match="close_channel"):
            device.autobaud(1)
    with cantap.open("virtual:bitrate=250k,load=30", "auto", channels=1) as device:
        assert device.channels[1]["bitrate"] == 250_000


def test_a_silent_bus_has_no_bit_rate_and_says_what_to_check():
    with cantap.open("virtual:load=0") as device:
        with pytest.raises(cantap.DeviceError, match="no traffic on channel 2 .* check the wiring"):
            device.autobaud(2, timeout=0.2)
        with pytest.raises(ValueError, match="time to wait"):
            device.autobaud(1, timeout=-1)


DESCRIPTIONS = pathlib.Path(__file__).parents[2] / "host/protocols/tests/data"
KINDS = DESCRIPTIONS / "kinds.odx-d"


@pytest.fixture
def described():
    """An ECU that answers each request with this, and whoever asks it."""
    with cantap.open("virtual:load=0,wire=joined", "500k", mode="normal") as device:
        replies = []

        def answering(frame):
            for reply in replies:
                reply.stop()
            replies[:] = [device.reply(2, "7E0", frame)]

        yield device.ecu(1, odx=KINDS, p2="10s"), answering


def test_what_a_description_has_is_asked_by_name(described):
    ecu, answering = described
    answering("7E8#0462011178")
    assert ecu.ask("read_temperature") == {"temperature": 20}
    assert ecu.read_data("temperature") == ecu.read_data("0111") == ecu.read_data(0x111) == b"\x78"
    answering("7E8#0662011CFFFE50")
    assert ecu.ask("Read_Point") == {"point.x": -2, "point.y": 0}
    answering("7E8#0562011C0102")
    with pytest.warns(cantap.CantapWarning, match="read_point: point.y has no value: 62 01 1C 01 02"):
        assert ecu.ask("read_point") == {"point.x": 258}
    answering("7E8#037F2231")
    with pytest.raises(cantap.NegativeResponse) as refusal:
        ecu.ask("read_point")
    assert refusal.value.code == 0x31


def test_a_name_that_is_none_says_which_there_are(described):
    ecu, _ = described
    with pytest.raises(ValueError, match="there are: read_point"):
        ecu.read_data("read_points")
    with pytest.raises(ValueError, match="also needs to, gear"):
        ecu.ask("Move to a place")
    with cantap.open("virtual:load=0,wire=joined", 500_000, mode="normal") as device:
        with pytest.raises(ValueError, match="odx="):
            device.ecu(1).read_data("VIN")
        with pytest.raises(ValueError, match="data identifier"):
            device.ecu(1).read_data(0x10000)
        somersault = DESCRIPTIONS / "somersault.pdx"
        assert "07B:1C8" in repr(device.ecu(1, odx=somersault)) and "07B:1C8" in repr(device.ecu(1, odx=f"{somersault}:somersault_lazy"))
        with pytest.raises(ValueError, match="no ECU of the description has 7E1:7E9"):
            device.ecu(1, 0x7E1, odx=somersault)
        with pytest.raises(cantap.DatabaseError, match="no layer nobody"):
            device.ecu(1, odx=f"{somersault}:nobody")
        with pytest.raises(FileNotFoundError):
            device.ecu(1, odx="none.pdx")


def test_descriptions_are_loaded_once(tmp_path):
    odx = cantap.load_odx([KINDS, DESCRIPTIONS / "somersault.pdx"])
    assert cantap.load_odx(odx) is odx and dict(odx.ecus)["somersault_base_variant"] == ["07B:1C8"]
    request, missing = odx.requests("07B:1C8")["session_start"]
    assert request[:1] == b"\x10" and missing == ["bribe"]
    assert pickle.loads(pickle.dumps(odx)).ecus == odx.ecus and "somersault_base_variant" in repr(odx)
    (tmp_path / "bad.odx-d").write_text("<ODX/>")
    with pytest.raises(cantap.DatabaseError, match="bad.odx-d"):
        cantap.load_odx(tmp_path / "bad.odx-d")
    for wrong in ([], [""]):
        with pytest.raises(ValueError):
            cantap.load_odx(wrong)


def test_a_bus_is_not_disturbed_by_accident_or_by_a_device_that_cannot():
    with cantap.open("virtual:load=0", 500_000, mode="normal") as device:
        with pytest.raises(ValueError, match="yes_on_a_test_bench"):
            device.disturb(1, "100ms")
        with pytest.raises(cantap.DeviceError, match="does not disturb a bus"):
            device.disturb("can0", "100ms", yes_on_a_test_bench=True)
        for wrong in ({}, {"at": "1ms", "id": "123"}, {"at": "never"}, {"id": "12G"}):
            with pytest.raises(ValueError):
                device.disturb(1, **wrong, yes_on_a_test_bench=True)
