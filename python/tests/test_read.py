"""Traces as tables."""

import datetime
import pickle
import threading
import warnings

import pyarrow as pa
import pytest

import cantap

LOG = """\
(1000.000000) can0 123#11
(1000.500000) can1 7FF#R
(1001.000000) can0 00000123#0102
(1001.250000) can0 20000088#0000040000000000
(1002.000000) can0 123##1AABB
"""

DBC = """\
VERSION ""
BU_:
BO_ 291 Engine: 8 ECU
 SG_ Speed : 0|8@1+ (0.5,0) [0|100] "km/h" ECU
 SG_ Gear : 8|8@1+ (1,0) [0|8] "" ECU
VAL_ 291 Gear 1 "First" 2 "Second" ;
"""


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "drive.log"
    path.write_text(LOG)
    return path


@pytest.fixture
def dbc(tmp_path):
    path = tmp_path / "car.dbc"
    path.write_text(DBC)
    return path


def rows(table):
    return pa.table(table).to_pylist()


def test_a_trace_is_a_table_with_a_row_for_each_record(log):
    table = cantap.read(log)
    assert len(table) == table.num_rows == 5
    assert [row["event"] for row in rows(table)] == ["frame", "frame", "frame", "bus-error", "frame"]
    first = rows(table)[0]
    assert first["id"] == 0x123 and first["channel"] == 1 and first["data"] == b"\x11"
    assert first["time"].timestamp() == 1000.0
    assert rows(table)[2]["extended"] and rows(table)[1]["remote"] and rows(table)[4]["fd"]
    assert table.report.frames == 4 and table.report.bus_errors == 1 and table.report.is_whole


def test_with_a_database_there_is_a_row_for_each_value_and_events_stay(log, dbc):
    table = cantap.read(log, db=dbc)
    found = rows(table)
    assert [row["event"] for row in found] == ["value", "bus-error", "value", "value"]
    assert found[0]["signal"] == "Speed" and found[0]["value"] == 0x11 / 2 and found[0]["unit"] == "km/h"
    assert table.report.decoded == 2 and table.report.frames == 4 and table.report.values == 3


def test_databases_are_read_once_and_signals_are_chosen(log, dbc):
    database = cantap.load_database(dbc)
    assert database.message_names == ["Engine"]
    assert [signal["name"] for signal in database.signals_of("Engine")] == ["Speed", "Gear"]
    for db in (database, [dbc], {1: dbc}, pickle.loads(pickle.dumps(database))):
        table = cantap.read(log, db=db, signals="Gear")
        assert [row["signal"] for row in rows(table)] == [None, "Gear"]
    with pytest.warns(cantap.CantapWarning, match="none of its 4 frames"):
        assert len(cantap.read(log, db={2: dbc})) == 1
    with pytest.raises(cantap.DatabaseError, match="Nonsense"):
        cantap.read(log, db=database, signals="Nonsense")
    with pytest.raises(ValueError, match="db="):
        cantap.read(log, signals="Speed")


def test_what_is_read_can_be_chosen(log):
    assert len(cantap.read(log, channel=2)) == 1
    assert len(cantap.read(log, channel=[1, 2])) == 5
    assert [row["id"] for row in rows(cantap.read(log, filter="123"))] == [0x123, 0x123]
    assert len(cantap.read(log, filter=["123", "7FF"])) == 3
    assert len(cantap.read(log, start=0.5, end=1.25)) == 2
    assert len(cantap.read(log, start="1s")) == 3
    assert len(cantap.read(log, end=datetime.timedelta(seconds=1))) == 2
    with pytest.raises(ValueError, match="time zone"):
        cantap.read(log, start=datetime.datetime(2020, 1, 1))


