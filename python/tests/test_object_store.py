"""Traces in an object store, whose names may be anything."""

import pytest

pa = pytest.importorskip("pyarrow")
server = pytest.importorskip("moto.server", reason="pip install 'moto[server]' s3fs")
s3fs = pytest.importorskip("s3fs", reason="pip install 'moto[server]' s3fs")
import fsspec.config

import cantap
from cantap.lake import Store, ingest
from cantap.lake.inputs import traces

#: Not listed: `..` and hidden ones, as in a folder of a disk, and what stands for an empty folder.
STRANGE = [
    "a b/x y.log", "v/%2F.log", "v/a%2Fb.log", "ü/Größe²²2.log", "²/1²3.log", "v/[1].log", "v/a?b.log", "v/a*b.log", "v/../w.log", "日本/測定.log",
    "v/" + "n" * 300 + ".log", "plus+/a+b&c=d.log", "v//double.log", "v/q#h.log", "v/'; drop table.log", "v/no suffix", "v/tab\t.log",
]
HIDDEN = ["v/.hidden.log", "x/..", "empty/"]


def frame(number):
    return f"({1_772_409_590 + number}.000000) can0 123#{number:04X}\n".encode()


@pytest.fixture(scope="module")
def store():
    """A bucket, by its own process's memory: what puts an object there."""
    from moto.s3.models import s3_backends

    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    running.start()
    host, port = running.get_host_and_port()
    fsspec.config.conf["s3"] = {"endpoint_url": f"http://{host}:{port}", "key": "none", "secret": "none"}
    bucket = s3_backends["123456789012"]["aws"]
    bucket.create_bucket("odd", "us-east-1")
    try:
        yield bucket
    finally:
        fsspec.config.conf.pop("s3", None)
        running.stop()
        s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def odd(store):
    for key in [key for bucket in [store.buckets["odd"]] for key in list(bucket.keys)]:
        store.delete_object("odd", key)
    s3fs.S3FileSystem.clear_instance_cache()
    return lambda key, content: store.put_object("odd", key, content)


def test_each_name_is_a_trace_and_none_another_ones(odd, tmp_path):
    for number, key in enumerate(STRANGE + HIDDEN):
        odd(key, b"" if key.endswith("/") else frame(number))
    summary = ingest("s3://odd", tmp_path / "lake", workers=2)
    assert dict(summary.states) == {"read": len(STRANGE)}, summary.problems
    rows = Store(tmp_path / "lake").dataset("frames").to_table().to_pylist()
    assert {row["trace"]: row["data"][1] for row in rows} == {f"s3://odd/{key}": number for number, key in enumerate(STRANGE)}
    # A trace's vehicle is its first folder.
    assert {row["vehicle"] for row in rows if "/v/" in row["trace"]} == {"v"} and list(Store(tmp_path / "lake").problems()) == []


def test_one_of_them_is_read_by_its_name(odd):
    names = [key for key in STRANGE if "." in key.rsplit("/")[-1]]
    for number, key in enumerate(names):
        odd(key, frame(number))
    for number, key in enumerate(names):
        assert [row.data[1] for row in cantap.read(f"s3://odd/{key}")] == [number], key
    assert len(cantap.read("s3://odd/v/*.log")) == len([key for key in names if key.startswith("v/") and key.count("/") == 1])
    with pytest.raises(FileNotFoundError, match="none"):
        cantap.read("s3://odd/none*.log")


def test_ten_thousand_names_are_listed(odd):
    for number in range(10_000):
        odd(f"many/{number % 7}/{number}.log", b"x")
    for source in ("s3://odd/many", "s3://odd/many/*/*.log"):
        found = traces([source])
        assert len(found) == len({trace.name for trace in found}) == 10_000
    assert {trace.vehicle for trace in found} == {str(number) for number in range(7)}


def test_what_has_come_since_the_last_listing_is_listed(odd):
    odd("a/0.log", frame(0))
    for number in range(1, 4):
        for source in ("s3://odd", "s3://odd/a", "s3://odd/*/*.log"):
            assert len(traces([source])) == number
        odd(f"a/{number}.log", frame(number))
        odd("later/.keep", b"")
    odd("later/0.log", frame(9))
    assert len(traces(["s3://odd/later"])) == 1


