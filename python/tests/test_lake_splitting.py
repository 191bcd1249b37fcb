"""A large trace that several workers read in parts: rows and ledger are those of the whole."""

import random
import struct
import time
import zlib

import pytest

pa = pytest.importorskip("pyarrow")
import cantap
from cantap.lake import Store, compact, ingest, splitting, vacuum, writing

DBC = 'VERSION ""\nBU_: A\nBO_ 291 Engine: 8 A\n SG_ Speed : 0|8@1+ (0.5,0) [0|255] "km/h" A\n SG_ Gear : 8|4@1+ (1,0) [0|15] "" A\n'
FRAMES = 30_000


def log(path, frames=FRAMES, names=("can0", "can1", "can7")):
    rng = random.Random(1)
    kinds = ["123#{:04X}", "7FF#", "18FEF100#4C4F424A{:04X}", "123##3{:04X}", "123#R2"]
    lines = []
    for at in range(frames):
        lines.append(f"({1_772_409_590 + at / 50:.6f}) {rng.choice(names)} {rng.choice(kinds).format(rng.randrange(65536))}\n")
    path.write_text("".join(lines))
    return path


@pytest.fixture
def database(tmp_path):
    (tmp_path / "car.dbc").write_text(DBC)
    return tmp_path / "car.dbc"


@pytest.fixture
def blf(tmp_path, capfd):
    cantap.write(cantap.read(log(tmp_path / "drive.log")), tmp_path / "drive.blf")
    return tmp_path / "drive.blf"


def content(lake):
    rows = [Store(lake).dataset(table).to_table().sort_by("row").to_pylist() for table in writing.TABLES]
    entries = [{**entry, "files": {table: sum(files.values()) for table, files in entry["files"].items()}} for entry in Store(lake).entries()]
    return rows, entries


def same(trace, tmp_path, database, part_bytes, workers=2):
    """Reads a trace in parts and as one; how many files that makes of frames."""
    ingest(trace, tmp_path / "whole", db=database, part_bytes=0, workers=workers)
    ingest(trace, tmp_path / "parts", db=database, part_bytes=part_bytes, workers=workers)
    whole, parts = content(tmp_path / "whole"), content(tmp_path / "parts")
    assert parts == whole and list(Store(tmp_path / "parts").problems()) == [] and Store(tmp_path / "parts").stray() == []
    return len(Store(tmp_path / "parts").files("frames")) / len(Store(tmp_path / "whole").files("frames")), whole


