"""The fleet's job on a Spark cluster of two worker processes: `python/examples/fleet`.

Needs Java 17 and the packages in `python/examples/fleet/requirements.txt`; without pyspark it is skipped, and says so.
"""

from __future__ import annotations

import gzip
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

FLEET = Path(__file__).parents[1] / "examples" / "fleet"
sys.path.insert(0, str(FLEET))

pytest.importorskip("pyspark", reason="pip install -r python/examples/fleet/requirements.txt")
if shutil.which("java") is None and "JAVA_HOME" not in os.environ:
    pytest.skip("Spark needs Java 17: apt-get install openjdk-17-jre-headless", allow_module_level=True)

import can
import cantap
import pyarrow as pa
import pyarrow.dataset
from cantap.lake import columns, isolation
from cantap_fleet import command, dataset, inputs, questions
from pyspark.sql import SparkSession

VEHICLES = 20
TRACES_EACH = 10
#: 2026-03-01 22:59:59 UTC: every trace crosses a full hour, those of every fourth vehicle cross midnight.
BEGIN_US = 1_772_405_999_000_000
STEP_US = 10_000
STEPS = 200
SUFFIXES = ["log", "blf", "asc", "log.gz", "trc"]
#: How long a trace may take here. One hangs, in every run.
TIMEOUT_S = 10

DBC = """\
VERSION ""
BU_: ABS
BO_ 417 Motion: 8 ABS
 SG_ VehicleSpeed : 0|16@1+ ({factor},0) [0|300] "km/h" ABS
 SG_ BrakePressure : 16|16@1+ (0.1,0) [0|200] "bar" ABS
BO_ 2566834689 Climate: 8 ABS
 SG_ Cabin : 0|8@1+ (0.5,-40) [-40|85] "degC" ABS
"""
OTHER_DBC = """\
VERSION ""
BU_: ABS
BO_ 418 Nothing: 8 ABS
 SG_ Unseen : 0|8@1+ (1,0) [0|255] "" ABS
"""
FACTORS = {"a": 0.01, "b": 0.05}


@dataclass
class Sent:
    """A frame in the generator."""

    time_us: int
    channel: int
    id: int
    extended: bool
    data: bytes


def frames_of(vehicle: int, number: int) -> list[Sent]:
    """Two channels of a drive; vehicle 7's third has a late frame, vehicle 12's first brakes hard at speed."""
    begin = BEGIN_US + (3_600_000_000 if vehicle % 4 == 0 else 0) + number * 60_000_000
    factor = FACTORS["ab"[vehicle % 2]]
    frames = []
    for step in range(STEPS):
        at = begin + step * STEP_US
        brakes = vehicle == 12 and number == 0 and 100 <= step < 110
        speed, pressure = (130.0, 80.0) if brakes else (100.0 + number, 2.0)
        data = struct.pack("<HHI", round(speed / factor), round(pressure / 0.1), step)
        late = 7_000 if (vehicle, number, step) == (7, 2, 150) else 0
        frames.append(Sent(at + late, 1, 417, False, data))
        if step % 2 == 0:
            frames.append(Sent(at + 1_000, 1, 0x18FF0001, True, bytes([120, step, 0, 0, 0, 0, 0, 0])))
        frames.append(Sent(at + 2_000, 2, 0x200, False, bytes([step])))
    return sorted(frames, key=lambda frame: frame.time_us)


def candump(frames: list[Sent]) -> str:
    return "".join(
        f"({frame.time_us // 1_000_000}.{frame.time_us % 1_000_000:06}) can{frame.channel - 1} "
        f"{frame.id:0{8 if frame.extended else 3}X}#{frame.data.hex().upper()}\n"
        for frame in frames
    )


def write(path: Path, frames: list[Sent]) -> None:
    """Written by python-can, unless it is a candump text."""
    if path.name.endswith(".log"):
        path.write_text(candump(frames))
    elif path.name.endswith(".gz"):
        path.write_bytes(gzip.compress(candump(frames).encode(), mtime=0))
    else:
        with can.Logger(str(path)) as writer:
            for frame in frames:
                writer(
                    can.Message(
                        timestamp=frame.time_us / 1e6,
                        # In these formats python-can counts from 0.
                        channel=frame.channel - 1,
                        arbitration_id=frame.id,
                        is_extended_id=frame.extended,
                        data=frame.data,
                    )
                )


