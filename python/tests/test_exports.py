"""What other programs get: InfluxDB's line protocol, and Grafana's dashboard of a server's figures."""

import json
import math
import re
from pathlib import Path

import pytest

pa = pytest.importorskip("pyarrow")

import cantap
from cantap.lake import Store, command, influx, ingest

REPOSITORY = Path(__file__).parents[2]
DBC = """\
VERSION ""
BU_: A
BO_ 291 Engine: 8 A
 SG_ Speed : 0|8@1+ (0.5,0) [0|127] "km/h" A
 SG_ Gear : 8|8@1+ (1,0) [0|255] "" A
 SG_ Ratio : 16|32@1- (1,0) [0|0] "" A
BO_ 292 Other: 8 A
 SG_ Speed : 0|8@1+ (1,0) [0|255] "" A
VAL_ 291 Gear 1 "a \\"b\\", \\\\c = d" ;
SIG_VALTYPE_ 291 Ratio : 1 ;
"""


def parsed(text):
    """By somebody else's parser."""
    parser = pytest.importorskip("line_protocol_parser", reason="pip install line-protocol-parser")
    return [parser.parse_line(line) for line in text.splitlines()]


@pytest.fixture
def lake(tmp_path):
    folder = tmp_path / "drives" / "a =,b"
    folder.mkdir(parents=True)
    log = ["(1772409590.000000) can0 123#0A010000C03F", "(1772409590.000000) can0 123#0B020000C07F", "(1772409591.000001) can1 124#05", "(1772409592.000000) can0 20000004#0001000000000000"]
    (folder / "0.log").write_text("\n".join(log) + "\n")
    (tmp_path / "car.dbc").write_text(DBC)
    ingest(tmp_path / "drives", tmp_path / "lake", db=tmp_path / "car.dbc", workers=1)
    return tmp_path / "lake"


def test_a_line_is_a_frame(lake, capsys):
    assert command.main(["influx", str(lake)]) == 0
    told = capsys.readouterr()
    first, second, error, other = sorted(parsed(told.out), key=lambda line: (line["tags"]["channel"], line["measurement"], line["fields"].get("Speed", 0)))
    tags = {"vehicle": "a =,b", "channel": "1", "message": "Engine"}
    values = {"Speed": 5.0, "Gear": 1.0, "Gear.text": 'a "b", \\\\c = d', "Ratio": 1.5}
    assert first == {"measurement": "can", "tags": tags, "fields": values, "time": 1772409590000000000}
    # Its third signal is infinite.
    assert second == {"measurement": "can", "tags": tags, "fields": {"Speed": 5.5, "Gear": 2.0}, "time": 1772409590000000000}
    assert "left out: 1 values" in told.err
    assert error["measurement"] == "can_events" and error["tags"]["event"] == "lost" and error["fields"]["at_least"] is True
    assert other["tags"]["channel"] == "2" and other["fields"] == {"Speed": 5.0} and other["time"] == 1772409591000001000
    assert command.main(["influx", str(lake), "--message", "Other", "--vehicle", "a =,b"]) == 0
    assert [line["measurement"] for line in parsed(capsys.readouterr().out)].count("can") == 1
    assert command.main(["influx", str(lake), "--vehicle", "b"]) == 0 and capsys.readouterr().out == ""


NAMES = ["a", "a b", "a,b", "a=b", "ä", 'a"b', "a\nb c=1i 5", "a\r\x00", "a\\", "\\,", "\\ =", "a\\nb", " a ", "=", ","]


@pytest.mark.parametrize("name", NAMES)
def test_any_text_stays_one_in_its_place(name):
    row = {"vehicle": name, "channel": 1, "time_ns": -5, "event": "value", "detail": None, "count": None, "at_least": None, "id": 1}
    row |= {"message": name, "signal": name, "value": 1e-9, "text": name}
    loss = {**row, "event": "lost", "detail": name, "count": 7, "at_least": True, "message": None, "signal": None, "value": None, "text": None}
    found = list(influx.lines([pa.RecordBatch.from_pylist([row, loss])], influx.Left()))
    assert len(found) == 2 and "\n" not in "".join(found)
    [frame, event] = parsed("\n".join(found))
    clean = re.sub(r"[\x00-\x1f]", " ", name)
    as_name = clean.replace("\\", "/")
    assert frame["tags"] == {"vehicle": as_name, "message": as_name, "channel": "1"} and frame["time"] == -5
    assert frame["fields"] == {as_name: 1e-9, f"{as_name}.text": clean}
    assert event["fields"] == {"count": 7, "at_least": True, "detail": clean} and event["tags"]["event"] == "lost"


