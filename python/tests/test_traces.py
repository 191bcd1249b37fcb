"""Operations on a whole trace."""

import os

import numpy as np
import pyarrow as pa
import pytest

import cantap
from test_read import dbc, log, rows  # noqa: F401


def test_decoding_gives_a_table_for_each_message(log, dbc):
    decoded = cantap.decode(log, dbc)
    assert list(decoded) == ["Engine"] and len(decoded) == 1
    engine = decoded["Engine"]
    assert engine.column_names == ("time", "channel", "id", "Speed", "Gear", "Gear.text")
    assert engine.column_metadata("Speed")["unit"] == "km/h"
    assert engine.metadata["message"] == "Engine"
    assert [row["Speed"] for row in rows(engine)] == [8.5, 85.0]
    assert [row["Gear"] for row in rows(engine)] == [None, 187.0]
    assert [row["event"] for row in rows(decoded.events)] == ["bus-error"]
    assert decoded.report.decoded == 2
    with pytest.raises(KeyError, match="no column"):
        engine.column_metadata("Nonsense")


def test_tables_of_records_are_decoded_too(log, dbc):
    table = cantap.read(log)
    for source in (table, table.to_polars(), cantap.scan(log)):
        decoded = cantap.decode(source, dbc, signals="Speed")
        assert decoded["Engine"].column_names == ("time", "channel", "id", "Speed")
        assert [row["Speed"] for row in rows(decoded["Engine"])] == [8.5, 85.0]
        assert len(decoded.events) == 1 and decoded.report is None
    with pytest.raises(ValueError, match="signals"):
        cantap.decode(table, dbc, channel=1)
    with pytest.raises(TypeError):
        cantap.decode(5, dbc)


def test_what_is_looked_for_is_found_with_its_place(log, dbc):
    found = cantap.search(log, "Speed > 50", db=dbc)
    assert [row["place"] for row in rows(found)] == [4]
    assert [row["place"] for row in rows(cantap.search(log, id="123"))] == [0, 4]
    assert [row["place"] for row in rows(cantap.search(log, id=["123", "7FF"], max_count=2))] == [0, 1]
    assert [row["place"] for row in rows(cantap.search(log, data="* 02"))] == [2]
    assert [row["place"] for row in rows(cantap.search(log, "error"))] == [3]
    for arguments in ({}, {"condition": "Speed >"}, {"condition": "Nonsense > 1", "db": dbc}, {"id": "xyz"}, {"data": "1"}):
        with pytest.raises(ValueError):
            cantap.search(log, **arguments)


def test_statistics_are_those_of_the_command(log):
    found = cantap.stats(log, 500_000, window=0.5)
    assert found["frames"] == 4 and found["errors"] == 1 and found["issues"] == 0
    assert [channel["channel"] for channel in found["channels"]] == [1, 2]
    assert cantap.stats(log, {1: 500_000})["channels"][0]["bitrate_bps"] == 500_000
    for arguments in ({"bitrate": 0}, {"window": -1.0}, {"window": 0.0}):
        with pytest.raises(ValueError):
            cantap.stats(log, **arguments)


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "trc", "csv", "pcapng", "mf4", "log.gz", "blf.xz", "parquet"])
def test_what_was_written_is_what_was_read(tmp_path, suffix):
    first = tmp_path / "first.log"
    first.write_text("".join(f"(1700000000.{at:06}) can0 {at:03X}#{at & 0xFF:02X}11\n" for at in range(2000)))
    table = cantap.read(first)
    path = tmp_path / f"second.{suffix}"
    assert cantap.write(table, path) == {}
    if suffix == "parquet":
        import pyarrow.parquet

        again = pyarrow.parquet.read_table(path)
    else:
        again = pa.table(cantap.read(path))
    # Not times: some formats keep them as floating-point numbers of seconds.
    columns = ["channel", "id", "data", "dlc", "direction"]
    assert again.select(columns).to_pylist() == pa.table(table).select(columns).to_pylist()
    assert set(os.listdir(tmp_path)) == {path.name, first.name}


def test_what_a_format_does_not_carry_is_said(log, tmp_path):
    with pytest.warns(cantap.CantapWarning, match="does not carry"):
        left_out = cantap.write(cantap.read(log), tmp_path / "a.trc", format="trc1.0")
    assert left_out


def test_tables_of_other_programs_are_written(log, tmp_path):
    table = cantap.read(log)
    path = tmp_path / "b.log"
    polars = pytest.importorskip("polars")
    for other in (pa.table(table), table.to_pandas(), polars.DataFrame(table), pa.record_batch(table), cantap.scan(log)):
        cantap.write(other, path)
        again = cantap.read(path)
        assert [row["event"] for row in rows(again)] == [row["event"] for row in rows(table)]
        assert [row["data"] for row in rows(again)] == [row["data"] for row in rows(table)]


def test_what_is_no_trace_is_not_written_and_an_older_file_stays(log, tmp_path):
    path = tmp_path / "b.log"
    path.write_text("older")
    table = pa.table(cantap.read(log))
    for other, error in (
        (table.drop_columns(["id"]), cantap.FormatError),
        (table.set_column(0, "time", pa.array(["x"] * 5)), cantap.FormatError),
        (pa.table({"a": [1]}), cantap.FormatError),
        (5, TypeError),
        ({"a": 1}, TypeError),
    ):
        with pytest.raises(error):
            cantap.write(other, path)
    with pytest.raises(cantap.FormatError, match="only read"):
        cantap.write(table, tmp_path / "a.db")
    with pytest.raises(cantap.FormatError):
        cantap.write(table, tmp_path / "a.xyz")
    with pytest.raises(OSError):
        cantap.write(table, tmp_path / "no" / "a.log")
    assert path.read_text() == "older" and sorted(os.listdir(tmp_path)) == ["b.log", "drive.log"]


def test_a_file_can_be_written_over_while_it_is_scanned(log):
    cantap.write(cantap.scan(log), log)
    assert len(cantap.read(log)) == 5


def test_numpy_has_every_column(log, dbc):
    columns = cantap.read(log).to_numpy()
    assert columns["time"].dtype == "datetime64[ns]" and columns["time"][0] == np.datetime64(1000, "s")
    assert columns["id"].tolist() == [0x123, 0x7FF, 0x123, None, 0x123]
    assert columns["event"].tolist() == ["frame", "frame", "frame", "bus-error", "frame"]
    # A byte that a shorter frame does not have is no zero.
    assert columns["data"].shape == (5, 2) and columns["data"].tolist() == [[0x11, None], [None, None], [1, 2], [None, None], [0xAA, 0xBB]]
    assert np.isnan(np.asarray(cantap.read(log)["data"])[0]).tolist() == [False, True]
    assert columns["extended"].tolist() == [False, False, True, None, False]
    values = cantap.read(log, db=dbc).to_numpy()
    assert values["value"].compressed().tolist() == [8.5, 85.0, 187.0]
    assert values["signal"].tolist() == ["Speed", None, "Speed", "Gear"]
    assert cantap.decode(log, dbc)["Engine"].to_numpy()["Speed"].tolist() == [8.5, 85.0]


def test_pandas_and_polars(log):
    assert cantap.read(log).to_pandas()["id"].count() == 4
    assert cantap.read(log).to_polars().height == 5

