"""The analyser, as the virtual device."""

import itertools
import os
import pickle
import signal
import statistics
import subprocess
import sys
import textwrap
import threading
import time
import warnings

import pyarrow as pa
import pytest

import cantap

QUIET = "virtual:load=0,wire=joined"


@pytest.fixture
def pair():
    """Both channels on one bus, without any other node."""
    with cantap.open(QUIET, 500_000, mode="normal") as device:
        yield device


def script(text, timeout=120, **options):
    """Runs a program and returns what it prints."""
    code = textwrap.dedent(text)
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=timeout, **options
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_records_come_in_order_with_the_devices_stamps():
    with cantap.open("virtual:load=20", 500_000) as device:
        before = time.time()
        records = [record for record, _ in zip(device, range(500))]
        losses = device.losses
    times = [record.time_ns for record in records]
    assert abs(times[0] / 1e9 - before) < 5
    for channel in (1, 2):
        own = [record.time_ns for record in records if record.channel == channel]
        assert own == sorted(own) and len(own) > 50
    assert {record.event for record in records} == {"frame"}
    assert losses[1]["lost"] == losses[2]["lost"] == 0
    assert device.closed and "closed" in repr(device)


def test_waiting_for_a_device_without_an_open_channel_is_said_once():
    for wait in (lambda device: device.read(0), lambda device: device.batch(0), iter):
        with cantap.open("virtual") as device:
            with pytest.warns(cantap.CantapWarning, match="no channel is open, so nothing arrives: give cantap.open a bit rate, or call open_channel") as said:
                wait(device)
                wait(device)
            assert [warning.filename for warning in said] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with cantap.open("virtual", 500_000) as device:
            assert device.read(5) is not None
            device.close_channel(1)
            device.close_channel(2)
            device.read(0)


def test_intervals_are_the_devices_own_on_request():
    with cantap.open("virtual:load=0,wire=joined,ppm=200", 500_000, mode="normal", device_intervals=True) as device:
        task = device.send_periodic(1, "123#11", 0.005, count=300)
        received = (record for record in device if record.channel == 2 and record.event == "frame")
        times = [record.time_ns for _, record in zip(range(300), received)]
        task.stop()
    period_ns = 5_000_000
    off = [(later - earlier) % period_ns for earlier, later in itertools.pairwise(times)]
    # A tick of the device's clock, whatever the computer's says; a busy bus or computer makes whole periods of it.
    assert len(times) == 300 and all(min(ns, period_ns - ns) <= 200 for ns in off), max(off)


def test_what_was_captured_can_be_read_after_closing():
    device = cantap.open("virtual:load=50", 500_000)
    time.sleep(1)
    device.close()
    records = list(device)
    received = sum(record.event == "frame" for record in records)
    assert received > 500


def test_batches_are_tables():
    with cantap.open("virtual:load=50", 500_000) as device:
        table = device.batch(seconds=1)
        assert len(table) > 300
        assert pa.table(table)["channel"].unique().to_pylist() == [1, 2]
        small = device.batch(rows=10)
        assert len(small) == 10
        batches = device.batches(seconds=0.05)
        assert all(len(next(batches)) for _ in range(3))


def test_a_program_that_pauses_loses_counted_frames():
    with cantap.open("virtual:load=80") as device:
        stream = device.records(capacity=100)
        for channel in (1, 2):
            device.open_channel(channel, 500_000)
        time.sleep(0.5)
        device.close_channel(1)
        device.close_channel(2)
        stream.close()
        records = list(stream)
        received = sum(counts["received"] for counts in device.losses.values())
    lost = sum(record.count for record in records if record.event == "lost")
    frames = sum(record.event == "frame" for record in records)
    assert lost == sum(stream.lost) > 0
    assert all(record.detail == "host" for record in records if record.event == "lost")
    assert frames + lost == received


def test_a_frame_is_sent_and_confirmed(pair):
    heard = pair.records(2, only_received=True)
    sent = pair.send(1, cantap.Frame(0x123, b"\x01\x02"))
    record = heard.read(timeout=120)
    assert record.id == 0x123 and record.data == b"\x01\x02" and record.channel == 2
    assert abs(sent[0] - record.time_s) < 0.1
    times = pair.send(1, [f"{at:03X}#{at:02X}" for at in range(50)])
    assert times == sorted(times) and len(times) == 50
    assert [heard.read(timeout=120).id for _ in range(50)] == list(range(50))


