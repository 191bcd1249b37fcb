"""What a lake has of one trace."""


import pytest

pa = pytest.importorskip("pyarrow")
from cantap.lake import decoding

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
            "database_names": names, "j1939": False, "signals": list(signals), "zone": None, "rows": str(rows),
        }  # fmt: skip
        entry = decoding.decode(request)
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
