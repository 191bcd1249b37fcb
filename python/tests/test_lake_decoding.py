"""What a lake has of one trace."""

import random
import subprocess
import sys

import pytest

pa = pytest.importorskip("pyarrow")
import pyarrow.compute as pc
import pyarrow.parquet as pq

import cantap
from cantap.lake import columns, decoding, writing

# As in its process: faults are in the ledger.
pytestmark = pytest.mark.filterwarnings("ignore::cantap.CantapWarning")

DBC = """\
VERSION ""
BU_: A
BO_ {id} Engine: 8 A
 SG_ Speed : 0|8@1+ (0.5,0) [0|255] "km/h" A
"""
FRAMES = 40


@pytest.fixture
def decode(tmp_path):
    """Decodes a trace of two channels with databases given as texts; its entry, and its rows by part."""
    log = tmp_path / "drive.log"
    log.write_text("".join(f"({at}.000000) can{at % 2} {0x123 + at % 4:X}#{at:02X}\n" for at in range(FRAMES)))

    def decode(*texts, signals=(), cut=0):
        log.write_bytes(log.read_bytes()[: -cut or None])
        databases, names = [], []
        for number, (channel, text) in enumerate(texts):
            path = tmp_path / f"{number}.dbc"
            path.write_text(text)
            databases.append((channel, str(path)))
            names.append(f"databases/{number}.dbc")
        rows = tmp_path / "rows.arrow"
        request = {
            "path": str(log), "trace": "001/drive.log", "vehicle": "001", "bytes": log.stat().st_size, "databases": databases,
            "database_names": names, "j1939": False, "signals": list(signals), "zone": None, "rows": str(rows), "stem": None, "part": None, "divide": None,
        }  # fmt: skip
        entry, _ = decoding.decode(request)
        with pa.memory_map(str(rows)) as file, pa.ipc.open_stream(file) as reader:
            parts = reader.read_all().column("part").to_pylist()
        return entry, parts.count("frames"), parts.count("signals")

    return decode