def test_a_frame_waits_for_its_time(pair):
    at = time.time() + 0.5
    sent = pair.send(1, "7FF#", at=at, timeout=3)
    # Both are on this computer's clock, whose relation to the device's is less certain if the computer is busy.
    assert -0.1 < sent[0] - at < 0.3


def test_what_listens_sends_nothing():
    with cantap.open(QUIET, 500_000) as device:
        with pytest.raises(cantap.DeviceError, match="only listens"):
            device.send(1, "123#")
        assert device.channels[1] == {"bitrate": 500_000, "mode": "listen-only"}


def test_what_nobody_acknowledges_is_taken_back():
    with cantap.open("virtual:load=0,ack=no") as device:
        device.open_channel(1, 500_000, mode="normal")
        with pytest.raises(cantap.DeviceError, match="taken back"):
            device.send(1, "123#", timeout=0.3)
        assert device.status["channels"][0]["tx_pending"] == 0


def test_periodic_frames_count_and_check(pair):
    heard = pair.records(2, only_received=True)
    modifiers = [cantap.Counter(0, bits=4), cantap.Checksum(1, "xor")]
    task = pair.send_periodic(1, "100#00000F", 0.01, modifiers=modifiers)
    records = [heard.read(timeout=120) for _ in range(20)]
    counters = [record.data[0] for record in records]
    assert all((after - before) % 16 == 1 for before, after in zip(counters, counters[1:]))
    assert all(record.data[1] == record.data[0] ^ 0x0F for record in records)
    gaps = [(after.time_ns - before.time_ns) / 1e6 for before, after in zip(records, records[1:])]
    # Not all: on a busy computer its view of the device's clock improves in between.
    assert 9.9 < statistics.median(gaps) < 10.1, gaps
    task.update("100#0000F0")
    assert any(heard.read(timeout=120).data[2] == 0xF0 for _ in range(10))
    task.stop()
    task.stop()
    assert not task.is_running
    with pytest.raises(cantap.DeviceError, match="stopped"):
        task.update("100#000000")


def test_a_forgotten_task_ends_and_its_entry_is_free(pair):
    for at in range(100):
        pair.send_periodic(1, f"{at:03X}#", 1.0)
    assert pair.status["channels"][0]["is_open"]
    kept = [pair.send_periodic(1, "001#", 5.0) for _ in range(pair.info["periodic_slots"])]
    with pytest.raises(cantap.DeviceError, match="room for"):
        pair.send_periodic(1, "002#", 5.0)
    kept.pop().stop()
    pair.send_periodic(1, "002#", 5.0)


def test_replies_come_at_once(pair):
    answers = pair.records(1, filter="7E8", only_received=True)
    reply = pair.reply(2, 0x7DF, "7E8#0341050A")
    sent = pair.send(1, "7DF#020105")
    answer = answers.read(timeout=120)
    assert abs(answer.time_s - sent[0]) < 0.1
    reply.stop()
    pair.send(1, "7DF#020105")
    assert answers.read(timeout=0.2) is None


def test_filters_are_the_hardwares_and_the_rest_this_computers():
    with cantap.open(QUIET) as device:
        device.open_channel(1, 500_000, mode="normal")
        device.open_channel(2, 500_000, mode="normal", filter=["123", "200~7FF"])
        heard = device.records(2)
        device.send(1, ["123#", "200#", "300#"])
        assert [heard.read(timeout=120).id for _ in range(2)] == [0x123, 0x300]
        assert heard.read(timeout=0.1) is None


