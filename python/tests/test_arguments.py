"""What a call takes, and that an error says which argument was wrong and what would be right."""

import datetime

import cantools
import numpy as np
import pyarrow as pa
import pytest

import cantap

BEGIN_NS = 1_700_000_000_123_456_789
"""2023-11-14 22:13:20."""


@pytest.fixture
def log(tmp_path):
    return trace(tmp_path / "drive.csv", BEGIN_NS)


def trace(path, begin_ns):
    """Three frames, ten milliseconds apart."""
    text = path.with_suffix(".log")
    text.write_text("".join(f"(0.{at}00000) can0 123#{at:02X}\n" for at in range(3)))
    table = cantap.read(text).to_pyarrow()
    times = pa.array([begin_ns + at * 10_000_000 for at in range(3)], table.schema.field("time").type)
    cantap.write(table.set_column(0, "time", times), path, format="csv-full")
    return path


def first_data(table):
    return [row["data"][0] for row in table.to_pyarrow().to_pylist()]


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        ({"path": None}, TypeError, "path is a file's name, an open file, or several of them, not NoneType"),
        ({"path": b"drive.blf"}, TypeError, "path is a file's name, an open file, or several of them, not bytes"),
        ({"format": 3}, TypeError, "format: 'int'"),
        ({"zone": 3}, TypeError, "zone: 'int'"),
        ({"filter": 5}, TypeError, "filter is a text or several texts, not int"),
        ({"filter": None}, TypeError, "filter is a text or several texts, not NoneType"),
        ({"filter": b"123"}, TypeError, "filter is a text or several texts, not bytes"),
        ({"filter": [1]}, TypeError, "filter: 'int'"),
        ({"channel": b"1"}, TypeError, "channel is a number, a text such as 'can0', or several of them, not bytes"),
        ({"channel": 1.5}, TypeError, "channel is a number, a text such as 'can0', or several of them, not float"),
        ({"channel": [1.5]}, TypeError, "channel is a number or a text, not float"),
        ({"channel": 2**70}, ValueError, "there is no channel 1180591620717411303424; a trace's have numbers from 0 to 255"),
        ({"channel": [-1]}, ValueError, "there is no channel -1; a trace's have numbers from 0 to 255"),
        ({"start": np.datetime64("NaT")}, ValueError, "NaT"),
    ],
)
def test_an_error_says_which_argument_it_was(log, wrong, error, said):
    with pytest.raises(error) as caught:
        cantap.read(**({"path": log} | wrong))
    assert said in str(caught.value)


@pytest.mark.parametrize(
    "call",
    [
        lambda log: cantap.scan(log, batch_rows=-1),
        lambda log: cantap.search(log, id="123", max_count=-1),
        lambda log: cantap.stats(log, -1),
        lambda log: cantap.stats(log, {1: 2**40}),
        lambda log: cantap.stats(log, {300: 500_000}),
        lambda log: cantap.stats(log, {256: 500_000}),
        lambda log: cantap.load_database({300: log}),
        lambda log: cantap.load_database([]),
        lambda log: cantap.load_database({}),
        lambda log: cantap.Frame(-1),
        lambda log: cantap.Frame(2**70),
        lambda log: cantap.Frame(1, [256]),
        lambda log: cantap.Frame(1, remote=True, dlc=-1),
        lambda log: cantap.open("virtual", -1),
        lambda log: cantap.open("virtual", 2**40),
        lambda log: cantap.open("virtual", 500_000, channels=[-1]),
        lambda log: cantap.open("virtual", capacity=-1),
    ],
)
def test_what_is_out_of_range_is_a_value_error(log, call):
    with pytest.raises(ValueError):
        call(log)


