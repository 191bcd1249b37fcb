"""Identifiers, times, rates and channels are written as in docs/grammar.md, whatever function takes them."""

import datetime

import numpy as np
import pytest

import cantap
from cantap import bench

QUIET = "virtual:load=0,wire=joined"
#: Ways to write a fifth of a second, 500 kbit/s, channel 1 and the identifier 123.
TIMES = [0.2, "200ms", "0.2s", "0.2", datetime.timedelta(milliseconds=200), np.timedelta64(200, "ms"), np.float64(0.2)]
RATES = [500_000, "500k", "0.5M", "500000", "500kbit/s", 5e5, np.int64(500_000)]
CHANNELS = [1, "1", "can0", "vcan0", np.uint8(1)]
IDS = [0x123, "123", "0x123", np.int64(0x123)]


def ways(values):
    return pytest.mark.parametrize("value", values, ids=repr)


@pytest.fixture(scope="module")
def device():
    with cantap.open(QUIET, 500_000, mode="normal") as device:
        yield device


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    log = tmp_path_factory.mktemp("grammar") / "drive.log"
    log.write_text("".join(f"({at / 10:.6f}) can{at % 2} 123#{at:02X}\n" for at in range(10)))
    return log


BY_TIME = {
    "read": lambda device, time: device.read(time),
    "batch": lambda device, time: device.batch(time, rows=1),
    "batches": lambda device, time: device.batches(time),
    "records.read": lambda device, time: device.records().read(time),
    "records.batch": lambda device, time: device.records().batch(time, 1),
    "identify": lambda device, time: device.identify(time),
    "send_periodic": lambda device, time: device.send_periodic(1, "123#00", time).stop(),
    "ecu": lambda device, time: device.ecu(1, p2=time, p2_star=time, timeout=time),
}


@ways(TIMES)
@pytest.mark.parametrize("call", BY_TIME.values(), ids=BY_TIME)
def test_a_time_of_a_device(device, call, value):
    call(device, value)
    for wrong in ("soon", "5 parsecs", "", "-1s"):
        with pytest.raises(ValueError):
            result = call(device, wrong)
            # Whoever takes it later says so later.
            next(result) if hasattr(result, "__next__") else result.request("3E00")
    with pytest.raises(TypeError):
        result = call(device, [1])
        next(result) if hasattr(result, "__next__") else result.request("3E00")


@ways(TIMES)
def test_a_time_of_a_trace_or_a_test(log, value):
    assert cantap.stats(log, window=value)["channels"]
    assert len(cantap.read(log, start=value)) == 8
    with bench.Bus() as bus:
        before = bus.now
        bus.wait(value)
        assert bus.now - before == pytest.approx(0.2)
        repeated = bus.periodic("123#00", value)
        bus.expect_none("124", value)
        repeated.stop()


@ways(TIMES)
def test_a_send_time_is_at_most_so_long(device, value):
    assert device.send(1, "123#00", timeout="10s") and len(device.send(1, ["1#00", "0x18FEF100#11.22"], timeout=10)) == 2
    with pytest.raises(ValueError, match="timeout"):
        device.send(1, "123#00", timeout=value, at=device.time() + 1000)


@ways(RATES)
def test_a_bit_rate(log, value):
    with cantap.open(QUIET, value) as device:
        assert {about["bitrate"] for about in device.channels.values()} == {500_000}
        device.close_channel(1)
        assert device.open_channel(1, value) == 500_000
    for rates in (value, {1: value}, {"can0": value}):
        channels = cantap.stats(log, rates, data_bitrate=rates)["channels"]
        assert channels[0]["bitrate_bps"] == 500_000
    with bench.Bus(bitrate=value):
        pass
    can = pytest.importorskip("can")
    with can.Bus(interface="cantap", channel=f"{QUIET}:1", bitrate=value) as bus:
        assert bus.device.channels[1]["bitrate"] == 500_000


def test_bit_rates_of_single_channels(log):
    for rates in ({1: "250k", "can1": 500_000}, ["250k", "2:500k"], ["1:250k", "can1:500k"]):
        with cantap.open(QUIET.replace(",wire=joined", ""), rates) as device:
            assert {number: about["bitrate"] for number, about in device.channels.items()} == {1: 250_000, 2: 500_000}
        assert [channel["bitrate_bps"] for channel in cantap.stats(log, rates)["channels"]] == [250_000, 500_000]
    for rates in ({2: "500k"}, "2:500k", "can1:500k"):
        with cantap.open(QUIET, rates) as device:
            assert list(device.channels) == [2]
    with cantap.open(QUIET, {2: "500k"}, channels="both") as device:
        assert sorted(device.channels) == [1, 2]


@pytest.mark.parametrize(
    ("rate", "error", "said"),
    [
        ("fast", ValueError, "such as 500000, 500k or 1M"),
        ("500", ValueError, "write 500k"),
        (500, ValueError, "write 500k"),
        (500.5, TypeError, "a text such as '500k'"),
        (b"500k", TypeError, "'500k'"),
        ("3:500k", ValueError, "no channel 3"),
        ({1: "1:500k"}, ValueError, "given already"),
    ],
)
def test_what_is_no_bit_rate_is_told_what_would_be(log, rate, error, said):
    with pytest.raises(error, match=said):
        cantap.open(QUIET, rate)
    if said != "no channel 3":
        with pytest.raises(error, match=said):
            cantap.stats(log, rate)
    can = pytest.importorskip("can")
    if isinstance(rate, str) and "3:" not in rate:
        with pytest.raises(can.CanInitializationError, match=said):
            can.Bus(interface="cantap", channel=f"{QUIET}:1", bitrate=rate)


