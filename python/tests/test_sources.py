"""Where traces come from: patterns, folders, lists, open files, URLs."""

import gzip
import io
import pickle

import pyarrow as pa
import pytest

import cantap

DBC = 'VERSION ""\nBU_: ECU\nBO_ 291 Engine: 8 ECU\n SG_ Speed : 0|8@1+ (0.5,0) [0|100] "km/h" ECU\n'


@pytest.fixture
def folder(tmp_path):
    drives = tmp_path / "drives"
    drives.mkdir()
    for number in (1, 2, 10):
        (drives / f"{number}.log").write_text("".join(f"({number * 100 + at}.000000) can0 123#{number:02X}\n" for at in range(3)))
    (drives / "car.dbc").write_text(DBC)
    return drives


def numbers(table):
    return [data[0] for data in pa.table(table).column("data").to_pylist()]


def test_several_files_are_one_trace_in_the_order_of_their_names(folder):
    for source in (str(folder), folder, str(folder / "*.log"), [folder / f"{number}.log" for number in (1, 2, 10)]):
        table = cantap.read(source)
        assert numbers(table) == [1, 1, 1, 2, 2, 2, 10, 10, 10]
        assert table.report.frames == 9 and table.report.is_whole
        assert [(report.file[-6:].strip("/"), report.frames) for report in table.report.files] == [("1.log", 3), ("2.log", 3), ("10.log", 3)]
    for source in ([folder / "1.log"], folder.glob("1.log"), [open(folder / "1.log", "rb")]):
        assert list(cantap.decode(source, folder / "car.dbc")["Engine"]["Speed"]) == [0.5] * 3
    assert numbers(cantap.read([folder / "10.log", folder / "1.log"])) == [10, 10, 10, 1, 1, 1]
    assert pickle.loads(pickle.dumps(cantap.read(folder).report)).files[1].frames == 3


def test_decoding_and_statistics_take_them_too(folder):
    drive = cantap.decode(folder, folder / "car.dbc")
    assert list(drive["Engine"]["Speed"]) == [0.5] * 3 + [1.0] * 3 + [5.0] * 3
    assert [report.decoded for report in drive.report.files] == [3, 3, 3] and drive.report.decoded == 9
    assert "Engin" not in drive and drive.get("Engin") is None
    with pytest.raises(KeyError, match="'Engin' was decoded; there are Engine"):
        drive["Engin"]
    with cantap.scan(folder, db=folder / "car.dbc", batch_rows=2) as scan:
        assert sum(len(table) for table in scan) == 9
    assert [report.decoded for report in scan.report.files] == [3, 3, 3]
    assert cantap.stats(folder, 500_000)["channels"][0]["frames"] == 9
    assert len(cantap.search(folder, id="123")) == 9


def test_a_relative_time_counts_from_the_first_of_all_records(folder):
    assert numbers(cantap.read(folder, start=101, end=902)) == [2, 2, 10, 10]


def test_what_is_no_trace_in_a_folder_is_said(folder):
    (folder / "notes.docx").write_bytes(b"PK")
    (folder / ".hidden").write_bytes(b"x")
    for call in (lambda: cantap.read(folder), lambda: cantap.read([folder]), lambda: cantap.dataset(folder).to_table()):
        with pytest.warns(cantap.CantapWarning, match="1 file without the name of a trace was left out: notes.docx") as said:
            assert len(call()) == 9
        # Once, and of the program's own line.
        assert [warning.filename for warning in said] == [__file__]


def test_a_trace_without_a_record_is_said(folder):
    empty = folder / "3.log"
    empty.write_bytes(b"")
    for call in (lambda: cantap.read(empty), lambda: cantap.decode(empty, folder / "car.dbc"), lambda: cantap.stats(folder), lambda: cantap.read(folder)):
        with pytest.warns(cantap.CantapWarning, match="3.log: it has no record"):
            call()
    (folder / "4.log").write_bytes(b"")
    with pytest.warns(cantap.CantapWarning, match="3.log, and 1 more: they have no record"):
        assert len(cantap.read(folder)) == 9


@pytest.mark.filterwarnings("error")
def test_nothing_is_said_of_a_trace_of_which_nothing_was_chosen(folder):
    for chosen in ({"filter": "7FF"}, {"start": "1h"}, {"end": "1971-01-01", "start": "1970-06-01"}, {"start": 5, "end": 6}):
        assert len(cantap.read(folder / "1.log", **chosen)) == 0


def test_a_parquet_file_of_something_else_says_what_it_should_have(folder, tmp_path):
    decoded = tmp_path / "engine.parquet"
    cantap.decode(folder / "1.log", folder / "car.dbc")["Engine"].to_polars().write_parquet(decoded)
    with pytest.raises(cantap.FormatError, match="whose columns are not those of a trace, such as time, id and data"):
        cantap.read(decoded)