def test_status_clock_and_info():
    with cantap.open("virtual", 250_000, channels=[2]) as device:
        assert device.info["channels"] == 2 and device.info["serial"] == "VIRTUAL"
        assert [channel["is_open"] for channel in device.status["channels"]] == [False, True]
        assert device.channels == {2: {"bitrate": 250_000, "mode": "listen-only"}}
        assert abs(device.time() - time.time()) < 5
        assert device.clock["round_trip_ns"] > 0
        device.identify(1)
        assert "virtual" in repr(device)


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda device: device.send(3, "123#"), ValueError),
        (lambda device: device.send(1, "123"), ValueError),
        (lambda device: device.send(1, 5), TypeError),
        (lambda device: device.send("one", "123#"), ValueError),
        (lambda device: device.open_channel(1, 3), ValueError),
        (lambda device: device.open_channel(1, 500_000, mode="loud"), ValueError),
        (lambda device: device.open_channel(0, 500_000), ValueError),
        (lambda device: device.records(9), ValueError),
        (lambda device: device.records(filter="zzz:"), ValueError),
        (lambda device: device.send_periodic(1, "123#", 0.0), ValueError),
        (lambda device: device.send_periodic(1, "123#", float("nan")), ValueError),
        (lambda device: device.send_periodic(1, "123#", 1, modifiers=[cantap.Counter(3)]), ValueError),
        (lambda device: device.send_periodic(1, "123#11", 1, modifiers=[cantap.Checksum(0, "md5")]), ValueError),
        (lambda device: device.reply(1, 0x800, "123#", extended=False), ValueError),
        (lambda device: device.read(timeout="soon"), ValueError),
        (lambda device: device.batch(rows=0), ValueError),
        (lambda device: pickle.dumps(device), TypeError),
    ],
)
def test_a_wrong_call_says_so_and_changes_nothing(pair, call, error):
    with pytest.raises(error):
        call(pair)
    assert pair.send(1, "123#")


@pytest.mark.parametrize(
    "arguments",
    [(0x800,), (0x2000_0000,), (1, b"123456789"), (-1,)],
)
def test_a_wrong_frame_is_an_error(arguments):
    with pytest.raises(ValueError):
        cantap.Frame(*arguments, extended=False)
    with pytest.raises(ValueError):
        cantap.Frame(1, b"1", remote=True)


def test_frames_are_values():
    frame = cantap.Frame(0x123, b"\x11")
    assert frame == cantap.Frame.parse("123#11") == pickle.loads(pickle.dumps(frame))
    assert {frame: 1}[cantap.Frame.parse("123#11")] == 1
    assert cantap.Frame(0x800).extended and cantap.Frame(1, remote=True, dlc=3).dlc == 3
    assert str(frame) == "123#11"


@pytest.mark.parametrize(
    ("address", "error"),
    [
        ("virtual:speed=9", ValueError),
        ("", ValueError),
        ("/dev/no-such-port", cantap.DeviceError),
        ("unix:/no/such/socket", cantap.DeviceError),
        ("tcp://127.0.0.1:1", cantap.DeviceError),
    ],
)
def test_a_device_that_is_not_there_is_an_error(address, error):
    with pytest.raises(error):
        cantap.open(address)


def test_a_closed_device_says_so():
    device = cantap.open("virtual", 500_000)
    device.close()
    device.close()
    for call in (lambda: device.send(1, "123#"), lambda: device.status, lambda: device.records(), lambda: device.address):
        with pytest.raises(cantap.DeviceError, match="closed"):
            call()


def test_threads_use_one_device(pair):
    heard = pair.records(2, only_received=True)

    def send(channel_id):
        for _ in range(50):
            pair.send(1, cantap.Frame(channel_id), timeout=5)

    threads = [threading.Thread(target=send, args=(at,)) for at in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)
    ids = [heard.read(timeout=120).id for _ in range(200)]
    assert sorted(ids) == sorted(list(range(4)) * 50)