def test_auto_listens_to_a_device_and_to_no_trace(log):
    with pytest.raises(ValueError, match="auto listens to a device"):
        cantap.stats(log, "auto")
    with cantap.open("virtual:load=20", "1:auto") as device:
        assert device.channels[1]["bitrate"] == 500_000
    can = pytest.importorskip("can")
    with can.Bus(interface="cantap", channel="virtual:load=20:1", bitrate="auto") as bus:
        assert bus.device.channels[1]["bitrate"] == 500_000


@ways(CHANNELS)
def test_a_channel(device, log, value):
    assert device.send(value, "123#00", timeout=10)
    device.abort(value)
    device.records(value).close()
    device.send_periodic(value, "123#00", 1).stop()
    device.reply(value, 0x7DF, "7E8#00").stop()
    assert "channel" in repr(device.ecu(value))
    with cantap.open(QUIET) as other:
        for call in (other.open_channel, other.close_channel):
            call(value)
    with cantap.open(QUIET, 500_000, channels=value) as other:
        assert list(other.channels) == [1]
    with bench.Bus(channel=value) as bus:
        bus.send("123#00", channel=value)
    # A trace's.
    assert len(cantap.read(log, channel=value)) == len(cantap.search(log, id=0x123, channel=value)) == 5


def test_channels_of_a_trace(log, tmp_path):
    assert len(cantap.read(log, channel="1,2")) == len(cantap.read(log, channel="can0,can1")) == len(cantap.read(log, channel="both")) == 10
    assert len(cantap.read(log, channel=["can1", 1])) == len(cantap.read(log, channel="all")) == 10
    (tmp_path / "car.dbc").write_text('VERSION ""\nBU_: A\nBO_ 291 Engine: 1 A\n SG_ Speed : 0|8@1+ (1,0) [0|255] "" A\n')
    db = cantap.load_database({"can1": tmp_path / "car.dbc"})
    assert cantap.decode(log, db).report.decoded == 5
    assert db.decode("123#05", channel="can1") and db.decode("123#05", channel="can0") is None
    for wrong in ("3x", "", "eth0", "-1", "can", "256"):
        with pytest.raises(ValueError, match="no channel"):
            cantap.read(log, channel=wrong)
        with pytest.raises(ValueError, match="no channel"):
            cantap.open(QUIET, 500_000, channels=wrong)


@ways(IDS)
def test_an_identifier(device, log, value):
    assert cantap.Frame(value, b"\x11") == cantap.Frame("123#11") == cantap.Frame.parse("0x123#11")
    device.reply(1, value, "7E8#00", mask="7F0").stop()
    assert "123:12B" in repr(device.ecu(1, value)) and "123:456" in repr(device.ecu(1, value, "456"))
    assert len(cantap.search(log, id=value)) == 10
    with bench.Bus() as bus:
        bus.expect_none(value, 0.01)


def test_digits_say_how_many_bits_an_identifier_has(device):
    assert cantap.Frame("1A1#00").id == 0x1A1 and not cantap.Frame("1A1").extended
    assert cantap.Frame("000001A1").extended and cantap.Frame("1A1", extended=True).extended and cantap.Frame("1#").id == 1
    assert cantap.Frame("123##311").brs and cantap.Frame("123#R3").dlc == 3
    assert "18DA10F1:18DAF110" in repr(device.ecu(1, "18DA10F1")) and "6F1/12:612/F1" in repr(device.ecu(1, "6F1/12:612/F1"))


@pytest.mark.parametrize(
    ("call", "error", "said"),
    [
        (lambda device: cantap.Frame("12G"), ValueError, "write up to 3 hexadecimal digits"),
        (lambda device: cantap.Frame("800"), ValueError, "00000800"),
        (lambda device: cantap.Frame("12?"), ValueError, "several identifiers"),
        (lambda device: cantap.Frame("x" * 1000), ValueError, "is not an identifier"),
        (lambda device: cantap.Frame("123#00", b"\x00"), ValueError, "whole frame already"),
        (lambda device: cantap.Frame("123#00", extended=True), ValueError, "whole frame already"),
        (lambda device: cantap.Frame("123#0"), ValueError, "'123#0' is not a frame"),
        (lambda device: cantap.Frame(1.5), TypeError, "an identifier is a number such as 0x123, or a text such as '123', not float"),
        (lambda device: cantap.Frame(b"123#00"), TypeError, "not bytes"),
        (lambda device: device.reply(1, "100-1FF", "7E8#00"), ValueError, "identifier"),
        (lambda device: device.reply(1, "123", "7E8#00", mask="FFF"), ValueError, "FFF"),
        (lambda device: device.ecu(1, "7E0:7E8", "7E8"), ValueError, "a pair already"),
        (lambda device: device.ecu(1, "7E0:").request("3E00"), ValueError, "is not a pair"),
    ],
)
def test_what_is_no_identifier_is_told_what_would_be(device, call, error, said):
    with pytest.raises(error, match=said):
        call(device)