def test_a_missing_file_among_several_is_named(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="none.log"):
        cantap.read([folder / "1.log", folder / "none.log"])
    with pytest.raises(FileNotFoundError, match=r"no file is called like .*\*\.mf4"):
        cantap.read(str(folder / "*.mf4"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="no file with the name of a trace"):
        cantap.read(tmp_path / "empty")
    for wrong in ([], 5, b"a.log", [[folder]], {folder: 1}, [None]):
        with pytest.raises((TypeError, ValueError)):
            cantap.read(wrong)


def test_a_damaged_file_among_several_is_counted_once(folder):
    with open(folder / "2.log", "a") as file:
        file.write("nonsense\n")
    with pytest.warns(cantap.CantapWarning, match="2.log"):
        report = cantap.read(folder).report
    assert report.issues == 1 and not report.is_whole and [part.is_whole for part in report.files] == [True, False, True]


def test_a_file_of_which_nothing_can_be_read_is_named(folder):
    (folder / "5.mf4").write_bytes(b"MDF     4.10    " + bytes(500))
    with pytest.raises(cantap.FormatError, match="5.mf4"):
        cantap.read(folder)


def test_an_open_file_is_read_and_stays_open(folder, tmp_path):
    with open(folder / "1.log", "rb") as file:
        assert len(cantap.read(file)) == 3
        assert not file.closed
    packed = io.BytesIO(gzip.compress((folder / "1.log").read_bytes()))
    assert len(cantap.read(packed)) == 3
    for suffix in ("blf", "mf4", "asc"):
        cantap.write(cantap.read(folder), tmp_path / f"a.{suffix}")
        with open(tmp_path / f"a.{suffix}", "rb") as file:
            assert len(cantap.decode(file, folder / "car.dbc")["Engine"]) == 9


class Broken(io.RawIOBase):
    """A file of which the system stops delivering."""

    def __init__(self, text, error):
        self.parts = [text, error]

    def read(self, size=-1):
        part = self.parts.pop(0)
        if isinstance(part, BaseException):
            raise part
        return part


@pytest.mark.parametrize("error", [TimeoutError("the net is down"), KeyboardInterrupt()])
@pytest.mark.parametrize("call", [cantap.read, lambda file: cantap.decode(file, {1: "none"}), cantap.stats])
def test_an_error_of_a_file_object_is_the_programs_own(folder, error, call):
    file = Broken(b"(1.0) can0 123#01\n" * 10_000, error)
    if call not in (cantap.read, cantap.stats):
        call = lambda file: cantap.decode(file, folder / "car.dbc")
    with pytest.raises(type(error)):
        call(file)


def test_a_text_file_is_refused_with_advice(folder):
    with open(folder / "1.log") as file, pytest.raises(TypeError, match="rb"):
        cantap.read(file)


def test_a_decode_that_is_given_up_does_not_hang(folder):
    """The thread that reads wants Python while the caller waits for its end."""
    reading = cantap._native.Reading({"files": [("a.log", lambda: open(folder / "1.log", "rb"))] * 200, "db": None, "signals": [], "filters": [], "channels": [], "start": None, "end": None, "format": None, "zone": None, "strict": False})
    del reading


def test_urls_are_read_through_fsspec(folder):
    fsspec = pytest.importorskip("fsspec", reason="pip install fsspec")
    memory = fsspec.filesystem("memory")
    for number in (1, 2, 10):
        memory.pipe(f"/fleet/{number}.log", (folder / f"{number}.log").read_bytes())
    for source in ("memory://fleet/*.log", "memory://fleet"):
        table = cantap.read(source)
        assert numbers(table) == [1, 1, 1, 2, 2, 2, 10, 10, 10]
        assert table.report.files[0].file == "memory:///fleet/1.log"
    assert len(cantap.read(fsspec.open("memory://fleet/1.log", "rb"))) == 3
    opened = fsspec.open_files("memory://fleet/*.log", "rb")
    assert len(cantap.decode(opened, folder / "car.dbc")["Engine"]) == 9
    with pytest.raises(FileNotFoundError):
        cantap.read("memory://fleet/none.log")


def test_what_an_mf4_file_says_about_its_measurement_is_kept(folder, tmp_path):
    asammdf = pytest.importorskip("asammdf")
    cantap.write(cantap.read(folder / "1.log"), tmp_path / "a.mf4")
    assert cantap.read(tmp_path / "a.mf4").report.properties["tool_id"] == "cantap"
    with asammdf.MDF(tmp_path / "a.mf4") as mdf:
        mdf.header.author = "A. Driver"
        mdf.header.project = "Winter & snow"
        mdf.save(tmp_path / "b.mf4")
    properties = cantap.read(tmp_path / "b.mf4").report.properties
    assert properties["author"] == "A. Driver" and properties["project"] == "Winter & snow"
    assert cantap.read(folder / "1.log").report.properties == {}
