"""The interface `cantap` of python-can."""

import asyncio
import os
import statistics
import struct
import subprocess
import sys
import textwrap
import threading
import time

import pytest

import cantap

can = pytest.importorskip("can")

QUIET = "virtual:load=0,wire=joined"


@pytest.fixture
def pair():
    with (
        can.Bus(interface="cantap", channel=f"{QUIET}:1", bitrate=500_000) as first,
        can.Bus(interface="cantap", channel=f"{QUIET}:2", bitrate=500_000) as second,
    ):
        yield first, second


def message(identifier=0x123, data=b"\x01\x02", **options):
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=identifier > 0x7FF, **options)


def test_two_channels_share_a_session(pair):
    first, second = pair
    assert first.device is second.device
    first.send(message())
    heard = second.recv(10)
    assert heard.arbitration_id == 0x123 and bytes(heard.data) == b"\x01\x02" and heard.channel == 1
    assert abs(heard.timestamp - time.time()) < 5
    assert heard.is_rx and not heard.is_error_frame
    second.shutdown()
    first.send(message(), timeout=120)
    assert first.losses()["lost"] == 0 and first.losses()["received"] == 0
    first.shutdown()
    first.shutdown()
    assert first.device.closed


def test_send_waits_for_the_bus_if_asked_to():
    with can.Bus(interface="cantap", channel="virtual:load=0,ack=no", bitrate=500_000) as bus:
        bus.send(message())
        with pytest.raises(can.CanOperationError, match="taken back"):
            bus.send(message(), timeout=0.3)


def test_own_messages_come_if_asked_for():
    with can.Bus(interface="cantap", channel=QUIET, bitrate=500_000, receive_own_messages=True) as bus:
        bus.send(message())
        own = bus.recv(10)
        assert own.arbitration_id == 0x123 and not own.is_rx
    with can.Bus(interface="cantap", channel=QUIET, bitrate=500_000) as bus:
        bus.send(message(), timeout=120)
        assert bus.recv(0.1) is None


def test_filters_hold_from_the_first_message_on_and_can_be_changed(pair):
    first, _ = pair
    filters = [
        {"can_id": 0x100, "can_mask": 0x700, "extended": False},
        {"can_id": 0x1ABCDE00, "can_mask": 0x1FFFFFFF, "extended": True},
    ]
    with can.Bus(interface="cantap", channel=f"{QUIET}:2", bitrate=500_000, can_filters=filters) as bus:
        for identifier in (0x123, 0x223, 0x1ABCDE00, 0x1ABCDE01, 0x1FF):
            first.send(message(identifier), timeout=120)
        assert [bus.recv(10).arbitration_id for _ in range(3)] == [0x123, 0x1ABCDE00, 0x1FF]
        assert bus.recv(0.05) is None
        bus.set_filters([{"can_id": 0x223, "can_mask": 0x7FF}])
        first.send(message(0x123), timeout=120)
        first.send(message(0x223), timeout=120)
        assert bus.recv(10).arbitration_id == 0x223
        bus.set_filters(None)
        first.send(message(0x321), timeout=120)
        assert bus.recv(10).arbitration_id == 0x321


ONE = [{"can_id": 0x100, "can_mask": 0x7FF, "extended": False}]
OTHER = [{"can_id": 0x200, "can_mask": 0x7FF, "extended": False}]


def identifiers(bus):
    """Of all messages that wait, or arrive within a moment."""
    return [found.arbitration_id for found in iter(lambda: bus.recv(0.2), None) if not found.is_error_frame]


@pytest.mark.parametrize("listen_only", [True, False])
def test_filters_can_be_widened(pair, listen_only):
    first, second = pair
    second.shutdown()
    options = {"channel": f"{QUIET}:2", "bitrate": 500_000, "listen_only": listen_only}
    with can.Bus(interface="cantap", can_filters=ONE, **options) as bus:
        for wanted, passing in ((ONE, [0x100]), (ONE + OTHER, [0x100, 0x200]), (None, [0x100, 0x200, 0x300]), (OTHER, [0x200])):
            bus.set_filters(wanted)
            for identifier in (0x100, 0x200, 0x300):
                first.send(message(identifier))
            assert identifiers(bus) == passing