@dataclass
class Fleet:
    folder: Path
    #: For complete traces, what the generator put in.
    whole: dict[str, list[Sent]]
    #: For the others, the state that they must have, and the number of frames: `None` if that is not known exactly.
    broken: dict[str, tuple[str, int | None]]

    @property
    def traces(self) -> int:
        return len(self.whole) + len(self.broken)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    os.environ["TZ"] = "UTC"
    time.tzset()
    folder = tmp_path_factory.mktemp("traces")
    (folder / "databases").mkdir()
    for name, factor in FACTORS.items():
        (folder / "databases" / f"{name}.dbc").write_text(DBC.format(factor=factor))
    (folder / "databases" / "broken.dbc").write_text("this is no database\n")
    table = ["vehicle,channel,databases,bitrate", "*,,,250000"]
    whole: dict[str, list[Sent]] = {}
    for vehicle in range(VEHICLES):
        name = f"{vehicle:03}"
        (folder / name).mkdir()
        table += [f"{name},1,databases/{'ab'[vehicle % 2]}.dbc,500000", f"{name},2,,250000"]
        for number in range(TRACES_EACH):
            path = folder / name / f"drive {number}.{SUFFIXES[(vehicle + number) % len(SUFFIXES)]}"
            frames = frames_of(vehicle, number)
            write(path, frames)
            whole[f"{name}/{path.name}"] = frames
    (folder / "databases" / "other.dbc").write_text(OTHER_DBC)
    table += ["baddb,,databases/broken.dbc,500000", "wrongdb,,databases/other.dbc,500000"]
    (folder / "vehicles.csv").write_text("\n".join(table) + "\n")
    broken = break_some(folder)
    # We see it, although Spark's own sources would hide it.
    whole["odd/_begins with a line.log"] = frames_of(2, 1)
    write(folder / "odd" / "_begins with a line.log", whole["odd/_begins with a line.log"])
    return Fleet(folder, whole, broken)


