"""Tables by column and by row, and in a notebook."""

import copy
import pickle

import numpy as np
import pyarrow as pa
import pytest

import cantap


@pytest.fixture
def table(tmp_path):
    log = tmp_path / "drive.log"
    log.write_text("".join(f"({at}.000000001) can0 123#{at:02X}{'00' * (at % 3)}\n" for at in range(20)))
    database = tmp_path / "car.dbc"
    database.write_text(
        'VERSION ""\nBU_: A\nBO_ 291 Engine: 8 A\n SG_ Speed : 0|8@1+ (0.5,0) [0|255] "km/h" A\n SG_ Late : 8|8@1+ (1,0) [0|255] "" A\n'
        ' SG_ Gear : 0|2@1+ (1,0) [0|3] "" A\nVAL_ 291 Gear 0 "<b>park" 1 "drive\x1b[2J" ;\n'
    )
    return cantap.decode(log, database)["Engine"]


def test_a_column_is_taken_by_its_name(table):
    speed = table["Speed"]
    assert len(speed) == 20 and speed.name == "Speed" and speed.type == "float64" and speed.metadata["unit"] == "km/h"
    assert list(speed) == speed.to_list() == [at * 0.5 for at in range(20)]
    assert speed[3] == 1.5 and speed[-1] == 9.5 and speed[3:5].to_list() == [1.5, 2.0]
    with pytest.raises(IndexError):
        speed[20]
    assert np.mean(speed) == 4.75 and (np.asarray(speed) == table.to_numpy()["Speed"]).all()
    assert pa.chunked_array(speed).to_pylist() == speed.to_list() == speed.to_pyarrow().to_pylist()
    assert table["time"][1] == 1_000_000_001 and np.asarray(table["time"])[1] == np.datetime64(1_000_000_001, "ns")
    assert table["Gear.text"].to_list()[:4] == ["<b>park", "drive\N{REPLACEMENT CHARACTER}[2J", None, None]
    # A missing value is none, and no number.
    assert table["Late"].to_list()[:3] == [None, 0.0, 0.0] and np.isnan(np.asarray(table["Late"])[0])
    for wrong in ("Sped", ["time", "Sped"]):
        with pytest.raises(KeyError, match="no column 'Sped'; there are time, "):
            table[wrong]


def test_a_name_is_in_a_table_if_it_has_such_a_column(table):
    assert "Speed" in table and "Sped" not in table and "Speed" in table.schema and "Speed" in table[0]
    assert table[3] in table and 3 not in table


def test_what_a_table_does_not_have_leads_to_what_has_it(table):
    with pytest.raises(AttributeError, match=r"a table has no attribute 'Speed'; a column is table\['Speed'\]"):
        table.Speed
    with pytest.raises(AttributeError, match=r"has no attribute 'head'; what pandas and Polars can do, to_pandas\(\) and to_polars\(\) can"):
        table.head
    with pytest.raises(TypeError, match="rows that meet a condition are chosen in to_pandas"):
        table[np.asarray(table["Speed"]) > 3]
    assert table[np.int64(3)]["Speed"] == 1.5


def test_a_notebook_completes_names_of_columns_and_messages(table, tmp_path):
    drive = cantap.decode(tmp_path / "drive.log", tmp_path / "car.dbc")
    for keyed, names in ((table, table.column_names), (table[0], table.column_names), (table.schema, table.column_names), (drive, ["Engine"])):
        assert list(keyed._ipython_key_completions_()) == list(names)
    with pytest.raises(AttributeError, match=r"a message is taken by its name: messages\['Engine'\]"):
        drive.Engine
    with pytest.raises(AttributeError, match="no attribute 'engine'"):
        drive.engine
    again = copy.copy(drive)
    assert list(again) == list(pickle.loads(pickle.dumps(drive))) == ["Engine"] and len(again["Engine"]) == 20


def test_rows_are_taken_by_a_slice_and_columns_by_a_list(table):
    assert table[2:4]["Speed"].to_list() == [1.0, 1.5] and len(table[100:]) == 0 and len(table[:]) == 20
    assert table[-2:]["Speed"].to_list() == [9.0, 9.5] and table[2:4].column_names == table.column_names
    two = table[["Speed", "time"]]
    assert two.column_names == ("Speed", "time") and len(two) == 20
    assert pa.table(two[5:7]).to_pydict()["Speed"] == [2.5, 3.0]
    with pytest.raises(ValueError, match="in order"):
        table[::2]
    with pytest.raises(TypeError, match="by its name"):
        table[1.5]


def test_rows_across_batches_are_those_of_the_whole(tmp_path):
    log = tmp_path / "long.log"
    log.write_text("".join(f"({at // 1000}.{at % 1000:06}) can0 123#{at % 256:02X}\n" for at in range(150_000)))
    table = cantap.read(log)
    whole = table.to_pyarrow()
    assert len(table.batches()) > 2
    for rows in (slice(65_530, 65_545), slice(1, 140_000), slice(131_071, 131_073), slice(149_999, None)):
        assert pa.table(table[rows]) == whole[rows]


def test_a_table_gives_its_rows(table):
    rows = list(table)
    assert len(rows) == len(table) and [row["Speed"] for row in rows] == table["Speed"].to_list()
    first = table[0]
    assert first == rows[0] == table[-len(table)] and first.time == table["time"][0]
    assert first["time"] == first.time and list(first) == list(table.column_names)
    assert "Speed=" in repr(first) and repr(first).startswith("<cantap.Row time=")
    assert pickle.loads(pickle.dumps(first)) == first and copy.copy(first) == first
    with pytest.raises(IndexError, match="there is no row"):
        table[len(table)]
    with pytest.raises(AttributeError, match="there is no column 'speed'"):
        first.speed
    with pytest.raises(KeyError, match="there is no column 'speed'"):
        first["speed"]


def test_a_schema_says_the_columns_types_as_the_documentation_does(table):
    assert dict(table.schema) == {
        "time": "timestamp[ns, UTC]", "channel": "uint8", "id": "uint32",
        "Speed": "float64", "Late": "float64", "Gear": "float64", "Gear.text": "text",
    }  # fmt: skip
    assert str(table.schema).splitlines()[3] == "Speed: float64"
    assert pa.schema(table.schema) == pa.table(table).schema


def test_a_notebook_shows_the_first_and_the_last_rows_without_what_others_put_into_them(table):
    shown = table._repr_html_()
    assert "20 rows" in shown and shown.count("<tr>") == 1 + 5 + 1 + 5 and "1970-01-01 00:00:19.000000001" in shown
    assert "&lt;b&gt;park" in shown and "<b>" not in shown and "\x1b" not in shown
    short = table[:3]._repr_html_()
    assert short.count("<tr>") == 4 and "…" not in short