@pytest.mark.parametrize("listen_only", [True, False])
def test_each_bus_object_of_a_channel_has_its_own_filters(pair, listen_only):
    first, second = pair
    second.shutdown()
    options = {"interface": "cantap", "channel": f"{QUIET}:2", "bitrate": 500_000, "listen_only": listen_only}
    with (
        can.Bus(can_filters=ONE, **options) as narrow,
        can.Bus(can_filters=OTHER, **options) as other,
        can.Bus(**options) as wide,
    ):
        for identifier in (0x100, 0x200, 0x300):
            first.send(message(identifier))
        assert identifiers(narrow) == [0x100] and identifiers(other) == [0x200]
        assert identifiers(wide) == [0x100, 0x200, 0x300]
        # Narrowing one, or its end, takes nothing from the others.
        narrow.set_filters(OTHER)
        other.shutdown()
        for identifier in (0x100, 0x200, 0x300):
            first.send(message(identifier))
        assert identifiers(narrow) == [0x200] and identifiers(wide) == [0x100, 0x200, 0x300]


def test_opening_a_channel_anew_for_a_wider_filter_is_a_loss_in_every_stream(pair):
    """The hardware cannot be given other filters while a channel is open, so a moment of the bus is missed."""
    _, second = pair
    second.shutdown()
    options = {"interface": "cantap", "channel": f"{QUIET}:2", "bitrate": 500_000, "listen_only": True}
    with can.Bus(can_filters=ONE, **options) as bus, can.Bus(can_filters=ONE, **options) as narrower:
        assert narrower.recv(0.2) is None and bus.recv(0) is None
        narrower.set_filters(None)
        for one in (bus, narrower):
            lost = one.recv(10)
            assert lost.is_error_frame and lost.arbitration_id & 0x04 and lost.data[1] == 0x01
        # It is wide now.
        bus.set_filters(OTHER)
        assert bus.recv(0.2) is None and narrower.recv(0) is None


def test_what_waits_must_pass_new_filters_as_well(pair):
    first, second = pair
    for identifier in (0x100, 0x200, 0x300):
        first.send(message(identifier), timeout=120)
    # The others have come with it.
    assert second.recv(10).arbitration_id == 0x100
    second.set_filters([{"can_id": 0x300, "can_mask": 0x7FF}])
    assert identifiers(second) == [0x300]


def hears(open_bus):
    """What each of three Bus objects on one channel receives of messages that the first two send, and whether as received."""
    with open_bus() as first, open_bus(receive_own_messages=True) as second, open_bus(can_filters=ONE) as third:
        first.send(message(0x100))
        first.send(message(0x300))
        second.send(message(0x200))
        task = first.send_periodic(message(0x100, b"\x07"), 0.01, duration=0.03)
        time.sleep(0.3)
        task.stop()
        found = []
        for bus in (first, second, third):
            heard = list(iter(lambda bus=bus: bus.recv(0.2), None))
            found.append(sorted((one.arbitration_id, bytes(one.data), one.is_rx) for one in heard))
    return found


def test_bus_objects_on_one_channel_hear_each_other_as_on_python_cans_virtual_interface():
    with can.Bus(interface="cantap", channel=f"{QUIET}:2", bitrate=500_000):
        ours = hears(lambda **options: can.Bus(interface="cantap", channel=f"{QUIET}:1", bitrate=500_000, **options))
    theirs = hears(lambda **options: can.Bus(interface="virtual", channel="hears", **options))
    assert [sorted(set(one)) for one in ours] == [sorted(set(one)) for one in theirs]
    assert ours[0] == [(0x200, b"\x01\x02", True)]
    assert (0x200, b"\x01\x02", False) in ours[1] and (0x100, b"\x01\x02", True) in ours[1]
    assert ours[2] == [(0x100, b"\x01\x02", True)] + 3 * [(0x100, b"\x07", True)]


def test_a_filter_that_no_identifier_passes_lets_none_pass(pair):
    first, second = pair
    second.set_filters([{"can_id": 0x10000, "can_mask": 0x1FFFFFFF, "extended": False}])
    first.send(message(), timeout=120)
    assert second.recv(0.1) is None