def test_all_signals_of_a_lake_are_in_its_lines(lake, capsys):
    rows = [row for row in Store(lake).dataset("signals").to_table().to_pylist() if row["event"] == "value"]
    command.main(["influx", str(lake)])
    fields = [field for line in parsed(capsys.readouterr().out) if line["measurement"] == "can" for field in line["fields"] if not field.endswith(".text")]
    assert len(fields) == len(rows) - 1


def test_the_dashboard_asks_for_figures_that_the_server_has():
    dashboard = json.loads((REPOSITORY / "docs/clients/grafana.json").read_text())
    source = (REPOSITORY / "host/serve/src/metrics.rs").read_text()
    served = set(re.findall(r'"(cantap_\w+)"', source))
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    asked = {name for query in queries for name in re.findall(r"cantap_\w+", query)}
    assert asked <= served and {"cantap_frames_lost_total", "cantap_bus_bits_total", "cantap_bus_errors_total", "cantap_board_up"} <= asked
    labels = {label for query in queries for group in re.findall(r"by \(([^)]*)\)", query) for label in group.split(", ")}
    assert labels <= {"board", "channel", "stage"}
    places = [(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in dashboard["panels"]]
    assert len(set(places)) == len(places) and len({panel["id"] for panel in dashboard["panels"]}) == len(places)


TIME = re.compile(r"\$__timeFilter\((\w+)\)")
LAKE_BOARD = REPOSITORY / "docs/clients/grafana-lake.json"


def filled(query, values, begin="2026-03-01", end="2026-03-03"):
    """A query as Grafana sends it: its variables are lists of texts, and the source's macro a condition on a time."""
    query = re.sub(r"\$\{(\w+):singlequote\}", lambda found: ",".join("'" + value.replace("'", "\\'") + "'" for value in values[found[1]]), query)
    query = TIME.sub(rf"\1 >= '{begin}T00:00:00Z' AND \1 <= '{end}T00:00:00Z'", query)
    assert "$" not in query
    return query


def fetched(answer):
    """Its rows, through Arrow: DuckDB's own need another package for times with a zone."""
    return [tuple(row.values()) for row in pa.table(answer).to_pylist()]


@pytest.fixture
def database(lake, capsys):
    duckdb = pytest.importorskip("duckdb")
    assert command.main(["views", str(lake)]) == 0
    connection = duckdb.connect()
    connection.execute(capsys.readouterr().out)
    return connection


def test_the_dashboard_of_a_lake_asks_for_what_the_views_have(lake, database):
    dashboard = json.loads(LAKE_BOARD.read_text())
    values = {}
    for variable in dashboard["templating"]["list"][1:]:
        values[variable["name"]] = [row[0] for row in database.execute(filled(variable["query"], values)).fetchall()]
    assert values == {"vehicle": ["a =,b"], "message": ["Engine", "Other"], "signal": ["Gear", "Ratio", "Speed"]}
    answers = {}
    for panel in dashboard["panels"]:
        [target] = panel["targets"]
        answer = database.sql(filled(target["rawSql"], values))
        names = answer.columns
        answers[panel["title"]] = fetched(answer)
        is_series = target["format"] == 0
        assert (names[:2] == ["time", "metric"]) == is_series == (panel["type"] == "timeseries")
    rows = Store(lake).dataset("signals").to_table().to_pylist()
    assert len(answers["Signals"]) == sum(row["event"] == "value" for row in rows)
    assert {metric for _, metric, _ in answers["Signals"]} >= {"a =,b Engine.Speed km/h", "a =,b Engine.Gear"}
    assert sum(row[2] for row in answers["Frames"]) == 3 and answers["Traces"] == [("read", 1)]
    assert [row[1].startswith("a =,b lost") for row in answers["Losses, errors, states"]] == [True]
    places = [(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in dashboard["panels"]]
    assert len(set(places)) == len(places) and len({panel["id"] for panel in dashboard["panels"]}) == len(places)
    # Nothing outside of the time that is shown.
    assert fetched(database.sql(filled(dashboard["panels"][3]["targets"][0]["rawSql"], values, "2020-01-01", "2020-01-02"))) == []


def test_messages_are_views_with_a_column_for_each_signal(lake, tmp_path, capsys):
    duckdb = pytest.importorskip("duckdb")
    # At one nanosecond: frames of one message, multiplexed; and names that DuckDB takes for the same.
    odd = tmp_path / "odd.dbc"
    signals = ' SG_ Page M : 0|8@1+ (1,0) [0|0] "" A\n SG_ Low m0 : 8|8@1+ (1,0) [0|0] "" A\n SG_ High m1 : 8|8@1+ (1,0) [0|0] "" A\n'
    more = 'BO_ 512 engine: 8 A\n SG_ time : 0|8@1+ (1,0) [0|0] "" A\n SG_ speed : 8|8@1+ (1,0) [0|0] "" A\n SG_ Speed : 16|8@1+ (1,0) [0|0] "" A\n'
    odd.write_text(f'VERSION ""\nBU_: A\nBO_ 511 Pages: 8 A\n{signals}{more}')
    log = tmp_path / "odd" / "1.log"
    log.parent.mkdir()
    log.write_text("".join(f"(1772409590.000000) can0 {frame}\n" for frame in ("1FF#0001", "1FF#0102", "1FF#0003", "1FF#0104", "200#010203")))
    ingest(log, lake, db=odd, workers=1)
    assert command.main(["views", str(lake), "--wide"]) == 0
    connection = duckdb.connect()
    connection.execute(capsys.readouterr().out)

    def rows(view, *columns):
        chosen = ", ".join(f'"{column}"' for column in columns)
        return connection.execute(f'select {chosen} from messages."{view}" order by all').fetchall()

    assert rows("Engine", "vehicle", "channel", "time_ns", "Speed", "Gear", "Gear.text", "Ratio") == [
        ("a =,b", 1, 1772409590 * 10**9, 5.0, 1.0, r'a "b", \\c = d', 1.5),
        ("a =,b", 1, 1772409590 * 10**9, 5.5, 2.0, None, pytest.approx(math.nan, nan_ok=True)),
    ]
    assert rows("Other", "channel", "Speed") == [(2, 5.0)]
    assert rows("Pages", "Page", "Low", "High") == [(0.0, 1.0, None), (0.0, 3.0, None), (1.0, None, 2.0), (1.0, None, 4.0)]
    assert rows("engine 2", "engine.time", "Speed", "engine.speed") == [(1.0, 3.0, 2.0)]
    counted = connection.execute("select count(*) from signals where event = 'value' and signal = 'Page'").fetchone()
    assert counted == connection.execute('select count(*) from messages."Pages"').fetchone()


def test_what_mf4_files_say_about_their_measurements_is_a_column(tmp_path, capsys):
    duckdb = pytest.importorskip("duckdb")
    drives = tmp_path / "drives" / "007"
    drives.mkdir(parents=True)
    (drives / "0.log").write_text("(1.000000) can0 123#0A\n")
    cantap.write(cantap.read(drives / "0.log"), drives / "1.mf4")
    ingest(tmp_path / "drives", tmp_path / "lake", workers=1)
    assert {entry["format"]: entry["properties"].get("tool_id") for entry in Store(tmp_path / "lake").entries()} == {"candump": None, "mf4": "cantap"}
    assert command.main(["views", str(tmp_path / "lake")]) == 0
    connection = duckdb.connect()
    connection.execute(capsys.readouterr().out)
    query = "select trace, count(*) from frames join ledger using (vehicle, trace) where properties['tool_id'] = 'cantap' group by trace"
    assert connection.execute(query).fetchall() == [(str(drives / "1.mf4"), 1)]


def test_views_have_the_rows_of_the_ledger_and_the_types_of_the_tables(lake, database, tmp_path, capsys):
    for table in ("frames", "signals"):
        expected = Store(lake).dataset(table).to_table()
        found = pa.table(database.sql(f"select * from {table}"))
        assert found.column_names == expected.column_names and found.num_rows == expected.num_rows
    # What the ledger does not name is no part of it.
    stray = next((lake / "frames").rglob("*.parquet"))
    (stray.parent / "stray.parquet").write_bytes(stray.read_bytes())
    assert database.execute("select count(*) from frames").fetchone() == (4,)
    # A lake without traces has the same columns.
    Store(tmp_path / "empty lake's").create()
    assert command.main(["views", str(tmp_path / "empty lake's")]) == 0
    import duckdb

    empty = duckdb.connect()
    empty.execute(capsys.readouterr().out)
    for view in ("frames", "signals", "ledger"):
        kinds = [[(row[0], row[1]) for row in connection.execute(f"describe {view}").fetchall()] for connection in (database, empty)]
        assert kinds[0] == kinds[1] and empty.execute(f"select count(*) from {view}").fetchone() == (0,)
    Store(tmp_path / "l[a]ke").create()
    assert command.main(["views", str(tmp_path / "l[a]ke")]) == 1 and "pattern" in capsys.readouterr().err