def test_what_vanishes_between_listing_and_reading_is_said(odd, store, tmp_path, monkeypatch):
    for number in range(3):
        odd(f"v/{number}.log", frame(number))
    # What is gone may have been a folder's name, too.
    odd("v/2.log/below.log", frame(3))
    from cantap.lake import inputs

    fetch = inputs.Trace.fetch

    def late(trace, folder):
        if trace.name.endswith(("/1.log", "/2.log")):
            store.delete_object("odd", trace.name.removeprefix("s3://odd/"))
        return fetch(trace, folder)

    monkeypatch.setattr(inputs.Trace, "fetch", late)
    summary = ingest("s3://odd", tmp_path / "lake", workers=1)
    assert dict(summary.states) == {"read": 2, "failed": 2}
    assert all("does not exist" in summary.problems[f"s3://odd/v/{number}.log"] for number in (1, 2))
    # Nothing of it is in the ledger: it is tried again if it comes back.
    odd("v/1.log", frame(1))
    monkeypatch.undo()
    assert dict(ingest("s3://odd", tmp_path / "lake").states) == {"known": 2, "read": 1}


def test_one_of_several_that_is_gone_ends_the_reading(odd, store):
    for number in range(2):
        odd(f"v/{number}.log", frame(number))
    scan = cantap.scan("s3://odd/v/*.log", batch_rows=1)
    store.delete_object("odd", "v/1.log")
    with pytest.raises(OSError):
        for _ in scan:
            pass


#: Each of the names with content is a trace, though another one begins with it and a slash.
BOTH = ["a", "a/b.log", "v/c.log", "v/c.log/d.log", "v/c.log/d.log/e", "w/f", "w/f/g/h.log"]


def test_a_name_that_others_begin_with_is_a_trace_of_its_own(odd, tmp_path):
    for number, key in enumerate(BOTH):
        odd(key, frame(number))
    # Markers of folders, as different programs make them.
    odd("v/", b"")
    odd("w", b"")
    found = {f"s3://odd/{key}": number for number, key in enumerate(BOTH)}
    for source, below in (("s3://odd", ""), ("s3://odd/v", "v/"), ("s3://odd/w", "w/"), ("s3://odd/v/c.log", "v/c.log"), ("s3://odd/a", "a")):
        lake = tmp_path / f"lake {below.replace('/', '-')}"
        wanted = {name: number for name, number in found.items() if name.startswith(f"s3://odd/{below}")}
        summary = ingest(source, lake, workers=2)
        assert dict(summary.states) == {"read": len(wanted)}, (source, summary.problems)
        rows = Store(lake).dataset("frames").to_table().to_pylist()
        assert {row["trace"]: row["data"][1] for row in rows} == wanted, source


def test_a_name_that_others_begin_with_is_read_by_itself_by_a_pattern_and_with_its_folder(odd):
    for number, key in enumerate(BOTH):
        odd(key, frame(number))
    read = lambda source: [row.data[1] for row in cantap.read(source)]
    assert read("s3://odd/v/c.log") == [2, 3] and read(["s3://odd/v/c.log/d.log/e"]) == [4]
    # Also after a listing, which says of it that it is a folder.
    for _ in range(2):
        assert read("s3://odd/*/c.*") == [2] and read("s3://odd/?/f") == [5] and read("s3://odd/v/**/*.log") == [2, 3]
        assert read("s3://odd/v") == [2] and read("s3://odd/w/f") == [5]


def test_what_is_empty_and_what_cannot_be_opened_by_its_name_is_accounted_for(odd, tmp_path):
    odd("v/empty.log", b"")
    odd("v/folder/", b"")
    odd("v/content.log/", frame(1))
    odd("v/full/", frame(2))
    odd("v/full/1.log", frame(3))
    summary = ingest("s3://odd", tmp_path / "lake", workers=1)
    assert dict(summary.states) == {"empty": 1, "read": 1, "failed": 2}
    assert all("ends like a folder's" in summary.problems[f"s3://odd/v/{name}/"] for name in ("content.log", "full"))
    with pytest.warns(cantap.CantapWarning, match="full/"):
        assert [row.data[1] for row in cantap.read("s3://odd/v/full")] == [3]
    assert len(cantap.read("s3://odd/v/empty.log")) == 0


def test_what_has_grown_since_it_was_listed_is_read_to_its_end(odd, tmp_path, monkeypatch):
    odd("v/0.log", frame(0))
    from cantap.lake import inputs

    fetch = inputs.Trace.fetch

    def late(trace, folder):
        odd("v/0.log", frame(0) + frame(1))
        return fetch(trace, folder)

    monkeypatch.setattr(inputs.Trace, "fetch", late)
    ingest("s3://odd", tmp_path / "lake", workers=1)
    assert len(Store(tmp_path / "lake").dataset("frames").to_table()) == 2