def test_errors_are_error_frames_as_socketcan_has_them():
    with can.Bus(interface="cantap", channel="virtual:load=50,errors=20", bitrate=500_000, listen_only=True) as bus:
        errors = [found for found in (bus.recv(10) for _ in range(2000)) if found.is_error_frame]
    assert errors and all(error.dlc == 8 for error in errors)
    # linux/can/error.h: 0x80 is a bus error, 0x04 a controller problem.
    assert any(error.arbitration_id & 0x80 for error in errors)


def test_a_loss_is_an_error_frame_and_is_counted():
    with can.Bus(
        interface="cantap", channel="virtual:load=80", bitrate=500_000, listen_only=True, rx_capacity=50
    ) as bus:
        time.sleep(0.5)
        lost, frames = 0, 0
        for _ in range(400):
            found = bus.recv(10)
            if found.is_error_frame and found.arbitration_id & 0x04 and found.data[1] == 0x01:
                lost += struct.unpack_from("<I", found.data, 2)[0]
            frames += not found.is_error_frame
        counts = bus.losses()
    assert lost > 0 and counts["bus"] >= lost and counts["lost"] == counts["bus"] and frames > 300


def test_periodic_messages_are_sent_by_the_devices_timer(pair):
    first, second = pair
    task = first.send_periodic(message(0x200, b"\x00"), 0.01)
    assert type(task).__name__ == "DeviceCyclicTask"
    times = [second.recv(10).timestamp for _ in range(30)]
    gaps = [after - before for before, after in zip(times, times[1:])]
    # Not all: on a busy computer its view of the device's clock improves in between.
    assert 0.0099 < statistics.median(gaps) < 0.0101, gaps
    task.modify_data(message(0x200, b"\x55"))
    assert any(bytes(second.recv(10).data) == b"\x55" for _ in range(10))
    with pytest.raises(ValueError):
        task.modify_data(message(0x201, b"\x55"))
    task.stop()
    # What was on its way, and then nothing.
    assert any(second.recv(0.3) is None for _ in range(100))
    assert second.recv(0.1) is None
    task.start()
    assert second.recv(10) is not None


def test_a_limited_task_sends_as_often_as_it_lasts(pair):
    first, second = pair
    first.send_periodic(message(), 0.01, duration=0.2)
    assert all(second.recv(10) is not None for _ in range(20))
    assert second.recv(0.3) is None


def test_python_can_before_4_5_starts_periodic_messages_too(pair, monkeypatch):
    """It has no `autostart`: the modifier callback comes in its place."""
    from cantap import can_bus

    first, second = pair
    monkeypatch.setattr(can_bus, "HAS_AUTOSTART", False)
    task = first._send_periodic_internal([message()], 0.01, None, None)
    assert type(task).__name__ == "DeviceCyclicTask" and second.recv(10) is not None
    task.stop()


def test_what_the_device_cannot_repeat_a_thread_does(pair):
    first, second = pair
    task = first.send_periodic([message(data=b"\x01"), message(data=b"\x02")], 0.01)
    assert type(task).__name__ == "HostCyclicTask"
    assert {bytes(second.recv(10).data) for _ in range(6)} == {b"\x01", b"\x02"}
    task.stop()
    many = [first.send_periodic(message(), 10) for _ in range(40)]
    kinds = {type(one).__name__ for one in many}
    assert kinds == {"DeviceCyclicTask", "HostCyclicTask"}


def test_more_periodic_messages_than_the_device_has_room_for_take_one_thread_and_end_in_silence(caplog, capfd):
    with (
        can.Bus(interface="cantap", channel=f"{QUIET}:1", bitrate=500_000) as first,
        can.Bus(interface="cantap", channel=f"{QUIET}:2", bitrate=500_000) as second,
    ):
        threads = threading.active_count()
        for number in range(60):
            first.send_periodic(message(0x200 + number), 0.02)
        turns = first.send_periodic([message(0x100, b"\x01"), message(0x100, b"\x02")], 0.02)
        changed = first.send_periodic(message(0x101, b"\x00"), 0.02, modifier_callback=count_up)
        assert threading.active_count() == threads + 1
        wanted = {0x200 + number for number in range(60)} | {0x100, 0x101}
        heard, data = set(), {0x100: [], 0x101: []}
        while heard != wanted or any(len(of) < 4 for of in data.values()):
            found = second.recv(10)
            heard.add(found.arbitration_id)
            data.get(found.arbitration_id, []).append(found.data[0])
        assert data[0x100][:4] == [1, 2, 1, 2] and data[0x101][:4] == [1, 2, 3, 4]
        turns.modify_data([message(0x100, b"\x03"), message(0x100, b"\x04")])
        assert any(found.data[0] == 4 for found in iter(lambda: second.recv(10), None) if found.arbitration_id == 0x100)
        changed.stop()
        first.shutdown()
        assert threading.active_count() == threads
        # What was on its way, and then nothing.
        assert any(second.recv(0.3) is None for _ in range(10_000))
    assert not caplog.records and "Traceback" not in "".join(capfd.readouterr())