def test_blf_in_parts_has_the_rows_of_the_whole(blf, tmp_path, database):
    ratio, (rows, [entry]) = same(blf, tmp_path, database, blf.stat().st_size // 5)
    assert ratio > 1.5 and entry["state"] == "read" and [len(table) for table in rows] == [FRAMES, entry["signal_rows"]]


def test_a_log_in_parts_has_the_rows_of_the_whole(tmp_path, database):
    trace = log(tmp_path / "drive.log")
    ratio, (rows, [entry]) = same(trace, tmp_path, database, trace.stat().st_size // 5)
    assert ratio > 1.5 and entry["state"] == "read" and len(rows[0]) == FRAMES


@pytest.mark.parametrize("name", ["drive.mf4", "drive.asc", "drive.trc", "drive.pcapng", "other.log", "full.csv"])
def test_other_formats_are_divided_by_times(tmp_path, database, name):
    """One reading finds the times: MF4's groups are merged by time, and a text's lines mean the same in each part."""
    source = log(tmp_path / "other.log", names=("can0", "vcan0", "engine") if name == "other.log" else ("can0", "can1"))
    trace = tmp_path / name
    if trace != source:
        cantap.write(cantap.read(source), trace, format="csv-full" if name == "full.csv" else None)
    ratio, (rows, [entry]) = same(trace, tmp_path, database, trace.stat().st_size // 5)
    assert ratio > 1.5 and entry["state"] == "read" and len(rows[0]) == entry["records"] > FRAMES // 2


def test_a_trace_whose_records_are_in_no_order_is_read_as_one(tmp_path, database):
    lines = log(tmp_path / "drive.log").read_text().splitlines()
    lines.insert(len(lines), lines[0])
    (tmp_path / "loop.log").write_text("\n".join(lines).replace("can7", "engine") + "\n")
    ratio, (rows, _) = same(tmp_path / "loop.log", tmp_path, database, (tmp_path / "loop.log").stat().st_size // 5)
    assert ratio == 1 and rows[0][-1]["time"] == rows[0][0]["time"]


def test_a_large_mf4_is_read_by_its_index(tmp_path, database):
    """32 MiB and more have one: a worker then reads its part, and not the whole file."""
    import numpy as np

    count = 1_500_000
    frames = {
        "time": pa.array(np.arange(count) * 20_000 + 1_772_409_590 * 10**9, pa.timestamp("ns", "UTC")),
        "id": pa.array(np.where(np.arange(count) % 1000, 0x124, 0x123), pa.uint32()),
        "data": pa.array([bytes([at & 255]) * 8 for at in range(256)] * (count // 256) + [bytes(8)] * (count % 256), pa.binary()),
    }
    cantap.write(frames, tmp_path / "drive.mf4")
    size = (tmp_path / "drive.mf4").stat().st_size
    assert size > 32 << 20
    # What has just been written may still change without a sign of it, for two seconds.
    while (tmp_path / "drive.mf4").stat().st_ctime > time.time() - 2.1:
        time.sleep(0.1)
    parts = list(cantap._native.divide(tmp_path / "drive.mf4", {**options(tmp_path / "drive.mf4"), "indexes": str(tmp_path / "indexes")}, size // 4))
    assert len(parts) >= 4 and sum(records for _, _, records in parts) == count
    assert len(list((tmp_path / "indexes").iterdir())) == 1


def options(path):
    return cantap.traces._options(path, None, (), (), (), None, None, None, None, False)


@pytest.mark.parametrize("kind", ["cut", "damaged", "line"])
def test_what_is_not_whole_is_read_as_one(blf, tmp_path, database, kind):
    trace, size = blf, blf.stat().st_size
    if kind == "cut":
        trace.write_bytes(trace.read_bytes()[:-100])
    elif kind == "damaged":
        content = bytearray(trace.read_bytes())
        content[size // 2 : size // 2 + 50] = bytes(50)
        trace.write_bytes(content)
    else:
        trace = tmp_path / "drive.log"
        trace.write_text(trace.read_text() + "(1.0) can0 nonsense\n")
        size = trace.stat().st_size
    ratio, (_, [entry]) = same(trace, tmp_path, database, size // 5)
    assert ratio == 1 and entry["state"] in ("cut", "damaged") and entry["issues"] > 0


def test_a_signature_among_the_data_divides_nothing(tmp_path, database):
    """Frames whose data are the beginnings of objects: what looks like one is told from what is one when it is read."""
    rng = random.Random(2)
    lines = [f"({at / 50 + 1e9:.6f}) can0 123##0{'4C4F424A' * 2}{bytes([32, 0, 1, 0, rng.choice([48, 1]), 0, 0, 0, 1, 0, 0, 0]).hex()}{'4C4F424A' * 3}\n" for at in range(FRAMES)]
    (tmp_path / "drive.log").write_text("".join(lines))
    cantap.write(cantap.read(tmp_path / "drive.log"), tmp_path / "drive.blf")
    same(tmp_path / "drive.blf", tmp_path, database, (tmp_path / "drive.blf").stat().st_size // 4)


def test_a_wrong_database_is_said_once(blf, tmp_path):
    (tmp_path / "other.dbc").write_text(DBC.replace("291", "292"))
    _, (_, [entry]) = same(blf, tmp_path, tmp_path / "other.dbc", blf.stat().st_size // 3)
    assert entry["state"] == "undecoded" and entry["coverage"] == 0


@pytest.mark.parametrize("parts", [2, 3, 7, 40])
def test_parts_are_all_of_the_file_and_nothing_twice(blf, tmp_path, parts):
    whole = pa.table(cantap.read(blf))
    divided = splitting.divide(blf, blf.stat().st_size // parts)
    assert divided is not None and len(divided.parts) > 1
    tables = [pa.table(cantap.read(splitting.Pieces(str(blf), pieces, "x.blf", "blf"))) for pieces in divided.parts]
    assert pa.concat_tables(tables).to_pylist() == whole.to_pylist()


def test_what_cannot_be_divided_is_not(tmp_path):
    for name, text in [("a.log", b"(1.0) can0 123#" + b"0" * 100), ("b.asc", b"date\n" * 50), ("c.blf", b"LOGG" * 60), ("d.blf", b""), ("e.log", b"(" + b"x" * 99), ("f.blf", b"LOGG" + bytes(range(1, 255)))]:
        (tmp_path / name).write_bytes(text)
        assert splitting.divide(tmp_path / name, 20) is None
    assert splitting.divide(tmp_path / "none.blf", 20) is None


def test_a_container_that_unpacks_to_no_end_is_left_to_the_reader(tmp_path):
    packed = zlib.compress(bytes(100 << 20), 9)
    container = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(packed), 10) + struct.pack("<HH4xII", 2, 0, 100 << 20, 0) + packed
    head = b"LOGG" + struct.pack("<I", 144) + bytes(136)
    (tmp_path / "a.blf").write_bytes(head + (container + bytes(len(container) % 4)) * 4)
    assert splitting.divide(tmp_path / "a.blf", len(container)) is None


def test_the_files_of_a_divided_trace_are_joined_and_can_be_replaced(blf, tmp_path, database):
    lake = tmp_path / "parts"
    same(blf, tmp_path, database, blf.stat().st_size // 5)
    before = content(lake)
    compact(lake)
    assert content(lake) == before and list(Store(lake).problems()) == []
    assert len(Store(lake).files("frames")) == len(Store(tmp_path / "whole").files("frames"))
    vacuum(lake, retain_hours=0)
    database.write_text(DBC.replace("0.5", "0.25"))
    ingest(blf, lake, db=database, part_bytes=blf.stat().st_size // 3, workers=2)
    ingest(blf, tmp_path / "fresh", db=database, part_bytes=0)
    assert content(lake) == content(tmp_path / "fresh") and list(Store(lake).problems()) == []
    assert vacuum(lake, retain_hours=0) != [] and Store(lake).unused() == []


def test_a_killed_part_is_no_loss(blf, tmp_path, database, monkeypatch):
    """A worker that dies while it reads a part: the trace is divided otherwise, and has the same rows."""
    import sys

    module = sys.modules["cantap.lake.ingest"]
    decode, asked = module._Workplace.decode, []

    def dies(place, trace, fetched, stem, part=None):
        if part is not None and part["first_rows"] is not None and not asked:
            asked.append(part)
            part = {**part, "pieces": ["this is not base64"]}
        return decode(place, trace, fetched, stem, part)

    monkeypatch.setattr(module._Workplace, "decode", dies)
    ratio, (_, [entry]) = same(blf, tmp_path, database, blf.stat().st_size // 5)
    assert asked and ratio > 1.5 and entry["state"] == "read"
