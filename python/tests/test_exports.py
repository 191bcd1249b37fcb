"""What other programs get: InfluxDB's line protocol, and Grafana's dashboard of a server's figures."""

import json
import re
from pathlib import Path

import pytest

pa = pytest.importorskip("pyarrow")

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
