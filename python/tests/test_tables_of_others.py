"""Tables that other programs made: taken if they are unambiguous, with the defaults that the documentation names."""

import datetime
import os

import numpy as np
import pyarrow as pa
import pytest

import cantap

AT = 1_700_000_000
TIMES = [float(AT), AT + 0.000001, AT + 0.123456]
"""Seconds; the last two are no floating-point numbers, but next to some."""
NS = [AT * 10**9, AT * 10**9 + 1000, AT * 10**9 + 123_456_000]
IDS = [0x123, 0x7FF, 0x18FEF100]
DATA = [b"\x11\x22", b"", bytes(range(8))]


def least(**columns):
    """A table with only what must be there."""
    return {"time": pa.array(NS, pa.timestamp("ns", "UTC")), "id": pa.array(IDS), "data": pa.array(DATA), **columns}


def written(table, path):
    """What a table is as a trace: no rounding, unlike in other formats."""
    path = path / "trace.parquet"
    import pyarrow.parquet

    assert cantap.write(table, path) == {}
    return pyarrow.parquet.read_table(path).to_pylist()


@pytest.fixture
def wanted(tmp_path):
    log = tmp_path / "wanted.log"
    log.write_text(
        f"({AT}.000000) can0 123#1122\n({AT}.000001) can0 7FF#\n({AT}.123456) can0 18FEF100#0001020304050607\n"
    )
    return cantap.read(log).to_pyarrow().to_pylist()