def test_a_database_with_some_of_the_frames_has_a_coverage(decode):
    entry, frames, signals = decode((None, DBC.format(id=0x123)))
    assert (entry.state, entry.problem, entry.coverage) == ("read", None, 0.25)
    assert (frames, signals, entry.decoded) == (FRAMES, FRAMES // 4, FRAMES // 4)
    entry, _, _ = decode()
    assert (entry.state, entry.problem, entry.coverage) == ("read", None, None)


def test_a_wrong_database_has_a_state_of_its_own(decode):
    entry, frames, signals = decode((None, DBC.format(id=0x321)))
    assert (entry.state, entry.coverage, entry.decoded) == ("undecoded", 0, 0)
    assert entry.problem == "no signals: databases/0.dbc has a message for none of its frames"
    assert (frames, signals) == (FRAMES, 0)
    # So has the right one for a channel that the trace does not have.
    entry, frames, _ = decode((3, DBC.format(id=0x123)))
    assert (entry.state, entry.coverage, frames) == ("undecoded", 0, FRAMES)


@pytest.mark.parametrize(
    ("database", "signals"), [("this is no database\n", ()), (DBC.format(id=0x123), ["Sped"])]
)
def test_a_database_that_cannot_be_used_costs_signals_only(decode, database, signals):
    entry, frames, of_signals = decode((None, database), signals=signals)
    assert (entry.state, entry.coverage) == ("undecoded", 0) and entry.problem.startswith("no signals: ")
    assert "Sped" in entry.problem if signals else "databases/0.dbc" in entry.problem
    assert "/tmp" not in entry.problem
    assert (frames, of_signals, entry.records, entry.frames) == (FRAMES, 0, FRAMES, FRAMES)


def test_what_is_wrong_with_the_trace_comes_before_what_is_wrong_with_its_database(decode):
    entry, frames, signals = decode((None, DBC.format(id=0x321)), cut=10)
    assert (entry.state, entry.coverage) == ("cut", 0) and frames == FRAMES - 1 and signals == 0
    first, _, second = entry.problem.rpartition("; ")
    assert "ends inside a line" in first and second.startswith("no signals: ")


def test_waiting_rows_take_a_few_times_the_length_of_their_trace(tmp_path):
    """They wait in a temporary folder until the trace is done."""
    chance = random.Random(1)
    frames = ((at // 2, at % 2 + 1, f"{0x100 + at % 50:03X}#{chance.randbytes(8).hex()}") for at in range(20_000))
    log, trace, database = (tmp_path / name for name in ("drive.log", "drive.blf", "car.dbc"))
    log.write_text("".join(f"({1_770_000_000 + at * 1e-3:.6f}) can{channel} {frame}\n" for at, channel, frame in frames))
    cantap.write(cantap.scan(log), trace)
    signals = "".join(f' SG_ S{{number}}x{at} : {at * 8}|8@1+ (0.5,0) [0|255] "km/h" A\n' for at in range(8))
    messages = ("BO_ {id} M{number}: 8 A\n" + signals).format
    database.write_text('VERSION ""\nBU_: A\n' + "".join(messages(id=0x100 + number, number=number) for number in range(50)))
    for stem, most in ((None, 30), ("abc", 15)):
        folder = tmp_path / str(stem)
        folder.mkdir()
        entry, _ = decoding.decode({
            "path": str(trace), "trace": "001/drive.blf", "vehicle": "001", "bytes": 1, "databases": [(None, str(database))],
            "database_names": ["car.dbc"], "j1939": False, "signals": [], "zone": None, "part": None, "divide": None,
            "rows": str(folder if stem else folder / "rows.arrow"), "stem": stem,
        })  # fmt: skip
        assert (entry.state, entry.signal_rows) == ("read", 160_000)
        spilled = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        assert spilled < most * trace.stat().st_size, (spilled, trace.stat().st_size)


def test_files_have_the_rows_of_the_stream(tmp_path):
    """Spark gets rows as a stream of texts, a lake writes them into files: both are the same."""
    log = tmp_path / "drive.log"
    day = 86_400
    times = [-day - 0.000_000_5, -0.000_000_1, 0.0, 1.5, day - 0.000_001, day, 3 * day + 0.123_456_789, 2 * day]
    frames = ["123#0102", "18FEF100#", "123#R2", "123##1AABB", "20000004#0000000000000000"]
    log.write_text("".join(f"({time:.9f}) can{at % 3} {frames[at % 5]}\n" for at, time in enumerate(times * 20)))
    database = tmp_path / "car.dbc"
    database.write_text(DBC.format(id=0x123) + 'VAL_ 291 Speed 1 "one" 170 "much" ;\n')
    request = {
        "path": str(log), "trace": "001/drive.log", "vehicle": "1/ä", "bytes": 1, "databases": [(None, str(database))],
        "database_names": ["car.dbc"], "j1939": False, "signals": [], "zone": None, "part": None, "divide": None,
    }  # fmt: skip
    rows, folder = tmp_path / "rows.arrow", tmp_path / "files"
    entry, none = decoding.decode({**request, "rows": str(rows), "stem": None})
    as_files, files = decoding.decode({**request, "rows": str(folder), "stem": "abc"})
    assert as_files == entry and none == {} and entry.state == "read"
    with pa.OSFile(str(rows)) as file, pa.ipc.open_stream(file) as reader:
        stream = reader.read_all()
    for table, kinds in writing.TABLES.items():
        found = pa.concat_tables([pq.read_table(folder / name, partitioning=None) for name in files[table]])
        assert found.schema.equals(columns.schema(kinds)) and sum(files[table].values()) == found.num_rows
        of_table = stream.filter(pc.equal(stream.column("part"), table)).select(found.column_names)
        assert of_table.num_rows > 0 and found.sort_by("row").to_pylist() == of_table.sort_by("row").to_pylist()
    assert len({name.split("/")[2] for name in files["frames"]}) == 6


def test_a_process_that_decodes_loads_no_more_than_it_needs():
    """Each worker is one, and each trace that kills it costs another."""
    program = "import sys, cantap.lake.decoding; print([name for name in ('pandas', 'pyarrow.dataset') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=True, text=True).stdout == "[]\n"
