"""A lake of traces: each content once, whatever happens in between."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

pa = pytest.importorskip("pyarrow")

from cantap.lake import Store, command, ingest, store, writing

DBC = 'VERSION ""\nBU_: A\nBO_ 291 Engine: 8 A\n SG_ Speed : 0|8@1+ (0.5,0) [0|255] "km/h" A\n'


def write(path, first, count=20):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"({first + at}.000000) can{at % 2} 123#{at:02X}\n" for at in range(count)))


@pytest.fixture
def traces(tmp_path):
    for vehicle in ("007", "new one"):
        for number in range(3):
            write(tmp_path / "traces" / vehicle / f"{number}.log", 1_772_409_590 + number * 100 + (vehicle == "007") * 1000)
    (tmp_path / "car.dbc").write_text(DBC)
    return tmp_path / "traces"


def rows(folder, table="frames"):
    found = Store(folder).dataset(table).to_table().to_pylist()
    return sorted(found, key=lambda row: (row["trace"], row["row"]))


def test_traces_become_tables_and_are_not_read_twice(traces, tmp_path):
    lake = tmp_path / "lake"
    summary = ingest(traces, lake, db=tmp_path / "car.dbc", workers=2)
    assert dict(summary.states) == {"read": 6} and summary.records == 120 and summary.problems == {}
    frames, signals = rows(lake), rows(lake, "signals")
    assert len(frames) == len(signals) == 120
    assert {row["vehicle"] for row in frames} == {"007", "new one"} and signals[3]["value"] == 1.5
    # The hour is before midnight, and the trace goes beyond it.
    assert {str(row["day"]) for row in frames} == {"2026-03-01", "2026-03-02"}
    again = ingest(traces, lake, db=tmp_path / "car.dbc")
    assert dict(again.states) == {"known": 6} and again.records == 0
    assert rows(lake) == frames
    write(traces / "007" / "3.log", 1_772_500_000)
    assert dict(ingest(traces, lake, db=tmp_path / "car.dbc").states) == {"known": 6, "read": 1}
    assert len(rows(lake)) == 140


def test_a_content_counts_once_under_all_its_names(traces, tmp_path):
    lake = tmp_path / "lake"
    shutil.copy(traces / "007" / "0.log", traces / "007" / "copy.log")
    summary = ingest(traces, lake)
    assert dict(summary.states) == {"read": 6, "duplicate": 1} and len(rows(lake)) == 120
    (traces / "007" / "0.log").rename(traces / "007" / "renamed.log")
    assert ingest(traces, lake).states["known"] + 1 == 7
    [entry] = [entry for entry in Store(lake).entries() if len(entry["names"]) > 1]
    assert {os.path.basename(name) for name in entry["names"]} >= {"renamed.log"}


def test_another_database_replaces_the_rows(traces, tmp_path):
    lake = tmp_path / "lake"
    ingest(traces, lake)
    assert rows(lake, "signals") == []
    summary = ingest(traces, lake, db=tmp_path / "car.dbc")
    assert dict(summary.states) == {"read": 6} and len(rows(lake)) == len(rows(lake, "signals")) == 120
    (tmp_path / "car.dbc").write_text(DBC.replace("0.5", "0.25"))
    ingest(traces, lake, db=tmp_path / "car.dbc")
    assert len(rows(lake, "signals")) == 120 and rows(lake, "signals")[3]["value"] == 0.75
    assert Store(lake).stray() == [] and list(Store(lake).problems()) == []


def test_what_cannot_be_read_is_in_the_ledger_and_costs_nothing_else(traces, tmp_path):
    lake = tmp_path / "lake"
    (traces / "007" / "rubbish.blf").write_bytes(os.urandom(1000))
    (traces / "007" / "cut.log").write_text("(1.0) can0 123#01\n(2.0) can0 123#0")
    (traces / "007" / "empty.log").write_bytes(b"")
    os.mkfifo(traces / "007" / "pipe.log")
    summary = ingest(traces, lake, db=tmp_path / "car.dbc")
    assert summary.states["read"] == 6 and summary.states["refused"] == 1 and summary.states["empty"] == 1
    assert len(summary.problems) >= 2
    assert dict(ingest(traces, lake, db=tmp_path / "car.dbc", retry=True).states)["refused"] == 1


def test_a_run_that_was_killed_is_resumed_with_the_same_result(traces, tmp_path):
    """Killed at some moment of each run, until one is not: the rows are those of an undisturbed one."""
    for number in range(3, 30):
        write(traces / "007" / f"{number}.log", 1_772_409_590 + number * 100, 2000)
    command_line = [sys.executable, "-m", "cantap.lake.command", "add", str(tmp_path / "killed"), str(traces), "--db", str(tmp_path / "car.dbc"), "--workers", "2"]
    ledger = tmp_path / "killed" / "ledger"
    for entries in (1, 5, 12):
        process = subprocess.Popen(command_line, stdout=subprocess.DEVNULL)
        while process.poll() is None and (not ledger.exists() or len(os.listdir(ledger)) < entries):
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(command_line, check=True, stdout=subprocess.DEVNULL)
    ingest(traces, tmp_path / "whole", db=tmp_path / "car.dbc")
    for table in ("frames", "signals"):
        assert rows(tmp_path / "killed", table) == rows(tmp_path / "whole", table)
    assert list(Store(tmp_path / "killed").problems()) == []
    assert command.main(["check", str(tmp_path / "killed"), "--remove"]) == 0
    assert Store(tmp_path / "killed").stray() == []


def test_a_lake_that_is_not_as_its_ledger_says_is_reported(traces, tmp_path, capsys):
    lake = tmp_path / "lake"
    ingest(traces, lake)
    [first, second, *_] = sorted((lake / "frames").rglob("*.parquet"))
    first.unlink()
    second.write_bytes(b"nonsense")
    (first.parent / "stray.parquet").write_bytes(b"x")
    assert command.main(["check", str(lake)]) == 1
    told = capsys.readouterr()
    assert "2 problems, 1 files of an interrupted run found" in told.out and "of " in told.err
    entry = next((lake / "ledger").glob("*.json"))
    entry.write_text("{")
    assert command.main(["ledger", str(lake)]) == 1 and "remove it" in capsys.readouterr().err


def test_a_folder_that_is_no_lake_stays_as_it_is(traces, tmp_path, capsys):
    before = sorted(traces.rglob("*"))
    assert command.main(["add", str(traces), str(traces)]) == 1
    assert "is no lake" in capsys.readouterr().err and sorted(traces.rglob("*")) == before
    assert command.main(["check", str(traces)]) == 1
    (tmp_path / "later").mkdir()
    (tmp_path / "later" / "lake.json").write_text(json.dumps({"format": 3}))
    assert command.main(["add", str(tmp_path / "later"), str(traces)]) == 1
    assert "update cantap" in capsys.readouterr().err
    with pytest.raises(store.StoreError, match="it has frames, signals"):
        Store(tmp_path / "later").dataset("frame")


def test_the_command_says_what_it_did(traces, tmp_path, capsys):
    lake = str(tmp_path / "lake")
    assert command.main(["add", lake, str(traces / "*" / "0.log"), "--db", f"1={tmp_path / 'car.dbc'}"]) == 0
    assert capsys.readouterr().out == "2 traces: 2 read; 40 records added\n"
    assert command.main(["ledger", lake]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["decoded"] for line in lines] == [10, 10] and {line["vehicle"] for line in lines} == {"007", "new one"}
    (traces / "007" / "a\x1b[31m.blf").write_bytes(b"rubbish and more")
    assert command.main(["add", lake, str(traces)]) == 1
    assert "\x1b" not in capsys.readouterr().err
    assert command.main(["add", lake, str(tmp_path / "none.log")]) == 1


def test_an_object_store_is_read_and_a_url_is_a_name(traces, tmp_path):
    fsspec = pytest.importorskip("fsspec", reason="pip install fsspec")
    memory = fsspec.filesystem("memory")
    for path in sorted(traces.rglob("*.log")):
        memory.pipe(f"/bucket/{path.parent.name}/{path.name}", path.read_bytes())
    ingest("memory://bucket/*/*.log", tmp_path / "lake", db=tmp_path / "car.dbc")
    ingest(traces, tmp_path / "local", db=tmp_path / "car.dbc")
    remote, local = rows(tmp_path / "lake"), rows(tmp_path / "local")
    assert [{**row, "trace": None} for row in remote] == [{**row, "trace": None} for row in local]
    assert {row["trace"] for row in remote} >= {"memory:///bucket/007/0.log"}


def test_the_tables_are_delta_tables_too(traces, tmp_path, capsys):
    deltalake = pytest.importorskip("deltalake", reason="pip install deltalake")
    lake = tmp_path / "lake"
    ingest(traces / "007", lake, db=tmp_path / "car.dbc")
    assert command.main(["delta", str(lake)]) == 0 and "frames: version 0" in capsys.readouterr().out
    (traces / "new one").rename(traces / "50 %2F new")
    ingest(traces, lake, db=tmp_path / "car.dbc")
    for table in writing.TABLES:
        Store(lake).write_delta(table)
        found = deltalake.DeltaTable(str(lake / table)).to_pyarrow_table().to_pylist()
        assert sorted(found, key=lambda row: (row["trace"], row["row"])) == rows(lake, table)
    assert deltalake.DeltaTable(str(lake / "frames"), version=0).to_pyarrow_table().num_rows == 60
    assert Store(lake).stray() == []


def test_traces_are_read_from_an_s3_server(traces, tmp_path):
    server = pytest.importorskip("moto.server", reason="pip install 'moto[server]' s3fs")
    s3fs = pytest.importorskip("s3fs", reason="pip install 'moto[server]' s3fs")
    running = server.ThreadedMotoServer(port=0)
    running.start()
    try:
        host, port = running.get_host_and_port()
        config = {"endpoint_url": f"http://{host}:{port}", "key": "none", "secret": "none"}
        s3 = s3fs.S3FileSystem(**config)
        s3.mkdir("drives")
        for path in sorted(traces.rglob("*.log")):
            s3.pipe(f"drives/{path.parent.name}/{path.name}", path.read_bytes())
        import fsspec.config

        fsspec.config.conf["s3"] = config
        summary = ingest("s3://drives/*/*.log", tmp_path / "lake", db=tmp_path / "car.dbc")
        assert dict(summary.states) == {"read": 6}
        assert {row["trace"] for row in rows(tmp_path / "lake")} >= {"s3://drives/007/0.log"}
        assert dict(ingest(traces, tmp_path / "lake", db=tmp_path / "car.dbc").states) == {"known": 6}
    finally:
        fsspec.config.conf.pop("s3", None)
        running.stop()


def test_a_trace_that_grows_while_it_is_read_is_tried_again_later(traces, tmp_path, monkeypatch):
    module = sys.modules["cantap.lake.ingest"]

    lake, growing = tmp_path / "lake", traces / "007" / "0.log"
    decode = module._Workplace.decode

    def grow(place, *arguments):
        answer = decode(place, *arguments)
        trace = arguments[0]
        if trace.source == str(growing):
            growing.write_text(growing.read_text() + "(1772409999.000000) can0 123#FF\n")
        return answer

    with monkeypatch.context() as patched:
        patched.setattr(module._Workplace, "decode", grow)
        summary = ingest(traces, lake)
    assert summary.states["failed"] == 1 and "changed" in summary.problems[str(growing)]
    assert len(rows(lake)) == 100
    assert ingest(traces, lake).states["read"] == 1 and len(rows(lake)) == 121


def test_a_lake_among_the_traces_does_not_read_itself(traces):
    assert ingest(traces, traces / "lake").states["read"] == 6
    assert dict(ingest(traces, traces / "lake").states) == {"known": 6}


def test_a_missing_database_makes_no_lake(traces, tmp_path):
    with pytest.raises(FileNotFoundError):
        ingest(traces, tmp_path / "lake", db=tmp_path / "none.dbc")
    assert not (tmp_path / "lake").exists()


def outside(tmp_path):
    victim = tmp_path / "precious.parquet"
    victim.write_bytes(b"precious")
    return victim


def test_an_entry_of_somebody_else_removes_nothing_outside_of_the_lake(traces, tmp_path):
    lake, victim = tmp_path / "lake", outside(tmp_path)
    ingest(traces / "007", lake)
    for name in ("../precious.parquet", str(victim), "signals/../../precious.parquet"):
        forged = sorted((lake / "ledger").glob("*.json"))[0]
        entry = json.loads(forged.read_bytes())
        entry["files"]["signals"] = {name: 0}
        forged.write_text(json.dumps(entry))
        with pytest.raises(store.StoreError, match="damaged"):
            list(Store(lake).entries())
        # With a database the trace has other rows, which take the place of those that the entry names.
        ingest(traces / "007", lake, db=tmp_path / "car.dbc")
        assert victim.read_bytes() == b"precious", name
    assert len(rows(lake)) == 60 and list(Store(lake).problems()) == []


def test_a_link_in_a_lake_of_somebody_else_leads_nowhere(traces, tmp_path):
    lake, elsewhere = tmp_path / "lake", tmp_path / "elsewhere"
    ingest(traces / "007", lake)
    name = sorted(Store(lake).files("frames"))[0]
    # A vehicle's folder, and then a file: what they lead to has the names that the ledger expects.
    folder = (lake / name).parent
    shutil.move(folder, elsewhere)
    folder.symlink_to(elsewhere, target_is_directory=True)
    before = {path.name: path.read_bytes() for path in elsewhere.iterdir()}
    with pytest.raises(store.StoreError, match="link"):
        Store(lake).dataset("frames")
    assert any("link" in problem for problem in Store(lake).problems())
    # Of other databases the traces have other rows, which take the place of those.
    for action in (lambda: ingest(traces / "007", lake, db=tmp_path / "car.dbc"), lambda: Store(lake).forget(), lambda: ingest(traces / "007", lake)):
        with suppress(store.StoreError):
            action()
        assert {path.name: path.read_bytes() for path in elsewhere.iterdir()} == before
    folder.unlink()
    shutil.rmtree(lake / "ledger")
    (lake / "ledger").symlink_to(elsewhere, target_is_directory=True)
    with pytest.raises(store.StoreError, match="is a link"):
        ingest(traces / "007", lake)
    assert {path.name: path.read_bytes() for path in elsewhere.iterdir()} == before


def test_an_entry_is_called_by_its_content(traces, tmp_path):
    lake = tmp_path / "lake"
    victim = tmp_path / "precious.json"
    victim.write_text("precious")
    ingest(traces / "007", lake)
    forged = sorted((lake / "ledger").glob("*.json"))[0]
    entry = json.loads(forged.read_bytes())
    forged.write_text(json.dumps({**entry, "sha256": "../../precious"}))
    with pytest.raises(store.StoreError, match="damaged"):
        Store(lake).forget()
    assert victim.read_text() == "precious"


def test_a_transaction_of_somebody_else_touches_nothing_outside_of_the_lake(traces, tmp_path):
    lake, victim = tmp_path / "lake", outside(tmp_path)
    os.utime(victim, (1000, 1000))
    ingest(traces / "007", lake)
    sha256 = sorted((lake / "ledger").glob("*.json"))[0].stem
    for moves in ({sha256: {"../precious.parquet": {}}}, {sha256: {"frames/a.parquet": {"../precious.parquet": 1}}}, {"../../precious": {}}, [], {sha256: 1}):
        (lake / "moves.json").write_text(json.dumps({"number": 1, "moves": moves, "done": False}))
        with pytest.raises(ValueError, match="damaged"):
            Store(lake).mend()
        assert victim.stat().st_mtime == 1000 and victim.read_bytes() == b"precious", moves


def test_a_joined_file_of_somebody_else_writes_nothing_outside_of_the_lake(traces, tmp_path):
    lake, victim = tmp_path / "lake", outside(tmp_path)
    ingest(traces / "007", lake)
    entry = next(Store(lake).entries())
    (name,) = [name for name in entry["files"]["frames"] if "channel=1" in name][:1]
    table = pa.parquet.read_table(lake / name)
    members = [[entry["sha256"], "../precious.parquet", table.num_rows]]
    forged = f"{name.rpartition('/')[0]}/joined-0.parquet"
    pa.parquet.write_table(table.replace_schema_metadata({b"cantap.members": json.dumps(members)}), lake / forged)
    entry["files"]["frames"][forged] = entry["files"]["frames"].pop(name) + 1
    (lake / "ledger" / f"{entry['sha256']}.json").write_text(json.dumps(entry))
    with pytest.raises(OSError, match="outside"):
        Store(lake).mend()
    assert victim.read_bytes() == b"precious"