def test_a_devices_arguments_are_checked_in_the_same_way():
    with cantap.open("virtual:load=0,wire=joined", 500_000, mode="normal") as device:
        for wrong in (
            lambda: device.send(-1, "123#"),
            lambda: device.send(2**70, "123#"),
            lambda: device.send(1, "123#", at=float("nan")),
            lambda: device.send(1, "123#", at=1e300),
            lambda: device.send_periodic(1, "123#00", 0.1, count=-1),
            lambda: device.send_periodic(1, "123#00", 0.1, modifiers=[cantap.Counter(-1)]),
            lambda: device.reply(1, -1, "123#"),
            lambda: device.reply(1, 1, "123#", mask=-1),
            lambda: device.identify(300),
            lambda: device.batch(0, -1),
            lambda: device.records(-1),
            lambda: device.records(capacity=-1),
            lambda: device.read(float("nan")),
            lambda: device.close_channel(-1),
        ):
            with pytest.raises(ValueError):
                wrong()
        for wrong in (
            lambda: device.send(1, 5),
            lambda: device.send(1, "123#", at="now"),
            lambda: device.send_periodic(1, "123#00", 0.1, modifiers=[5]),
            lambda: device.send_periodic(1, "123#00", 0.1, modifiers=cantap.Counter(0)),
            lambda: device.records(filter=5),
        ):
            with pytest.raises(TypeError):
                wrong()
        assert device.send(1, "123#")
    with cantap.open("virtual", 500_000, channels=np.int64(2)) as device:
        assert list(device.channels) == [2]


def test_numbers_and_times_of_numpy_and_pandas_are_taken(log):
    pandas = pytest.importorskip("pandas")
    times = cantap.read(log).to_numpy()["time"]
    assert cantap.read(log, channel=np.uint8(1)).num_rows == 3
    assert cantap.read(log, channel=np.array([1, 2])).num_rows == 3
    assert len(cantap.stats(log, np.int64(500_000))["channels"]) == 1
    # The start is part of it, the end is not: exact to the nanosecond.
    for second in (times[1], pandas.Timestamp(times[1], tz="UTC"), np.timedelta64(10, "ms"), pandas.Timedelta("10ms")):
        assert first_data(cantap.read(log, start=second)) == [1, 2], second
        assert first_data(cantap.read(log, end=second)) == [0], second
    for late in (np.float32(0.015), datetime.timedelta(milliseconds=15)):
        assert first_data(cantap.read(log, start=late)) == [2], late


