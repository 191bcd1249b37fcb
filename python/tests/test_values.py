"""What is decoded, against cantools; and the columns, in the hands of the programs that take them."""

import collections
import pathlib
import random

import pytest

import cantap

cantools = pytest.importorskip("cantools")

DATABASES = sorted((pathlib.Path(__file__).parents[2] / "host/signals/tests/data").rglob("*.dbc"))
FEW = 8
"""Payloads of each message."""


def candump(messages):
    for at, (message, data) in enumerate(messages):
        digits = 8 if message.is_extended_frame else 3
        yield f"({1_700_000_000 + at / 1000:.6f}) can0 {message.frame_id:0{digits}X}#{data.hex().upper()}\n"


@pytest.mark.parametrize("path", DATABASES, ids=lambda path: path.stem)
@pytest.mark.parametrize("suffix", ["log", "blf"])
@pytest.mark.filterwarnings("ignore::cantap.CantapWarning")
def test_every_cell_is_what_cantools_decodes(path, suffix, tmp_path):
    numbers = random.Random(path.stem)
    try:
        database = cantools.database.load_file(path, strict=False)
    except cantools.database.Error as error:
        pytest.skip(f"cantools does not read it: {error}")
    short = [message for message in database.messages if message.length <= 8 and not message.is_fd]
    sent = [(message, numbers.randbytes(message.length)) for message in short for _ in range(FEW)]
    log = tmp_path / "sent.log"
    log.write_text("".join(candump(sent)))
    trace = tmp_path / f"trace.{suffix}"
    if trace != log:
        cantap.write(cantap.read(log), trace)
    decoded = cantap.decode(trace, path)

    wanted = collections.defaultdict(list)
    for message, data in sent:
        try:
            values = message.decode(data, decode_choices=False)
            texts = message.decode(data, decode_choices=True)
        except (cantools.database.DecodeError, ValueError):
            # A selector that no signal belongs to. We give the other signals.
            values = texts = None
        wanted[message.name].append((values, texts))
    for name, rows in wanted.items():
        signals = database.get_message_by_name(name).signals
        if not signals:
            continue
        table = decoded[name].to_pyarrow().to_pylist()
        assert len(table) == len(rows)
        for row, (values, texts) in zip(table, rows):
            if values is None:
                continue
            for signal in signals:
                found, value = row[signal.name], values.get(signal.name)
                assert found == value or found == pytest.approx(value, rel=1e-12, nan_ok=True), (name, signal.name)
                text = texts.get(signal.name)
                named = str(text) if isinstance(text, cantools.database.namedsignalvalue.NamedSignalValue) else None
                assert row.get(f"{signal.name}.text") == named, (name, signal.name)


ODD = """VERSION ""
BU_:
BO_ 291 Engine: 8 ECU
 SG_ time : 0|8@1+ (1,0) [0|255] "s" ECU
 SG_ id : 8|8@1+ (2,0) [0|510] "" ECU
 SG_ data : 16|8@1+ (1,0) [0|255] "" ECU
 SG_ Gear : 24|8@1+ (1,0) [0|255] "" ECU
VAL_ 291 Gear 1 "on" 2 "on" 3 "" ;
VAL_ 291 time 1 "early" ;
"""


@pytest.fixture
def engine(tmp_path):
    (tmp_path / "odd.dbc").write_text(ODD)
    log = tmp_path / "odd.log"
    log.write_text("".join(f"({at}.000000) can0 123#{at:02X}{at + 1:02X}{at + 2:02X}{at:02X}\n" for at in range(1, 4)))
    return cantap.decode(log, tmp_path / "odd.dbc")["Engine"], log, tmp_path / "odd.dbc"


def test_a_signal_with_the_name_of_another_column_gets_a_longer_one(engine):
    table, log, dbc = engine
    names = ("time", "channel", "id", "Engine.time", "Engine.time.text", "Engine.id", "data", "Gear", "Gear.text")
    assert table.column_names == names
    assert table.column_metadata("Engine.time")["unit"] == "s"
    arrays = table.to_numpy()
    assert arrays["Engine.time"].tolist() == [1, 2, 3] and arrays["Engine.id"].tolist() == [4, 6, 8]
    assert arrays["data"].tolist() == [3, 4, 5] and arrays["id"].tolist() == [0x123] * 3
    assert str(arrays["time"].dtype) == "datetime64[ns]"
    chosen = cantap.decode(log, dbc, signals="Engine.id")["Engine"]
    assert chosen.column_names == ("time", "channel", "id", "Engine.id")
    assert chosen.to_numpy()["Engine.id"].tolist() == [4, 6, 8]


def test_texts_that_several_values_share_are_taken_by_every_program(engine):
    table, _, _ = engine
    wanted = ["on", "on", ""]
    assert table.to_numpy()["Gear.text"].tolist() == wanted
    assert table.to_pandas()["Gear.text"].tolist() == wanted
    assert table.to_polars()["Gear.text"].to_list() == wanted
    assert table.to_pyarrow()["Gear.text"].to_pylist() == wanted


def test_a_database_of_another_bus_is_not_silence(engine, tmp_path):
    _, log, _ = engine
    other = tmp_path / "other.dbc"
    other.write_text(ODD.replace("291", "292"))
    for call in (lambda: cantap.decode(log, other), lambda: cantap.read(log, db=other)):
        with pytest.warns(cantap.CantapWarning, match="none of its 3 frames could be decoded"):
            call()
    with cantap.scan(log, db=other) as scan, pytest.warns(cantap.CantapWarning, match="right one"):
        list(scan)
