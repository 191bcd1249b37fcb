"""Traces as a dataset of pyarrow, for DuckDB and Polars."""

import datetime
import pickle

import pytest

pa = pytest.importorskip("pyarrow")
import pyarrow.compute as pc
import pyarrow.dataset

import cantap
from cantap._bounds import bounds

DBC = """\
VERSION ""
BU_: ECU
BO_ 291 Engine: 8 ECU
 SG_ Speed : 0|8@1+ (0.5,0) [0|200] "km/h" ECU
 SG_ Gear : 8|4@1+ (1,0) [0|8] "" ECU
BO_ 292 Body: 8 ECU
 SG_ Door : 0|1@1+ (1,0) [0|1] "" ECU
VAL_ 291 Gear 1 "First" 2 "Second" ;
"""
UTC = datetime.timezone.utc


@pytest.fixture
def traces(tmp_path):
    for number in range(3):
        lines = [f"({number * 100 + at}.000000) can0 {0x123 + at % 2:X}#{at:02X}0{1 + at % 2}\n" for at in range(50)]
        (tmp_path / f"{number}.log").write_text("".join(lines))
    (tmp_path / "car.dbc").write_text(DBC)
    return tmp_path


@pytest.fixture
def db(traces):
    return cantap.load_database(traces / "car.dbc")


def at(seconds):
    return pa.scalar(int(seconds * 10**9), pa.timestamp("ns", "UTC"))


def filters():
    time, signal = pc.field("time"), pc.field("signal")
    return [
        None,
        (time >= at(10)) & (time < at(205)),
        (time > at(10)) & (time <= at(205)) & (signal == "Speed"),
        time == at(110),
        signal.isin(["Speed", "Door"]),
        ~((time >= at(10)) & (time < at(205))),
        (time < at(3)) | (time > at(240)),
        (signal == "Speed") | (pc.field("value") == 1),
        (signal == "No such signal"),
        (signal == 'x) and (time >= 2050-01-01 00:00:00.000000000Z'),
        signal != "Speed",
        pc.is_null(signal) & (time < at(100)),
        (signal == "Speed") & (signal == "Door"),
    ]


@pytest.mark.parametrize("place", range(13))
def test_a_filter_gives_the_rows_that_it_gives_of_the_whole_table(traces, db, place):
    """Whatever is chosen while files are read, it must not be seen in the rows."""
    chosen = filters()[place]
    whole = pa.table(cantap.read(traces, db=db))
    expected = whole if chosen is None else whole.filter(chosen)
    dataset = cantap.dataset(traces, db=db)
    assert dataset.to_table(filter=chosen).to_pylist() == expected.to_pylist()
    assert dataset.count_rows(chosen) == len(expected)
    assert dataset.to_table(["value"], chosen).to_pylist() == expected.select(["value"]).to_pylist()


def test_bounds_are_found_where_they_are_certain_and_nowhere_else():
    schema = pa.schema([("time", pa.timestamp("ns", "UTC")), ("signal", pa.string())])
    found = bounds((pc.field("time") >= at(1.5)) & (pc.field("signal") == "Speed") & (pc.field("time") < at(9)), schema)
    assert (found.start, found.signals) == ("1970-01-01T00:00:01.500000000", {"Speed"}) and found.end >= "1970-01-01T00:00:09"
    odd = pa.schema([("time) and (time >= 2050-01-01 00:00:00Z", pa.int64()), *schema])
    assert bounds(pc.field("time") >= at(1), odd).start is None
    many = pc.field("signal").isin([f"s{number}" for number in range(1000)])
    assert bounds(many, schema).signals is None


def test_a_message_has_a_column_for_each_signal(traces, db):
    dataset = cantap.dataset(traces, db=db, message="Engine")
    assert dataset.schema.names == ["time", "channel", "id", "Speed", "Gear", "Gear.text"]
    table = dataset.to_table(["Gear.text", "time"], pc.field("Speed") > 10)
    whole = pa.table(cantap.decode(traces, db)["Engine"])
    assert table.to_pylist() == whole.filter(pc.field("Speed") > 10).select(["Gear.text", "time"]).to_pylist()
    assert dataset.count_rows() == len(whole) == dataset.to_table(["time"]).num_rows
    with pytest.raises(cantap.DatabaseError, match="Engin"):
        cantap.dataset(traces, db=db, message="Engin")
    with pytest.raises(ValueError, match="db="):
        cantap.dataset(traces, message="Engine")


def test_polars_scans_it_and_duckdb_queries_it(traces, db):
    polars, duckdb = pytest.importorskip("polars"), pytest.importorskip("duckdb")
    lazy = cantap.dataset(traces, db=db, message="Engine").to_polars()
    fast = lazy.filter(polars.col("time") >= datetime.datetime(1970, 1, 1, 0, 1, 40, tzinfo=UTC)).select(polars.col("Speed").max(), polars.len()).collect()
    assert fast.rows() == [(24.0, 50)]
    engine = cantap.dataset(traces, db=db, message="Engine")
    assert duckdb.sql("select max(Speed), count(*) from engine where time >= '1970-01-01 00:01:40Z'").fetchall() == [(24.0, 50)]
    frames = cantap.dataset(traces)
    assert duckdb.sql("select id, count(*) from frames group by id order by id").fetchall() == [(291, 75), (292, 75)]


def test_what_the_base_class_offers_does_not_crash(traces, db):
    """Its own methods would use what is not there."""
    dataset = cantap.dataset(traces, db=db, message="Engine")
    assert dataset.filter(pc.field("Speed") > 10).count_rows(pc.field("Speed") < 12) > 0
    assert pickle.loads(pickle.dumps(dataset.filter(pc.field("Speed") > 10))).count_rows() == dataset.count_rows(pc.field("Speed") > 10)
    assert dataset.head(3).num_rows == 3 and dataset.take([0, 2]).num_rows == 2
    assert dataset.sort_by("Speed").count_rows() == 75 and len(repr(dataset)) > 10
    assert dataset.scanner(columns=["Speed"], filter=pc.field("Speed") > 10).to_table().num_rows > 0
    assert dataset.scanner(columns={"double": pc.field("Speed") * 2}).head(1).to_pylist() == [{"double": 0.0}]
    assert str(dataset.partition_expression) == "true"
    with pytest.raises(NotImplementedError):
        list(dataset.get_fragments())
    with pytest.raises(NotImplementedError):
        dataset.replace_schema(dataset.schema)


def test_each_query_reads_again(traces):
    dataset = cantap.dataset(traces / "0.log")
    assert dataset.count_rows() == dataset.count_rows() == 50


def test_a_generator_of_files_is_a_dataset(traces):
    dataset = cantap.dataset(traces.glob("0.log"))
    assert dataset.count_rows() == dataset.count_rows() == 50