def test_a_date_may_be_without_a_time_and_early(log, tmp_path):
    for day in ("2023-11-14", datetime.date(2023, 11, 14)):
        assert cantap.read(log, start=day).num_rows == 3
        assert cantap.read(log, end=day).num_rows == 0
    old = trace(tmp_path / "old.csv", 10**18 // 2)
    # 1985-11-05 00:53:20: as a number of seconds it would count from the first record.
    begin = datetime.datetime(1985, 11, 5, 0, 53, 20, tzinfo=datetime.timezone.utc)
    assert first_data(cantap.read(old, start=begin + datetime.timedelta(milliseconds=10))) == [1, 2]


def test_a_condition_that_is_too_long_is_not_repeated_in_full(log):
    with pytest.raises(ValueError) as caught:
        cantap.search(log, "id == 1 or " * 1000 + "id == 1")
    assert len(str(caught.value)) < 200


def test_parquet_is_read_as_any_trace(log, tmp_path):
    path = tmp_path / "drive.parquet"
    cantap.write(cantap.read(log), path)
    assert pa.table(cantap.read(path)) == pa.table(cantap.read(log))


DBC = """\
VERSION ""
BU_: A
BO_ 291 Engine: 1 A
 SG_ {name} : 0|8@1+ (1,0) [0|255] "" A
"""


@pytest.fixture
def two_channels(tmp_path):
    """A trace that counts its channels from 0, and a database for each of them."""
    log = tmp_path / "two.log"
    log.write_text("".join(f"(0.{at:06}) {('channel0', 'can0')[at % 2]} 123#{at:02X}\n" for at in range(20)))
    databases = [tmp_path / "first.dbc", tmp_path / "second.dbc", tmp_path / "third.dbc"]
    for database, name in zip(databases, ("First", "Second", "Third")):
        database.write_text(DBC.format(name=name))
    return log, databases


def test_what_is_no_name_of_a_database_is_told_what_would_be(log, tmp_path):
    path = tmp_path / "car.dbc"
    path.write_text(DBC.format(name="Engine"))
    words = "a database is the name of a file, several of them, or a mapping from channels to names, not "
    loaded = cantools.database.load_file(path)
    with open(path) as text, open(path, "rb") as binary:
        for wrong, said in [
            (text, words + "TextIOWrapper"), (binary, words + "BufferedReader"), ([binary], words + "BufferedReader"), (5, words + "int"),
            (loaded, words + "Database of cantools; give the file that it was loaded from"), ({1: loaded}, words + "Database of cantools"),
            ([cantap.load_database(path)], "a loaded database is given alone"),
        ]:  # fmt: skip
            for call in (lambda: cantap.read(log, db=wrong), lambda: cantap.decode(log, wrong), lambda: cantap.load_database(wrong)):
                with pytest.raises(TypeError) as caught:
                    call()
                assert str(caught.value).startswith(said)
    messages = cantap.decode(log, path)
    for call in (lambda: cantap.write(messages, tmp_path / "made.log"), lambda: cantap.decode(messages, path)):
        with pytest.raises(TypeError, match="these are decoded signals: cantap.encode"):
            call()
    assert not (tmp_path / "made.log").exists()


@pytest.mark.filterwarnings("error")
def test_channels_are_what_the_trace_calls_them(two_channels, tmp_path):
    log, (first, second, _) = two_channels
    table = cantap.read(log)
    assert set(table.to_numpy()["channel"]) == {0, 1} and table.report.channels == [0, 1]
    assert set(cantap.read(log, channel=0).to_numpy()["channel"]) == {0}
    assert len(cantap.read(log, channel=[0, 1])) == 20
    both = {0: first, 1: second}
    assert cantap.decode(log, both).report.decoded == 20
    signals = cantap.read(log, db=both).to_pyarrow().select(["channel", "signal"]).to_pylist()
    assert {(row["channel"], row["signal"]) for row in signals} == {(0, "First"), (1, "Second")}
    assert len(cantap.search(log, "First > 4 or Second > 4", db=both)) == 15
    assert {name for one in cantap.decode(table, both).values() for name in one.column_names[3:]} == {"First", "Second"}
    assert {channel["channel"] for channel in cantap.stats(log, {0: 500_000, 1: 500_000})["channels"]} == {0, 1}
    # And back into a trace.
    cantap.write(table, tmp_path / "again.log")
    assert cantap.read(tmp_path / "again.log").to_pyarrow() == table.to_pyarrow()


def test_a_channel_that_the_trace_does_not_have_is_named_in_a_warning(two_channels):
    log, (first, second, third) = two_channels
    missing = {1: first, 2: second}
    with pytest.warns(cantap.CantapWarning, match="two.log: db= names channel 2, which it does not have; it has 0 and 1"):
        assert cantap.decode(log, missing).report.decoded == 10
    with pytest.warns(cantap.CantapWarning, match="db= names channel 2, "):
        cantap.read(log, db=missing)
    with pytest.warns(cantap.CantapWarning, match="the table: db= names channel 2, "):
        cantap.decode(cantap.read(log), missing)
    with pytest.warns(cantap.CantapWarning, match="db= names channels 2 and 3, "):
        cantap.search(log, "First > 3", db={1: first, 2: second, 3: third})
    with pytest.warns(cantap.CantapWarning, match="channel= names channel 7, "):
        assert len(cantap.read(log, channel=[0, 7])) == 10
    with pytest.warns(cantap.CantapWarning, match="bitrate= names channel 2, "):
        cantap.stats(log, {2: 500_000})