def test_closing_ends_who_waits():
    device = cantap.open(QUIET, 500_000)
    result = []
    thread = threading.Thread(target=lambda: result.append(list(device)))
    thread.start()
    time.sleep(0.2)
    device.close()
    thread.join(timeout=120)
    assert not thread.is_alive() and result == [[]]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_cannot_use_it_and_does_no_harm():
    out = script(
        """
        import os, cantap
        device = cantap.open("virtual:load=0,wire=joined", 500_000, mode="normal")
        child = os.fork()
        if child == 0:
            try:
                device.send(1, "123#")
            except cantap.DeviceError as error:
                print("fork" if "fork" in str(error) else error, flush=True)
            device.close()
            del device
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        print(len(device.send(1, "123#")))
        """
    )
    assert out.split() == ["fork", "1"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_does_not_wait_for_records_that_never_come():
    out = script(
        """
        import os, cantap
        device = cantap.open("virtual:load=0,wire=joined", 500_000)
        records = device.records()
        child = os.fork()
        if child == 0:
            for call in (device.read, records.read, lambda: next(iter(device)), device.batch, records.fileno, lambda: records.lost):
                try:
                    print(call(), flush=True)
                except cantap.DeviceError as error:
                    print("fork" if "fork" in str(error) else error, flush=True)
            records.close()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        """
    )
    assert out.split() == ["fork"] * 6


def test_a_time_that_is_over_means_at_once_and_one_beyond_the_timeout_is_refused():
    with cantap.open("virtual:load=0,wire=joined", 500_000, mode="normal") as device:
        now = time.time()
        # Before the device was started, as well.
        for ago in (0.001, 3, 1e6, now):
            assert device.send(1, "123#", at=now - ago)[0] < now + 5
        with pytest.raises(ValueError, match="timeout="):
            device.send(1, "123#", at=time.time() + 60)
        assert device.read(0) is None or device.status["channels"][0]["tx_pending"] == 0


def test_records_are_values_that_other_processes_take():
    with cantap.open("virtual:errors=20", 500_000) as device:
        records = [device.read(1) for _ in range(200)]
    assert {"frame", "bus-error"} <= {record.event for record in records}
    for record in records:
        again = pickle.loads(pickle.dumps(record))
        assert again == record and hash(again) == hash(record) and repr(again) == repr(record)


def test_what_a_closed_device_sent_on_its_own_does_not_run():
    with cantap.open("virtual:load=0,wire=joined", 500_000, mode="normal") as device:
        tasks = [device.send_periodic(1, "100#00", 0.01), device.reply(2, 0x7DF, "7E8#00")]
        assert all(task.is_running for task in tasks)
    assert not any(task.is_running for task in tasks)
    for task in tasks:
        task.stop()


def test_ctrl_c_ends_waiting():
    code = """
        import cantap
        device = cantap.open("virtual:load=0", 500_000)
        print("ready", flush=True)
        try:
            device.read()
        except KeyboardInterrupt:
            print("interrupted", flush=True)
        device.close()
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=120)
    assert out == "interrupted\n" and process.returncode == 0


@pytest.mark.parametrize("ending", ["", "import sys; sys.exit()", "raise SystemExit(0)", "del device", "device = device._native"])
def test_a_program_may_end_while_a_capture_runs(ending):
    script(
        f"""
        import cantap, threading
        device = cantap.open("virtual:load=80", 1_000_000)
        threading.Thread(target=lambda: [None for _ in device.records()], daemon=True).start()
        task = device.records()
        next(task)
        {ending}
        """
    )


def test_boards_are_listed():
    assert isinstance(cantap.boards(), list)


RULES = """
[[rule]]
name = "low"
from = 1
filter = "000-3FF"
"""


def test_a_gateway_passes_frames_on_and_accounts_for_each(tmp_path):
    rules = tmp_path / "rules.toml"
    rules.write_text(RULES)
    with cantap.open("virtual:load=20,frames=std8,channels=1", 500_000) as device:
        with pytest.raises(cantap.DeviceError, match="normal mode"):
            device.start_gateway(rules)
    with cantap.open("virtual:load=20,frames=std8,channels=1", 500_000, mode="normal") as device:
        assert device.gateway["state"] == "off"
        device.start_gateway(rules)
        for record in device:
            if record.channel == 2 and record.event == "frame" and record.direction == "tx":
                break
        assert device.gateway["state"] == "running"
        device.stop_gateway()
        counts = device.gateway
    assert counts["state"] == "off"
    [rule] = counts["rules"]
    assert rule["rule"] == "low" and rule["sent"] > 0
    assert rule["matched"] == sum(rule[key] for key in ("sent", "dropped", "replaced", "lost", "failed"))


def test_a_gateway_that_has_found_a_loop_says_so_in_the_stream(tmp_path):
    rules = tmp_path / "rules.toml"
    rules.write_text(RULES)
    with cantap.open("virtual:load=50,frames=std8,wire=joined", 500_000, mode="normal") as device:
        device.start_gateway(rules)
        end = next(record for record in device if record.event == "transmit-failed")
        assert end.detail == "loop"
        assert device.gateway["state"] == "loop"


def test_a_file_that_is_no_rules_is_a_wrong_argument(tmp_path):
    rules = tmp_path / "rules.toml"
    rules.write_text("[[rule]]\nfrom = 3\n")
    with cantap.open("virtual:load=0", 500_000, mode="normal") as device:
        with pytest.raises(ValueError, match="line 2"):
            device.start_gateway(rules)
