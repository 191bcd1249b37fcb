"""A lake's small files joined: nothing else changes, whenever it is killed and whatever runs beside it."""

import hashlib
import json
import subprocess
import sys
import threading

import pytest

pa = pytest.importorskip("pyarrow")
import pyarrow.parquet as pq

from cantap.lake import Store, command, compact, compaction, ingest, joined, store, vacuum, writing

DBC = 'VERSION ""\nBU_: A\nBO_ 291 Engine: 8 A\n SG_ Speed : 0|8@1+ (0.5,0) [0|255] "km/h" A\n'
TRACES = 8


def write(path, first, count=30):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"({first + at}.000000) can{at % 2} 123#{at:02X}\n" for at in range(count)))


@pytest.fixture
def traces(tmp_path):
    for vehicle in ("007", "new one"):
        for number in range(TRACES // 2):
            # The hour is before midnight, and the first goes beyond it.
            write(tmp_path / "traces" / vehicle / f"{number}.log", 1_772_409_590 - number * 100 + (vehicle == "007") * 1000)
    (tmp_path / "car.dbc").write_text(DBC)
    return tmp_path / "traces"


@pytest.fixture
def lake(traces, tmp_path):
    ingest(traces, tmp_path / "lake", db=tmp_path / "car.dbc", workers=1)
    return tmp_path / "lake"


def content(lake):
    """The hash of all rows, and the ledger without the names of files."""
    digest = hashlib.sha256()
    for table in writing.TABLES:
        rows = Store(lake).dataset(table).to_table().sort_by([("trace", "ascending"), ("row", "ascending")])
        digest.update(repr(rows.to_pylist()).encode())
    return digest.hexdigest(), [{**entry, "files": {table: sum(files.values()) for table, files in entry["files"].items()}} for entry in Store(lake).entries()]


def count(lake):
    return {table: len(Store(lake).files(table)) for table in writing.TABLES}


def test_small_files_are_joined_and_nothing_else_changes(lake, traces, tmp_path, capsys):
    before, files = content(lake), count(lake)
    assert command.main(["compact", str(lake)]) == 0
    # Two vehicles with two channels each; a trace of the second goes into another day, and has nobody to be joined with there.
    partitions = len({name.rpartition("/")[0] for name in Store(lake).files("frames")})
    assert count(lake) == {"frames": partitions, "signals": partitions} and partitions < files["frames"]
    assert content(lake) == before and list(Store(lake).problems()) == []
    # Earlier versions would see rows several times, and refuse it instead.
    assert json.loads((lake / "lake.json").read_text()) == {"format": 2}
    assert "32 files joined into 8, " in capsys.readouterr().out
    # There is nothing more to do.
    assert compact(lake).files == 0 and content(lake) == before
    # Nothing is read again, and what comes later is joined with what is there.
    assert dict(ingest(traces, lake, db=tmp_path / "car.dbc", workers=1).states) == {"known": TRACES}
    write(traces / "007" / "later.log", 1_772_412_000)
    ingest(traces, lake, db=tmp_path / "car.dbc", workers=1)
    later = content(lake)
    assert compact(lake).joined == 4 and content(lake) == later and list(Store(lake).problems()) == []


def test_what_was_joined_stays_until_it_is_removed_by_age(lake, tmp_path, capsys):
    old = [lake / name for table in writing.TABLES for name in Store(lake).files(table)]
    compact(lake)
    before = content(lake)
    # A query that began before goes on.
    assert all(path.exists() for path in old)
    assert command.main(["check", str(lake), "--remove"]) == 0 and "interrupted" not in capsys.readouterr().out
    assert vacuum(lake, retain_hours=1) == []
    assert command.main(["vacuum", str(lake), "--older-than", "0"]) == 0
    unused = [path for path in old if not path.exists()]
    assert f"{len(unused)} files removed" in capsys.readouterr().out and len(unused) > TRACES
    assert content(lake) == before and Store(lake).unused() == []
    with pytest.raises(SystemExit):
        command.main(["vacuum", str(lake)])
    with Store(lake).transactions.run():
        assert command.main(["vacuum", str(lake), "--older-than", "0"]) == 1
    assert "try again when that is done" in capsys.readouterr().err


@pytest.mark.parametrize("vacuumed", [False, True])
def test_a_trace_in_a_joined_file_can_be_replaced(lake, traces, tmp_path, vacuumed):
    compact(lake)
    if vacuumed:
        vacuum(lake, retain_hours=0)
    (tmp_path / "car.dbc").write_text(DBC.replace("0.5", "0.25"))
    ingest(traces / "007" / "0.log", lake, db=tmp_path / "car.dbc", workers=1)
    assert list(Store(lake).problems()) == []
    values = {(row["trace"], row["row"]): row["value"] for row in Store(lake).dataset("signals").to_table().to_pylist()}
    assert len(values) == TRACES * 30
    assert values[str(traces / "007" / "0.log"), 4] == 1.0 and values[str(traces / "007" / "1.log"), 4] == 2.0
    ingest(traces, lake, db=tmp_path / "car.dbc", workers=2)
    ingest(traces, tmp_path / "fresh", db=tmp_path / "car.dbc", workers=2)
    assert content(lake)[0] == content(tmp_path / "fresh")[0]


STEPS = ["join", "begin", "_write_entry", "end"]


@pytest.mark.parametrize("step", STEPS)
def test_killed_at_any_step_it_changes_nothing(lake, tmp_path, step):
    """The process ends at each call of a step in turn, as if by SIGKILL; what is there then is the same lake."""
    before = content(lake)
    program = """
import os, sys
from cantap.lake import compact, compaction, store, transactions
lake, step, calls = sys.argv[1], sys.argv[2], int(sys.argv[3])
place = {"join": compaction, "begin": transactions.Transactions, "end": transactions.Transactions}.get(step, store.Store)
original = getattr(place, step)
def dies(*arguments):
    global calls
    calls -= 1
    if calls == 0:
        os._exit(9)
    return original(*arguments)
setattr(place, step, dies)
compact(lake)
"""
    for call in range(1, 60):
        ended = subprocess.run([sys.executable, "-c", program, str(lake), step, str(call)], check=False).returncode
        assert content(lake) == before, (step, call)
        if ended == 0:
            break
        assert ended == 9
    else:
        pytest.fail("it was never left alone")
    assert call > 1 and list(Store(lake).problems()) == [] and compact(lake).files == 0


def test_traces_are_added_while_files_are_joined(traces, lake, tmp_path):
    """Readers see each row once all the time."""
    for number in range(20):
        write(traces / "007" / f"more {number}.log", 1_772_400_000 + 100 * number)
    done, seen = threading.Event(), []

    def read():
        while not done.is_set():
            for table in writing.TABLES:
                found = Store(lake).files(table)
                rows = {name: pq.read_metadata(lake / name).num_rows for name in found}
                seen.append(rows == found)

    reader = threading.Thread(target=read)
    reader.start()
    adding = subprocess.Popen([sys.executable, "-m", "cantap.lake.command", "add", str(lake), str(traces), "--db", str(tmp_path / "car.dbc"), "--workers", "1"], stdout=subprocess.DEVNULL)
    while adding.poll() is None:
        compact(lake)
    done.set()
    reader.join()
    assert adding.returncode == 0 and seen and all(seen)
    compact(lake)
    ingest(traces, tmp_path / "fresh", db=tmp_path / "car.dbc")
    assert content(lake)[0] == content(tmp_path / "fresh")[0] and list(Store(lake).problems()) == []


def test_a_trace_replaced_meanwhile_is_not_joined_with_its_old_rows(traces, lake, tmp_path, monkeypatch):
    original = compaction.join

    def replaces(*arguments):
        original(*arguments)
        (tmp_path / "car.dbc").write_text(DBC.replace("0.5", "0.25"))
        ingest(traces / "007" / "0.log", lake, db=tmp_path / "car.dbc", workers=1)

    with monkeypatch.context() as patched:
        patched.setattr(compaction, "join", replaces)
        compact(lake)
    assert list(Store(lake).problems()) == []
    values = {row["value"] for row in Store(lake).dataset("signals").to_table().to_pylist() if row["trace"].endswith("007/0.log")}
    assert max(values) == 29 * 0.25


def test_what_cannot_be_read_is_left_as_it_is(lake, capsys):
    name = min(Store(lake).files("frames"))
    (lake / name).write_bytes(b"nonsense")
    assert command.main(["compact", str(lake)]) == 1 and name in capsys.readouterr().err
    assert name in Store(lake).files("frames")
    assert command.main(["check", str(lake), "--forget"]) == 1 and "forgotten; add it again" in capsys.readouterr().out
    assert list(Store(lake).problems()) == [] and len(list(Store(lake).entries())) == TRACES - 1


def test_rows_of_an_entry_that_somebody_removed_are_not_seen(lake, traces, tmp_path):
    before = content(lake)
    compact(lake)
    entry = next(entry for entry in Store(lake).entries() if entry["trace"].endswith("007/1.log"))
    (lake / "ledger" / f"{entry['sha256']}.json").unlink()
    with pytest.raises(store.StoreError, match="compact` mends it"):
        Store(lake).dataset("frames")
    ingest(traces, lake, db=tmp_path / "car.dbc")
    with pytest.raises(store.StoreError, match="compact` mends it"):
        Store(lake).dataset("frames")
    compact(lake)
    assert content(lake) == before and list(Store(lake).problems()) == []


def test_the_length_of_files_is_chosen(lake, capsys):
    before = content(lake)
    assert compact(lake, file_bytes=1).files == 0
    lengths = [(lake / name).stat().st_size for name in Store(lake).files("signals")]
    assert compact(lake, file_bytes=3 * max(lengths)).joined > 0
    assert content(lake) == before and max(len(joined.members(lake / name)) for name in Store(lake).files("signals") if joined.is_joined(name)) <= 3
    for wrong in ("0", "64X", "-1", "1.5M", ""):
        with pytest.raises(SystemExit):
            command.main(["compact", str(lake), "--file-size", wrong])
        assert "such as 64M" in capsys.readouterr().err


def test_a_folder_that_is_no_lake_is_not_touched(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    for arguments in (["compact"], ["vacuum", "--older-than", "0"], ["check", "--remove"]):
        assert command.main([*arguments, str(tmp_path / "a")]) == 1
        assert "is no lake" in capsys.readouterr().err and list((tmp_path / "a").iterdir()) == []
        assert command.main([*arguments, str(tmp_path / "none")]) == 1
        assert not (tmp_path / "none").exists()


def test_a_delta_table_keeps_its_files(lake, capsys):
    deltalake = pytest.importorskip("deltalake", reason="pip install deltalake")
    before = content(lake)
    assert command.main(["delta", str(lake)]) == 0
    compact(lake)
    vacuum(lake, retain_hours=0)
    rows = len(before[1]) * 30
    assert deltalake.DeltaTable(str(lake / "frames")).to_pyarrow_table().num_rows == rows
    assert command.main(["delta", str(lake)]) == 0
    vacuum(lake, retain_hours=0)
    assert Store(lake).unused() == [] and content(lake) == before
    delta = deltalake.DeltaTable(str(lake / "frames"))
    assert delta.to_pyarrow_table().num_rows == rows and len(delta.file_uris()) == count(lake)["frames"]