def break_some(folder: Path) -> dict[str, tuple[str, int | None]]:
    """Traces that are cut, damaged, refused, empty, or never end."""
    (folder / "odd").mkdir()
    (folder / "baddb").mkdir()
    (folder / "wrongdb").mkdir()
    frames = frames_of(1, 0)
    text = candump(frames)
    lines = text.splitlines(keepends=True)
    broken: dict[str, tuple[str, int | None]] = {}

    def put(name: str, content: bytes, state: str, count: int | None) -> None:
        (folder / name).write_bytes(content)
        broken[name] = (state, count)

    put("odd/cut.log", "".join(lines[:100]).encode() + lines[100].encode()[:22], "cut", 100)
    whole = folder / "odd" / "whole.blf"
    write(whole, frames)
    put("odd/cut.blf", whole.read_bytes()[: whole.stat().st_size * 2 // 3], "cut", None)
    whole.unlink()
    packed = gzip.compress("".join(f"{line}" for line in lines).encode(), mtime=0)
    put("odd/cut.log.gz", packed[: len(packed) // 2], "cut", None)
    for at in (10, 20, 30):
        lines[at] = "(1772.x) can0 this was a line\n"
    put("odd/damaged.log", "".join(lines).encode(), "damaged", len(frames) - 3)
    put("odd/rubbish.blf", random.Random(1).randbytes(4096), "refused", 0)
    put("odd/README.txt", b"Nobody should have put this here.\n", "refused", 0)
    put("odd/empty.log", b"", "empty", 0)
    put("in no folder.log", text.encode(), "refused", 0)
    # Databases that cannot be used, or are another vehicle's, cost signals only.
    put("baddb/drive.log", text.encode(), "undecoded", len(frames))
    put("wrongdb/drive.log", text.encode(), "undecoded", len(frames))
    whole_lines = text.splitlines(keepends=True)
    cut = "".join(whole_lines[:100]).encode() + whole_lines[100].encode()[:22]
    put("wrongdb/cut.log", cut, "cut", 100)
    # Opening it waits for somebody to write.
    os.mkfifo(folder / "odd" / "hangs.log")
    broken["odd/hangs.log"] = ("failed", 0)
    return broken


@pytest.fixture(scope="module")
def spark():
    os.environ["PYSPARK_PYTHON"] = sys.executable
    session = (
        SparkSession.builder.master("local-cluster[2,1,1024]")
        .appName("test_fleet")
        .config("spark.sql.session.timeZone", "UTC")
        .config("spark.sql.shuffle.partitions", "2")
        # A cluster for a minute: optimising compilation takes longer than running the code, and listing folders is faster than starting tasks.
        .config("spark.driver.extraJavaOptions", "-XX:TieredStopAtLevel=1 -XX:+UseSerialGC")
        .config("spark.executor.extraJavaOptions", "-XX:TieredStopAtLevel=1 -XX:+UseSerialGC")
        .config("spark.sql.sources.parallelPartitionDiscovery.threshold", "10000")
        .config("spark.ui.showConsoleProgress", "false")
        .config("spark.ui.enabled", "false")
        .config("spark.driver.host", "localhost")
        .config("spark.driver.memory", "1g")
        .getOrCreate()
    )
    session.sparkContext.setLogLevel("ERROR")
    yield session
    session.stop()


@pytest.fixture(scope="module")
def output(spark, fleet, tmp_path_factory):
    output = tmp_path_factory.mktemp("out") / "dataset"
    assert command.run(spark, ["decode", str(fleet.folder), str(output), "--timeout", str(TIMEOUT_S)]) == 0
    questions.open_dataset(spark, str(output))
    return output


def rows_in(output: Path, part: str) -> pa.Table:
    """The rows of a part, in an order that does not depend on how they are stored in files."""
    partitions = pa.dataset.partitioning(
        pa.schema([("vehicle", pa.string()), ("day", pa.string()), ("channel", pa.int16())]), flavor="hive"
    )
    folder = pa.dataset.dataset(output / part, format="parquet", partitioning=partitions if part != "ledger" else None)
    order = [("trace", "ascending")] + ([("row", "ascending")] if part != "ledger" else [])
    return folder.to_table().sort_by(order)


def ledger_of(output: Path) -> dict[str, dict]:
    return {entry["trace"]: entry for entry in rows_in(output, "ledger").to_pylist()}


def test_each_input_has_an_entry_that_says_what_became_of_it(fleet, output):
    ledger = ledger_of(output)
    assert fleet.traces >= 200
    assert set(ledger) == set(fleet.whole) | set(fleet.broken)
    for trace, frames in fleet.whole.items():
        entry = ledger[trace]
        assert (entry["state"], entry["frames"], entry["issues"]) == ("read", len(frames), 0), entry
        assert entry["bytes"] == (fleet.folder / trace).stat().st_size
    for trace, (state, frames) in fleet.broken.items():
        entry = ledger[trace]
        assert entry["state"] == state, entry
        assert entry["problem"], entry
        if frames is None:
            assert 0 < entry["frames"] < STEPS * 5 // 2, entry
        else:
            assert entry["frames"] == frames, entry
    assert ledger["odd/damaged.log"]["issues"] == 3
    assert "databases/broken.dbc" in ledger["baddb/drive.log"]["problem"]
    assert "other.dbc has a message for none of its frames" in ledger["wrongdb/drive.log"]["problem"]
    assert "other.dbc" in ledger["wrongdb/cut.log"]["problem"]
    for trace in ("baddb/drive.log", "wrongdb/drive.log", "wrongdb/cut.log"):
        assert (ledger[trace]["coverage"], ledger[trace]["decoded"], ledger[trace]["signal_rows"]) == (0, 0, 0)
    # Of the five frames in two steps, two are the message of the database.
    assert {ledger[trace]["coverage"] for trace in fleet.whole if not trace.startswith("odd/")} == {0.4}
    assert ledger["odd/_begins with a line.log"]["coverage"] is None
    assert "within 10 s" in ledger["odd/hangs.log"]["problem"]
    # Names as the user gave them, without a worker's folders.
    assert all(str(fleet.folder) not in str(entry) and "/tmp" not in str(entry) for entry in ledger.values())


def test_every_frame_is_in_the_dataset_once_as_it_was_sent(fleet, output):
    table = rows_in(output, "frames")
    found: dict[str, list[tuple]] = {}
    wanted = ["trace", "row", "time_ns", "channel", "id", "extended", "data", "vehicle", "day"]
    for row in table.select(wanted).to_pylist():
        found.setdefault(row["trace"], []).append(row)
    for trace, frames in fleet.whole.items():
        rows = found[trace]
        assert [row["row"] for row in rows] == list(range(len(frames)))
        assert {row["vehicle"] for row in rows} == {trace.split("/")[0]}
        for row, frame in zip(rows, frames, strict=True):
            assert abs(row["time_ns"] - frame.time_us * 1000) <= 1000, (trace, row)
            assert (row["channel"], row["id"], row["extended"], row["data"]) == (
                frame.channel, frame.id, frame.extended, frame.data,
            ), (trace, row)  # fmt: skip
            assert row["day"] == time.strftime("%Y-%m-%d", time.gmtime(row["time_ns"] // 10**9))
    refused = {trace for trace, (state, _) in fleet.broken.items() if state in ("refused", "failed")}
    assert not refused & set(found)
    assert len(list(output.glob("frames/vehicle=007/day=2026-03-01/channel=2/*.parquet"))) > 0


def test_values_are_those_of_each_vehicles_own_database(spark, fleet, output):
    # What half of the vehicles send would be a different speed with the other database.
    found = spark.sql(
        "SELECT trace, count(*) AS rows, min(value) AS low, max(value) AS high FROM signals "
        "WHERE signal = 'VehicleSpeed' GROUP BY trace"
    ).collect()
    speeds = {row["trace"]: (row["rows"], row["low"], row["high"]) for row in found}
    for vehicle in range(VEHICLES):
        for number in range(TRACES_EACH):
            trace = f"{vehicle:03}/drive {number}.{SUFFIXES[(vehicle + number) % len(SUFFIXES)]}"
            speed = 100.0 + number
            high = 130.0 if (vehicle, number) == (12, 0) else speed
            assert speeds[trace] == (STEPS, pytest.approx(speed), pytest.approx(high)), trace
    assert "odd/_begins with a line.log" not in speeds


def test_the_worst_jitter_is_where_a_frame_was_late(spark, output):
    worst = {(row["id"], row["extended"]): row for row in questions.ask(spark, "period_jitter").collect()}
    assert set(worst) == {(417, False), (0x18FF0001, True), (0x200, False)}
    found = worst[417, False]
    assert found["trace"].startswith("007/drive 2.") and found["channel"] == 1
    assert found["longest_ms"] == pytest.approx(17.0, abs=0.01)
    # 17 ms and 3 ms among periods of 10 ms: both are 7 ms off the mean.
    assert found["jitter_ms"] == pytest.approx((2 * 49 / (STEPS - 1)) ** 0.5, rel=0.01)
    assert found["mean_ms"] == pytest.approx(10.0, abs=0.01) and found["periods"] == STEPS - 1


def test_a_condition_is_found_with_a_second_before_and_after(spark, output):
    rows = questions.ask(spark, "condition").collect()
    assert {row["vehicle"] for row in rows} == {"012"}
    assert len({row["began"] for row in rows}) == 1
    assert rows[0]["seconds"] == pytest.approx(0.1, abs=1e-3)
    speeds = [row for row in rows if row["signal"] == "VehicleSpeed"]
    # 100 steps for the 1 s before, 0.1 s during which it held, 1 s after: up to the step at which it is over, and the rest of the trace.
    assert len(speeds) == STEPS and sum(row["value"] > 120 for row in speeds) == 10
    # The frame after the last one for which it held ends the place; at this limit nothing holds.
    assert questions.ask(spark, "condition", {"speed": 150.0}).count() == 0
    everywhere = questions.ask(spark, "condition", {"speed": 99.0, "pressure": 1.0})
    assert everywhere.select("trace").distinct().count() >= VEHICLES * TRACES_EACH


def test_the_load_of_a_vehicle_and_hour_is_between_its_bounds(spark, output):
    rows = questions.ask(spark, "bus_load").where("vehicle = '001'").collect()
    # The trace begins a second before the hour and ends a second after it; those that follow begin a minute later each.
    assert [(row["channel"], row["hour"].hour) for row in rows] == [(1, 22), (1, 23), (2, 22), (2, 23)]
    one, other = rows[0], rows[2]
    # 100 frames of 47 + 64 bits and 50 of 67 + 64 in 0.991 s, at 500 kbit/s.
    assert one["recorded_s"] == pytest.approx(0.99, abs=0.001) and one["frames"] == 150
    assert one["load_at_least_pct"] == pytest.approx(100 * (100 * 111 + 50 * 131) / 500_000 / 0.99, rel=1e-3)
    # One byte: 34 + 8 bits are subject to stuffing, with at most 10 stuff bits.
    assert other["load_at_least_pct"] == pytest.approx(100 * 100 * 55 / 250_000 / 0.99, rel=1e-3)
    assert other["load_at_most_pct"] == pytest.approx(100 * 100 * 65 / 250_000 / 0.99, rel=1e-3)


def test_an_output_is_never_written_over_and_an_unfinished_one_is_not_asked(spark, fleet, output, tmp_path, capsys):
    assert command.run(spark, ["decode", str(fleet.folder), str(output)]) == 1
    assert "has something in it" in capsys.readouterr().err
    shutil.copytree(output, tmp_path / "unfinished", ignore=shutil.ignore_patterns("ledger"))
    assert command.run(spark, ["ask", str(tmp_path / "unfinished")]) == 1
    assert "has no ledger" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        command.run(spark, ["decode", str(fleet.folder), str(output), "--timeout", "soon"])
    questions.open_dataset(spark, str(output))


def descendants() -> dict[int, tuple[int, str]]:
    """All processes below this one: number, parent, command line."""
    known: dict[int, tuple[int, str]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
            known[int(folder.name)] = (parent, (folder / "cmdline").read_text().replace("\0", " "))
        except (OSError, IndexError):
            continue
    below = {os.getpid()}
    while more := {number for number, (parent, _) in known.items() if parent in below} - below:
        below |= more
    return {number: known[number] for number in below if number in known}


class Killer(threading.Thread):
    """Ends one process of each kind with SIGKILL, as soon as it exists and is working."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.killed: list[str] = []
        self.over = threading.Event()

    def run(self) -> None:
        wanted = ["decoding", "worker", "executor"]
        while wanted and not self.over.wait(0.3):
            below = descendants()
            at_work = [number for number, (_, line) in below.items() if "cantap.lake.decoding" in line]
            if not at_work:
                continue
            victim = at_work[0]
            if wanted[0] == "worker":
                victim = below[victim][0]
            if wanted[0] == "executor":
                # The Python worker's parent is the daemon, the daemon's is the executor.
                while victim in below and "CoarseGrainedExecutorBackend" not in below[victim][1]:
                    victim = below[victim][0]
            if victim not in below:
                continue
            os.kill(victim, signal.SIGKILL)
            self.killed.append(wanted.pop(0))
            self.over.wait(2)


def test_a_second_run_with_workers_killed_gives_the_same_rows(spark, fleet, output, tmp_path):
    killer = Killer()
    killer.start()
    again = tmp_path / "again"
    assert command.run(spark, ["decode", str(fleet.folder), str(again), "--timeout", str(TIMEOUT_S)]) == 0
    killer.over.set()
    killer.join()
    assert killer.killed == ["decoding", "worker", "executor"]
    for part in ("ledger", "frames", "signals"):
        assert rows_in(again, part).equals(rows_in(output, part)), part
    assert spark.read.parquet(f"{again}/vehicles").exceptAll(spark.read.parquet(f"{output}/vehicles")).count() == 0


def test_traces_come_from_any_file_system_that_spark_has(spark, fleet, output, tmp_path):
    # A Hadoop file system that Python cannot access: everything is read through Spark.
    few = tmp_path / "few"
    for name in ("001/drive 0.blf", "002/drive 0.asc", "odd/cut.log", "odd/_begins with a line.log"):
        (few / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(fleet.folder / name, few / name)
    shutil.copytree(fleet.folder / "databases", few / "databases")
    shutil.copy(fleet.folder / "vehicles.csv", few)
    java = spark.sparkContext._jsc.hadoopConfiguration()
    java.set("fs.viewfs.mounttable.fleet.link./traces", f"file://{few}")
    java.set("fs.viewfs.mounttable.fleet.link./out", f"file://{tmp_path}")
    target = tmp_path / "far"
    assert command.run(spark, ["decode", "viewfs://fleet/traces", "viewfs://fleet/out/far"]) == 0
    here, there = ledger_of(output), ledger_of(target)
    for trace in ("001/drive 0.blf", "002/drive 0.asc", "odd/cut.log"):
        assert there[trace] == here[trace]
    hidden = there["odd/_begins with a line.log"]
    assert hidden["state"] == "failed" and "begin with _" in hidden["problem"]


def test_spark_reads_what_the_command_calls_parquet(spark, fleet, tmp_path):
    program = os.environ.get("CANTAP_COMMAND") or shutil.which("cantap")
    if program is None:
        pytest.skip("there is no cantap command: name it in CANTAP_COMMAND")
    trace, database = fleet.folder / "001/drive 0.blf", fleet.folder / "databases/b.dbc"
    subprocess.run([program, "convert", trace, tmp_path / "f.parquet"], check=True)
    subprocess.run([program, "decode", "--db", database, trace, "-o", tmp_path / "s.parquet"], check=True)
    # Spark has no nanoseconds, and fails unless it is configured to read them as numbers.
    with pytest.raises(Exception, match="NANOS"):
        spark.read.parquet(str(tmp_path / "f.parquet"))
    spark.conf.set("spark.sql.legacy.parquet.nanosAsLong", "true")
    frames = spark.read.parquet(str(tmp_path / "f.parquet"))
    first = frames.orderBy("time").first()
    assert first["time"] == pytest.approx((BEGIN_US) * 1000, abs=1000)
    assert (frames.count(), first["id"], first["channel"]) == (STEPS * 5 // 2, 417, 1)
    values = spark.read.parquet(str(tmp_path / "s.parquet"))
    assert values.where("signal = 'VehicleSpeed'").agg({"value": "max"}).first()[0] == pytest.approx(100.0)


ANSWERS = """
import json, os, signal, sys, time
for line in sys.stdin:
    request = json.loads(line)
    if request["path"] == "kills" or (request["path"] == "kills once" and not os.path.exists(request["mark"])):
        open(request["mark"], "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    if request["path"] == "hangs":
        time.sleep(1000)
    print(json.dumps({"path": request["path"]}), flush=True)
"""


def test_a_trace_that_kills_or_hangs_costs_only_itself(tmp_path):
    with isolation.Process([sys.executable, "-c", ANSWERS], timeout_s=3) as process:
        for path in ("one", "kills once", "two"):
            assert process.ask({"path": path, "mark": str(tmp_path / "mark")}) == {"path": path}
        with pytest.raises(isolation.Failed, match="SIGKILL, 2 times"):
            process.ask({"path": "kills", "mark": str(tmp_path / "mark")})
        with pytest.raises(isolation.Failed, match="within 3 s"):
            process.ask({"path": "hangs"})
        assert process.ask({"path": "three"}) == {"path": "three"}


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("car,database\n", "columns' names"),
        ("vehicle,channel\n7,0\n", "line 2: channel is a number from 1"),
        ("vehicle,bitrate\n7,fast\n", "bitrate"),
        ("vehicle,channel\n7,1\n7,1\n", "twice"),
        ("vehicle,j1939\n7,maybe\n", "yes or no"),
        ("vehicle,channel\n7,1,2\n", "as many values"),
        ("vehicle,channel\n,1\n", "as many values"),
    ],
)
def test_a_wrong_table_of_vehicles_says_where(table, said):
    with pytest.raises(inputs.InputError, match=said):
        inputs.buses_of(table, "vehicles.csv")


def test_rows_that_are_missing_or_twice_are_noticed(spark, fleet, output, tmp_path):
    traces = sorted(fleet.whole) + sorted(fleet.broken)
    entries = list(ledger_of(output).values())
    dataset.check(spark, entries, traces, str(output))
    with pytest.raises(dataset.AccountError, match="has 2 entries"):
        dataset.check(spark, [*entries, entries[0]], traces, str(output))
    with pytest.raises(dataset.AccountError, match="has 0 entries"):
        dataset.check(spark, entries[1:], traces, str(output))
    copy = tmp_path / "copy"
    shutil.copytree(output, copy)
    file = next(copy.glob("frames/vehicle=005/*/channel=1/*.parquet"))
    shutil.copy(file, file.with_name("twice.parquet"))
    with pytest.raises(dataset.AccountError, match="frames of 005/"):
        dataset.check(spark, entries, traces, str(copy))
    file.with_name("twice.parquet").unlink()
    file.unlink()
    with pytest.raises(dataset.AccountError, match="frames of 005/"):
        dataset.check(spark, entries, traces, str(copy))


def test_no_column_of_the_package_is_left_out(fleet):
    """A column added to the package but unknown to the job would be silently lost."""
    trace, database = fleet.folder / "001/drive 0.blf", fleet.folder / "databases/b.dbc"
    assert set(cantap.scan(trace).column_names) <= set(columns.FRAMES)
    assert set(cantap.scan(trace, db=database).column_names) <= set(columns.SIGNALS)
