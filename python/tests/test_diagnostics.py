"""ECUs of the virtual car, and bit rates that are found by listening."""

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