def utc(unit, zone=None):
    per_second = {"s": 1, "ms": 1000, "us": 10**6, "ns": 10**9}[unit]
    return pa.array([at * per_second // 10**9 for at in NS], pa.timestamp(unit, zone))


@pytest.mark.parametrize(
    "columns",
    [
        {},
        {"time": pa.array(TIMES)},
        {"time": utc("us")},
        {"time": utc("us", "Europe/Berlin")},
        {"time": utc("ns", "-05:00")},
        {"time": pa.array([at for at in NS], pa.duration("ns"))},
        {"time": pa.array(np.array(NS, "datetime64[ns]"))},
        {"id": pa.array(IDS, pa.uint32())},
        {"id": pa.array(IDS, pa.uint64())},
        {"id": pa.array([float(at) for at in IDS])},
        {"id": pa.array([hex(at) for at in IDS])},
        {"id": pa.array([hex(at) for at in IDS]).dictionary_encode()},
        {"data": pa.array(DATA, pa.large_binary())},
        {"data": pa.array([list(at) for at in DATA], pa.list_(pa.uint8()))},
        {"data": pa.array([list(at) for at in DATA])},
        {"data": pa.array([list(at) for at in DATA], pa.large_list(pa.int16()))},
        {"data": pa.array([at.hex() for at in DATA])},
        {"data": pa.array([at.hex(" ").upper() for at in DATA], pa.large_string())},
        {"data": pa.array([at.hex(" ").upper() for at in DATA], pa.string_view())},
        {"data": pa.array(DATA, pa.binary_view())},
        {"channel": pa.array([1.0, 1.0, 1.0])},
        {"channel": pa.array([1, 1, 1], pa.int64())},
        {"extended": pa.array([0, 0, 1])},
        {"extended": pa.array([False, None, None])},
        {"dlc": pa.array([2, 0, 8], pa.int64())},
        {"direction": pa.array(["Rx", None, "rx"])},
        {"detail": pa.nulls(3)},
    ],
    ids=lambda columns: ",".join(f"{name}-{column.type}" for name, column in columns.items()) or "least",
)
def test_what_is_unambiguous_is_taken(columns, wanted, tmp_path):
    assert written(pa.table(least(**columns)), tmp_path) == wanted


def test_data_frames_with_three_columns_are_traces(wanted, tmp_path):
    pandas = pytest.importorskip("pandas")
    polars = pytest.importorskip("polars")
    duckdb = pytest.importorskip("duckdb")
    frame = pandas.DataFrame({"time": TIMES, "id": IDS, "data": DATA})
    dates = pandas.to_datetime(frame["time"].map(lambda at: round(at * 10**6)), unit="us", utc=True)
    lists = polars.DataFrame({"time": TIMES, "id": IDS, "data": [list(at) for at in DATA]})
    for table in (
        frame,
        frame.set_index("time"),
        frame.assign(time=dates),
        frame.assign(time=dates.dt.tz_convert("Asia/Tokyo")),
        frame.assign(time=dates.dt.tz_localize(None), direction=pandas.Categorical(["rx"] * 3)),
        frame.assign(data=[np.frombuffer(at, "uint8") for at in DATA]),
        frame[frame["id"] > 0],
        polars.DataFrame(frame),
        lists,
        lists.with_columns(polars.col("data").cast(polars.List(polars.UInt8)), channel=1),
        lists.with_columns(direction=polars.lit("rx").cast(polars.Categorical)),
        lists.with_columns(direction=polars.lit("rx").cast(polars.Enum(["tx", "rx"]))),
        duckdb.sql("select * from lists"),
        duckdb.sql("select make_timestamptz(round(time * 1e6)::bigint) as time, id::uinteger as id, data from frame"),
    ):
        assert written(table, tmp_path) == wanted


def test_other_frames_are_told_by_what_is_there(tmp_path):
    columns = least(
        data=pa.array([bytes(12), None, b""]), remote=[None, True, False], dlc=[None, 3, None], channel=[2, 1, 255], direction=["TX", "rx", "Tx"]
    )
    rows = written(pa.table(columns), tmp_path)
    assert [row["fd"] for row in rows] == [True, False, False]
    assert [row["remote"] for row in rows] == [False, True, False]
    assert [row["dlc"] for row in rows] == [9, 3, 0]
    assert [row["channel"] for row in rows] == [2, 1, 255]
    assert [row["direction"] for row in rows] == ["tx", "rx", "tx"]
    assert [row["extended"] for row in rows] == [False, False, True]


@pytest.mark.parametrize(
    ("columns", "why"),
    [
        ({"time": pa.array(NS)}, "'time'.*float64 with seconds.*Int64"),
        ({"time": pa.array([0.5, 1.5, 2.5], pa.float32())}, "'time'.*Float32"),
        ({"time": pa.array(["2026-01-01"] * 3)}, "'time'"),
        ({"time": pa.array([1.0, None, 2.0])}, "row 1: it has no time"),
        ({"time": pa.array([1.0, float("nan"), 2.0])}, "row 1: it has no time"),
        ({"time": pa.array([float(at) for at in NS])}, "row 0: time: .* s is out of range"),
        ({"time": pa.array([0, 0, 2**62], pa.timestamp("ms"))}, "row 2: time"),
        ({"id": pa.array([1, 2, -1])}, "row 2: id: -1 is out of range"),
        ({"id": pa.array([1, 2, 2**29])}, "row 2: .*29 bits"),
        ({"id": pa.array([1, 2, 2**63], pa.uint64())}, "row 2: id: .* too large"),
        ({"id": pa.array([1, 1.5, 2])}, "row 1: id: 1.5 is not a whole number"),
        ({"id": pa.array([1, None, 2])}, "row 1: the frame has no identifier"),
        ({"id": pa.array(["0x123", "123", "0x1"])}, "row 1: id: '123' may be hexadecimal or decimal"),
        ({"id": pa.array([True, False, True])}, "'id'"),
        ({"extended": pa.array([False, False, False])}, "row 2: a standard identifier"),
        ({"extended": pa.array([0, 2, 1])}, "row 1: extended: 2 is neither"),
        ({"extended": pa.array(["no", "no", "yes"])}, "'extended'.*bool"),
        ({"channel": pa.array([1, 256, 1])}, "row 1: channel: 256 is out of range"),
        ({"channel": pa.array([1, None, 1])}, "row 1: it has no time or no channel"),
        ({"channel": pa.array(["can0"] * 3)}, "row 0: channel: 'can0'"),
        ({"data": pa.array([b"", None, b""])}, "row 1: the frame has no data"),
        ({"data": pa.array([bytes(8), bytes(9), b""])}, "row 1: CAN FD has frames of"),
        ({"data": pa.array([[1], [2, 256], []])}, "row 1: data: 256 is not a byte"),
        ({"data": pa.array([[1], [2, None], []])}, "row 1: data: nothing is not a byte"),
        ({"data": pa.array([[1], [2], [0.5]])}, "row 2: data: 0.5"),
        ({"data": pa.array([[1, 2], [3, 4], [-1, 0]], pa.list_(pa.int8(), 2))}, "row 2: data: -1"),
        ({"data": pa.array(["11", "1", ""])}, "row 1: data: '1' is not pairs"),
        ({"data": pa.array(["11", "xx", ""])}, "row 1: data: 'xx'"),
        ({"data": pa.array([1, 2, 3])}, "'data'"),
        ({"data": pa.array([bytes(9), b"", b""]), "fd": [False] * 3}, "row 0: .*at most 8 bytes"),
        ({"data": pa.array([bytes(12), b"", b""]), "dlc": [12, 0, 0]}, "row 0: dlc does not fit"),
        ({"dlc": pa.array([1, 0, 8])}, "row 0: dlc does not fit"),
        ({"dlc": pa.array([2, 0, 16])}, "row 2: a length code"),
        ({"remote": pa.array([True, False, False])}, "row 0: a remote frame has no data"),
        ({"direction": pa.array(["rx", "in", "tx"])}, "row 1: a direction is rx or tx"),
        ({"event": pa.array(["frame", None, "frame"])}, "row 1: its event"),
        ({"event": pa.array(["frame", "value", "frame"])}, "row 1: .*decoded value"),
    ],
)
def test_what_is_not_is_an_error_and_nothing_is_written(columns, why, tmp_path):
    path = tmp_path / "trace.log"
    path.write_text("older")
    with pytest.raises(cantap.FormatError, match=why):
        cantap.write(pa.table(least(**columns)), path)
    assert path.read_text() == "older" and os.listdir(tmp_path) == ["trace.log"]


@pytest.mark.parametrize("column", ["time", "id", "data"])
def test_what_must_be_there_is_named_with_what_is(column, tmp_path):
    columns = least(timestamp=TIMES)
    del columns[column]
    with pytest.raises(cantap.FormatError, match=f"column '{column}'.*there is none among .*timestamp"):
        cantap.write(pa.table(columns), tmp_path / "a.log")


def test_a_row_is_counted_from_the_first_batch_on(tmp_path):
    table = pa.table({"time": [0.0] * 200_000, "id": [1] * 199_999 + [-1], "data": [b""] * 200_000})
    for each in (table, pa.Table.from_batches(table.to_batches(max_chunksize=70_000))):
        with pytest.raises(cantap.FormatError, match="row 199999"):
            cantap.write(each, tmp_path / "a.log")


def test_events_need_no_identifier(tmp_path):
    events = pa.table({"time": TIMES[:2], "event": ["lost", "state"], "detail": ["host", "passive"], "count": [7, None]})
    assert [row["event"] for row in written(events, tmp_path)] == ["lost", "state"]
    frame = pa.table({"time": TIMES[:1], "event": ["frame"], "id": [1]})
    with pytest.raises(cantap.FormatError, match="row 0: the frame has no data"):
        cantap.write(frame, tmp_path / "a.log")


def test_a_column_that_no_trace_has_is_not_silence(tmp_path):
    columns = least(is_extended_id=[True] * 3)
    with pytest.warns(cantap.CantapWarning, match="the column 'is_extended_id'"):
        assert cantap.write(pa.table(columns), tmp_path / "a.log") == {"the column 'is_extended_id'": 3}


def test_what_search_found_is_a_trace(wanted, tmp_path):
    found = cantap.search(tmp_path / "wanted.log", id="123")
    assert written(found, tmp_path) == wanted[:1]


def test_a_small_table_is_decoded(tmp_path):
    dbc = tmp_path / "a.dbc"
    dbc.write_text('VERSION ""\nBU_:\nBO_ 291 Engine: 8 ECU\n SG_ Speed : 0|8@1+ (0.5,0) [0|100] "km/h" ECU\n')
    decoded = cantap.decode(pa.table(least()), dbc)
    assert decoded["Engine"].to_pyarrow()["Speed"].to_pylist() == [8.5]
    assert decoded["Engine"].to_pyarrow()["time"][0].as_py() == datetime.datetime.fromtimestamp(AT, datetime.timezone.utc)


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "trc", "csv", "pcapng", "mf4"])
def test_a_small_table_goes_through_every_format(suffix, wanted, tmp_path):
    path = tmp_path / f"a.{suffix}"
    cantap.write(pa.table(least()), path)
    again = cantap.read(path).to_pyarrow()
    for column in ("channel", "id", "extended", "data"):
        assert again[column].to_pylist() == [row[column] for row in wanted]