def test_a_date_is_a_point_of_the_trace(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("(1700000000.000000) can0 123#\n(1700000000.250000) can0 124#\n")
    start = datetime.datetime.fromtimestamp(1700000000.1, datetime.timezone.utc)
    assert [row["id"] for row in rows(cantap.read(path, start=start))] == [0x124]
    assert [row["id"] for row in rows(cantap.read(path, end=start))] == [0x123]


def test_scan_gives_batches_and_forgets_them(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("".join(f"({at / 1000:.6f}) can0 {at % 2048:03X}#{at & 0xFF:02X}\n" for at in range(10_000)))
    with cantap.scan(path, batch_rows=1024) as scan:
        sizes = [len(batch) for batch in scan]
    assert sizes == [1024] * 9 + [10_000 - 9 * 1024]
    assert scan.report.frames == 10_000 and scan.report.is_whole
    assert list(scan) == []
    ids = [row for batch in cantap.scan(path, batch_rows=7) for row in pa.table(batch)["id"].to_pylist()]
    assert ids == [at % 2048 for at in range(10_000)]


def test_a_scan_is_a_stream_once(log):
    scan = cantap.scan(log)
    assert pa.RecordBatchReader.from_stream(scan).read_all().num_rows == 5
    with pytest.raises(RuntimeError, match="another"):
        scan.__arrow_c_stream__()


def test_other_programs_take_tables(log, dbc):
    pandas = pytest.importorskip("pandas")
    polars = pytest.importorskip("polars")
    table = cantap.read(log)
    assert pandas.DataFrame.from_arrow(table)["id"].count() == 4
    assert polars.DataFrame(table)["id"].null_count() == 1
    values = polars.DataFrame(cantap.read(log, db=dbc))
    assert values.filter(polars.col("signal") == "Speed")["value"].to_list() == [8.5, 85.0]
    assert pa.record_batch(table).num_rows == 5
    # Nothing was copied: both see the same memory.
    addresses = [pa.table(table)["id"].chunk(0).buffers()[1].address for _ in range(2)]
    assert addresses[0] == addresses[1]


def test_duckdb_reads_a_table_by_its_name(log):
    duckdb = pytest.importorskip("duckdb")
    trace = cantap.read(log)
    assert trace is not None
    assert duckdb.sql("select count(*) from trace where event = 'frame'").fetchall() == [(4,)]


def test_tables_and_reports_are_pickled(log):
    table = cantap.read(log)
    again = pickle.loads(pickle.dumps(table))
    assert pa.table(again).equals(pa.table(table))
    assert again.report.to_dict() == table.report.to_dict()


def test_a_damaged_file_warns_and_says_what_is_missing(log):
    log.write_text(LOG + "rubbish\n(1003.0) can0 12")
    with pytest.warns(cantap.CantapWarning, match="line 6"):
        table = cantap.read(log)
    assert len(table) == 5 and table.report.issues == 2 and not table.report.is_whole
    assert table.report.missing_pct == pytest.approx(2 * 100 / 7)
    with pytest.raises(cantap.FormatError, match="line 6"):
        cantap.read(log, strict=True)


def test_a_cut_file_says_so(log, tmp_path):
    pytest.importorskip("can")
    import can

    path = tmp_path / "a.blf"
    with can.BLFWriter(path) as writer:
        for at in range(10_000):
            writer.on_message_received(can.Message(timestamp=1e9 + at, arbitration_id=at % 2048, data=bytes(8)))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.warns(cantap.CantapWarning):
        table = cantap.read(path)
    assert table.report.is_cut and 0 < table.report.frames < 10_000


def test_what_cannot_be_read_is_an_error(tmp_path, log, dbc):
    with pytest.raises(FileNotFoundError) as caught:
        cantap.read(tmp_path / "none.blf")
    assert caught.value.filename == str(tmp_path / "none.blf")
    with pytest.raises(FileNotFoundError):
        cantap.read(log, db=tmp_path / "none.dbc")
    rubbish = tmp_path / "a.blf"
    rubbish.write_bytes(b"rubbish" * 100)
    with pytest.raises(cantap.FormatError, match="nothing in"):
        cantap.read(rubbish)
    nameless = tmp_path / "a.xyz"
    nameless.write_bytes(b"rubbish")
    with pytest.raises(cantap.FormatError):
        cantap.read(nameless)
    wrong = tmp_path / "a.dbc"
    wrong.write_text("rubbish")
    with pytest.raises(cantap.DatabaseError):
        cantap.read(log, db=wrong)
    assert issubclass(cantap.FormatError, cantap.CantapError)


@pytest.mark.parametrize(
    "arguments",
    [
        {"format": "vhs"},
        {"zone": "Mars/Olympus"},
        {"filter": "xyz:"},
        {"start": "noon"},
        {"channel": -1},
        {"channel": 300},
        {"channel": "one"},
    ],
)
def test_a_wrong_value_is_a_value_error(log, arguments):
    with pytest.raises(ValueError):
        cantap.read(log, **arguments)


@pytest.mark.parametrize(
    "arguments",
    [{"db": 5}, {"filter": 5}, {"channel": 1.5}, {"start": object()}, {"format": 5}, {"signals": [3], "db": None}],
)
def test_a_wrong_type_is_a_type_error(log, arguments):
    with pytest.raises(TypeError):
        cantap.read(log, **arguments)
    with pytest.raises(TypeError):
        cantap.read(5)


def test_no_batch_without_a_row(log):
    with pytest.raises(ValueError, match="row"):
        cantap.scan(log, batch_rows=0)
    with pytest.raises(ValueError, match="range"):
        cantap.scan(log, batch_rows=-1)


def test_threads_read_beside_each_other(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("".join(f"({at}.0) can0 123#{at & 0xFF:02X}\n" for at in range(20_000)))
    counts = []

    def count():
        counts.append(sum(len(batch) for batch in cantap.scan(path, batch_rows=100)))

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)
    assert counts == [20_000] * 4


def test_nothing_is_said_of_a_whole_file(log):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cantap.read(log)