def count_up(found):
    found.data[0] += 1


def test_a_periodic_message_that_cannot_be_sent_stops_alone(pair, caplog):
    first, second = pair

    def fails(found):
        raise RuntimeError("no more of it")

    first.send_periodic(message(0x100), 0.01, modifier_callback=fails)
    going = first.send_periodic([message(0x101)] * 2, 0.01)
    assert all(second.recv(10).arbitration_id == 0x101 for _ in range(10))
    assert [record.getMessage() for record in caplog.records] == ["periodic message 100 stopped: no more of it"]
    going.stop()


def test_a_full_queue_leaves_periodic_messages_out_instead_of_stopping_them():
    with can.Bus(interface="cantap", channel="virtual:load=0,ack=no", bitrate=500_000) as bus:
        bus.send_periodic([message(0x100), message(0x100)], 0.0005)
        time.sleep(0.5)
        begin = time.monotonic()
        bus.shutdown()
        # Not after the time for which a message waits for room.
        assert time.monotonic() - begin < 5


def test_the_state_is_the_controllers():
    with can.Bus(interface="cantap", channel=QUIET, bitrate=500_000) as bus:
        assert bus.state is can.BusState.ACTIVE
        bus.state = can.BusState.PASSIVE
        assert bus.state is can.BusState.PASSIVE
        with pytest.raises(can.CanOperationError, match="only listens"):
            bus.send(message())
        bus.state = can.BusState.ACTIVE
        bus.send(message(), timeout=120)
        with pytest.raises(ValueError):
            bus.state = can.BusState.ERROR
    with can.Bus(interface="cantap", channel="virtual:load=0,disturb=100", bitrate=500_000, manual_recovery=True) as bus:
        with pytest.raises(can.CanOperationError):
            bus.send(message(), timeout=2)
        assert bus.state is can.BusState.ERROR


def test_timing_can_be_given_in_segments():
    timing = can.BitTiming.from_sample_point(f_clock=8_000_000, bitrate=250_000, sample_point=75)
    with can.Bus(interface="cantap", channel=QUIET, timing=timing) as bus:
        assert bus.device.channels[1]["bitrate"] == 250_000


def test_asyncio_waits_for_the_file_descriptor(pair):
    first, second = pair

    async def run():
        reader = can.AsyncBufferedReader()
        notifier = can.Notifier(second, [reader], loop=asyncio.get_running_loop())
        for identifier in range(300):
            first.send(message(identifier))
        found = [(await asyncio.wait_for(reader.get_message(), 30)).arbitration_id for _ in range(300)]
        notifier.stop()
        return found

    assert asyncio.run(run()) == list(range(300))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_opens_its_own_session():
    code = f"""
        import os, can, warnings
        warnings.simplefilter("ignore", DeprecationWarning)
        bus = can.Bus(interface="cantap", channel="{QUIET}:1", bitrate=500_000)
        child = os.fork()
        if child == 0:
            try:
                bus.recv(0.1)
            except can.CanOperationError as error:
                print("fork" if "fork" in str(error) else error, flush=True)
            with can.Bus(interface="cantap", channel="{QUIET}:1", bitrate=500_000) as own:
                own.send(can.Message(arbitration_id=1), timeout=120)
                print("own", flush=True)
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        bus.send(can.Message(arbitration_id=1), timeout=120)
        bus.shutdown()
    """
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    assert result.stdout.split() == ["fork", "own"] and result.returncode == 0, result.stderr


def test_an_argument_with_a_slip_is_not_silence():
    with pytest.warns(cantap.CantapWarning, match="listen_onlyy"):
        can.Bus(interface="cantap", channel=QUIET, bitrate=500_000, listen_onlyy=True).shutdown()
    with pytest.raises(can.CanInitializationError, match="ERROR"):
        can.Bus(interface="cantap", channel=QUIET, bitrate=500_000, state=can.BusState.ERROR)


