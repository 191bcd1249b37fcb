"""What a program does wrong, or what happens to it: always a Python exception, never an abort or a hang."""

import copy
import gzip
import os
import pickle
import random
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

import cantap

DBC = 'VERSION ""\nBU_:\nBO_ 291 Engine: 8 ECU\n SG_ Speed : 0|8@1+ (0.5,0) [0|100] "km/h" ECU\n'


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "drive.log"
    path.write_text("".join(f"({at / 100:.6f}) can0 123#{at % 256:02X}\n" for at in range(2000)))
    return path


@pytest.fixture
def dbc(tmp_path):
    path = tmp_path / "car.dbc"
    path.write_text(DBC)
    return path


WRONG = [None, 5, -1, 2**70, 1.5, float("nan"), b"\xff\x00", "", "no such thing", [], [None], {}, {1: None}, {0: "x"}, object(), [[]]]
"""Objects that may be passed by mistake."""
CLEAN = (TypeError, ValueError, OSError, cantap.CantapError)
"""The exceptions that this may raise."""


@pytest.mark.parametrize(
    "call",
    [
        lambda log, dbc, wrong: cantap.read(wrong),
        lambda log, dbc, wrong: cantap.read(log, db=wrong),
        lambda log, dbc, wrong: cantap.read(log, db=dbc, signals=wrong),
        lambda log, dbc, wrong: cantap.read(log, filter=wrong),
        lambda log, dbc, wrong: cantap.read(log, channel=wrong),
        lambda log, dbc, wrong: cantap.read(log, start=wrong),
        lambda log, dbc, wrong: cantap.read(log, end=wrong),
        lambda log, dbc, wrong: cantap.read(log, format=wrong),
        lambda log, dbc, wrong: cantap.read(log, zone=wrong),
        lambda log, dbc, wrong: cantap.scan(log, batch_rows=wrong),
        lambda log, dbc, wrong: cantap.decode(wrong, dbc),
        lambda log, dbc, wrong: cantap.decode(log, wrong),
        lambda log, dbc, wrong: cantap.load_database(wrong),
        lambda log, dbc, wrong: cantap.search(log, wrong, db=dbc),
        lambda log, dbc, wrong: cantap.search(log, id=wrong),
        lambda log, dbc, wrong: cantap.search(log, data=wrong),
        lambda log, dbc, wrong: cantap.search(log, id="123", max_count=wrong),
        lambda log, dbc, wrong: cantap.stats(log, wrong),
        lambda log, dbc, wrong: cantap.stats(log, 500_000, window=wrong),
        lambda log, dbc, wrong: cantap.write(wrong, log.with_name("out.blf")),
        lambda log, dbc, wrong: cantap.write(cantap.read(log), log.with_name("out.blf"), format=wrong),
        lambda log, dbc, wrong: cantap.Frame(wrong),
        lambda log, dbc, wrong: cantap.Frame(1, wrong),
        lambda log, dbc, wrong: cantap.Frame.parse(wrong),
        lambda log, dbc, wrong: cantap.open(wrong),
    ],
)
@pytest.mark.filterwarnings("ignore::cantap.CantapWarning")
def test_a_wrong_value_is_an_error_that_programs_expect(log, dbc, call):
    for wrong in WRONG:
        try:
            result = call(log, dbc, wrong)
        except CLEAN as error:
            assert str(error), wrong
        else:
            if isinstance(result, cantap.Device):
                result.close()
    assert len(cantap.read(log)) == 2000


@pytest.mark.parametrize("suffix", ["blf", "mf4", "pcapng", "asc", "log.gz", "log.xz", "log.zst", "blf.lz4"])
@pytest.mark.filterwarnings("ignore::cantap.CantapWarning")
def test_damage_to_a_file_is_never_an_error_of_the_system(log, dbc, tmp_path, suffix):
    path = tmp_path / f"drive.{suffix}"
    cantap.write(cantap.read(log), path)
    whole = path.read_bytes()
    numbers = random.Random(suffix)
    for _ in range(40):
        damaged = bytearray(whole)
        for _ in range(3):
            # Heads, with their addresses and lengths, are near the beginning.
            damaged[numbers.randrange(numbers.choice([len(whole), min(len(whole), 2000)]))] = numbers.randrange(256)
        path.write_bytes(damaged)
        for call in (cantap.read, lambda path: cantap.decode(path, dbc)):
            try:
                assert call(path).report.file == str(path)
            except cantap.FormatError as error:
                assert str(path) in str(error)