def test_a_configuration_file_may_say_yes_and_no(tmp_path, monkeypatch):
    lines = ["[default]", "interface = cantap", f"channel = {QUIET}:2", "bitrate = 500000", "listen_only = yes", "one_shot = no"]
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(tmp_path / "can.conf")])
    (tmp_path / "can.conf").write_text("\n".join([*lines, "receive_own_messages = off", "rx_capacity = 1000"]))
    with can.Bus() as bus:
        assert bus.device.channels == {2: {"bitrate": 500_000, "mode": "listen-only"}}
    (tmp_path / "can.conf").write_text("\n".join([*lines, "manual_recovery = perhaps"]))
    with pytest.raises(can.CanInitializationError, match="manual_recovery"):
        can.Bus()


def test_a_period_that_is_none_is_an_error_and_no_flood(pair):
    first, second = pair
    for period in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="period"):
            first.send_periodic(message(), period)
    assert second.recv(0.1) is None


def test_boards_are_detected():
    assert isinstance(can.detect_available_configs("cantap"), list)


def test_what_cannot_be_opened_or_sent_is_an_error_of_python_can(pair):
    first, _ = pair
    with pytest.raises(can.CanInitializationError):
        can.Bus(interface="cantap", channel="/dev/no-such-port:1", bitrate=500_000)
    with pytest.raises(can.CanInitializationError, match="500000"):
        can.Bus(interface="cantap", channel=f"{QUIET}:1", bitrate=250_000)
    with pytest.raises(can.CanInitializationError, match="FD"):
        can.Bus(interface="cantap", channel=QUIET, bitrate=500_000, fd=True)
    with pytest.raises(can.CanInitializationError):
        can.Bus(interface="cantap", channel="virtual:load=0,serial=X", bitrate=3)
    for wrong in (message(is_fd=True), message(is_error_frame=True), can.Message(arbitration_id=0x800, is_extended_id=False)):
        with pytest.raises(can.CanOperationError):
            first.send(wrong)


def test_a_bus_that_is_shut_down_gives_nothing(pair):
    first, _ = pair
    bus = can.Bus(interface="cantap", channel=f"{QUIET}:2", bitrate=500_000)
    for identifier in (0x100, 0x101, 0x102):
        first.send(message(identifier), timeout=120)
    assert bus.recv(10).arbitration_id == 0x100
    bus.shutdown()
    # Not even what was already here; and nothing is sent or withdrawn by it, although another Bus object has the device.
    for call in (
        lambda: bus.recv(0),
        lambda: bus.send(message()),
        lambda: bus.send_periodic(message(), 0.1),
        lambda: bus.state,
        lambda: bus.losses(),
        lambda: bus.flush_tx_buffer(),
        lambda: bus.recover(),
    ):
        with pytest.raises(can.CanOperationError):
            call()


def test_a_derived_class_may_have_its_own_way_to_receive(pair):
    """As python-can documents it: what `_recv_internal` has not filtered is filtered by `recv`, which waits for the rest of its time."""
    from cantap.can_bus import CantapBus

    class Answers(CantapBus):
        def _recv_internal(self, timeout):
            message, _ = super()._recv_internal(timeout)
            if message is not None:
                message.arbitration_id ^= 1
            return message, False

    first, _ = pair
    with Answers(f"{QUIET}:2", bitrate=500_000) as bus:
        bus._filters = [{"can_id": 0x122, "can_mask": 0x7FF}]
        for identifier in (0x122, 0x123):
            first.send(message(identifier), timeout=120)
        assert bus.recv(10).arbitration_id == 0x122
        begin = time.monotonic()
        assert bus.recv(0.2) is None
        assert 0.15 < time.monotonic() - begin < 5


def test_received_messages_are_logged_as_python_can_logs_them(pair, caplog):
    first, second = pair
    first.send(message(0x100), timeout=120)
    assert second.recv(10).arbitration_id == 0x100 and not caplog.records
    second.RECV_LOGGING_LEVEL = 30
    first.send(message(0x101), timeout=120)
    assert second.recv(10).arbitration_id == 0x101
    assert [record.getMessage()[:9] for record in caplog.records] == ["Received:"]