def test_what_was_read_before_the_damage_of_a_compressed_file_is_there(log, tmp_path):
    path = tmp_path / "drive.log.gz"
    text = log.read_bytes()
    damaged = bytearray(gzip.compress(text[: len(text) // 2]) + gzip.compress(text[len(text) // 2 :]))
    damaged[-8:-4] = b"\0\0\0\0"
    path.write_bytes(damaged)
    with pytest.warns(cantap.CantapWarning, match="undamaged compressed data"):
        table = cantap.read(path)
    assert len(table) >= 1000 and table.report.issues and not table.report.is_whole
    assert cantap.read(log).to_pyarrow().slice(0, 1000).equals(table.to_pyarrow().slice(0, 1000))


def test_what_spark_sends_between_processes_arrives(log, dbc):
    database = cantap.load_database(dbc)
    again = pickle.loads(pickle.dumps(database))
    assert again.message_names == ["Engine"]
    table = pickle.loads(pickle.dumps(cantap.read(log, db=again)))
    assert len(table) == 2000 and table.report.decoded == 2000 and table.report.values == 2000
    report = copy.copy(pickle.loads(pickle.dumps(table.report)))
    assert report.file == str(log) and report.is_whole
    decoded = pickle.loads(pickle.dumps(cantap.decode(log, database)))
    assert len(decoded["Engine"]) == 2000 and decoded.report.values == 2000 and len(decoded.events) == 0
    for kind in (cantap.DeviceError, cantap.FormatError, cantap.DatabaseError, cantap.CantapError, cantap.CantapWarning):
        error = pickle.loads(pickle.dumps(kind("why")))
        assert type(error) is kind and error.args == ("why",)
    try:
        cantap.read(log, format="blf")
    except cantap.FormatError as error:
        assert str(pickle.loads(pickle.dumps(error))) == str(error)
    else:
        raise AssertionError("a log is no BLF")
    with pytest.raises(TypeError):
        pickle.dumps(cantap.scan(log))


@pytest.mark.parametrize(
    "work",
    [
        "cantap.read(path)",
        "cantap.read(path, db=dbc)",
        "cantap.decode(path, dbc)",
        "for batch in cantap.scan(path): pass",
        "cantap.search(path, id='7FF')",
        "cantap.stats(path, 500_000)",
    ],
)
def test_ctrl_c_ends_work_on_a_large_file(dbc, work):
    """The file never ends: a pipe."""
    code = f"""
        import sys, cantap
        path, dbc = sys.argv[1:]
        print("ready", flush=True)
        try:
            {work}
        except KeyboardInterrupt:
            print("interrupted", flush=True)
    """
    pipe = dbc.with_name("endless.log")
    os.mkfifo(pipe)
    program = [sys.executable, "-c", textwrap.dedent(code), pipe, dbc]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        is_over = threading.Event()

        def feed():
            try:
                with open(pipe, "w") as out:
                    while not is_over.is_set():
                        out.write("(1.000000) can0 123#11\n" * 1000)
            except BrokenPipeError:
                pass

        feeder = threading.Thread(target=feed)
        feeder.start()
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        try:
            out, _ = process.communicate(timeout=120)
        finally:
            process.kill()
            is_over.set()
        feeder.join(timeout=120)
        assert not feeder.is_alive()
        assert out == "interrupted\n" and process.returncode == 0


def test_one_scan_in_many_threads_gives_each_row_once_or_an_error(log):
    scan = cantap.scan(log, batch_rows=10)
    rows, errors = [], []

    def take():
        try:
            rows.extend(len(batch) for batch in scan)
        except (RuntimeError, ValueError) as error:
            errors.append(str(error))

    threads = [threading.Thread(target=take) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)
    assert sum(rows) == 2000 or errors and sum(rows) <= 2000


def test_a_device_that_is_closed_by_another_thread_ends_every_call():
    device = cantap.open("virtual:load=80,wire=joined", 500_000, mode="normal")
    stream, errors, is_over = device.records(), [], threading.Event()

    def use(call):
        while not is_over.is_set():
            try:
                if call() is None:
                    return
            except cantap.DeviceError:
                return
            except BaseException as error:
                errors.append(error)
                return

    calls = [
        lambda: device.read(1),
        lambda: stream.read(1),
        lambda: device.status,
        lambda: device.send(1, "123#11", timeout=5),
        lambda: device.clock,
        lambda: device.batch(0.05) if not device.closed else None,
        lambda: device.send_periodic(2, "100#", 0.01),
    ]
    threads = [threading.Thread(target=use, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    time.sleep(0.5)
    device.close()
    is_over.set()
    for thread in threads:
        thread.join(timeout=120)
    assert not any(thread.is_alive() for thread in threads)
    assert not errors


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_process_that_forks_while_it_reads_goes_on_in_both(log):
    code = f"""
        import os, cantap
        scan = cantap.scan({str(log)!r}, batch_rows=100)
        first = len(next(scan))
        child = os.fork()
        rows = len(cantap.read({str(log)!r}))
        if child == 0:
            os._exit(0 if rows == 2000 else 1)
        assert os.waitpid(child, 0)[1] == 0
        print(first + sum(len(batch) for batch in scan))
    """
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    assert result.stdout == "2000\n", result.stderr


@pytest.mark.parametrize(
    "ending", ["", "sys.exit()", "os.kill(os.getpid(), signal.SIGTERM)", "raise KeyboardInterrupt", "1 / 0", "del bus"]
)
def test_a_program_with_a_bus_may_end_in_any_way(ending):
    pytest.importorskip("can")
    code = f"""
        import can, os, signal, sys
        bus = can.Bus(interface="cantap", channel="virtual:load=80", bitrate=1_000_000)
        notifier = can.Notifier(bus, [lambda message: None])
        bus.send_periodic(can.Message(arbitration_id=1, is_extended_id=False), 0.01)
        print("ready", flush=True)
        {ending}
    """
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    assert result.stdout == "ready\n" and "panicked" not in result.stderr and "Fatal" not in result.stderr, result.stderr
    wanted = {"os.kill(os.getpid(), signal.SIGTERM)": [-15], "raise KeyboardInterrupt": [-2, 130], "1 / 0": [1]}
    assert result.returncode in wanted.get(ending, [0]), result.stderr
