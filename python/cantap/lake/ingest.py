"""Reads traces into a lake: each content once, several at a time, each in a process of its own."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .inputs import Fetched, Trace, traces
from .isolation import Failed, Process
from .ledger import FAILED, REFUSED, Entry
from .splitting import default_part_bytes, divide, together
from .store import Store, stem_of

if TYPE_CHECKING:
    from .decoding import Part, Request

#: The state of a trace whose content is in the lake under another name, or was before.
DUPLICATE = "duplicate"
KNOWN = "known"


@dataclass
class Summary:
    """What became of the traces of a run."""

    states: Counter[str] = field(default_factory=Counter)
    """How many are `read`, `cut`, `damaged`, `empty`, `undecoded`, `refused`, `failed`; `known` from an earlier run, or a `duplicate` in this one."""
    problems: dict[str, str] = field(default_factory=dict)
    """By trace, in words."""
    records: int = 0
    """Rows of frames that were added."""


@dataclass(frozen=True)
class Settings:
    """What is the same for all traces."""

    databases: tuple[tuple[int | None, str], ...]
    j1939: bool
    signals: tuple[str, ...]
    zone: str | None
    timeout_s: float

    def to_dict(self) -> dict[str, Any]:
        """What rows depend on: databases by their content."""
        digests = [(channel, hashlib.sha256(Path(path).read_bytes()).hexdigest()) for channel, path in self.databases]
        return {"databases": [list(pair) for pair in digests], "j1939": self.j1939, "signals": list(self.signals), "zone": self.zone}


def ingest(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    *,
    db: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | Mapping[int, str | os.PathLike[str]] | None = None,
    j1939: bool = False,
    signals: Iterable[str] = (),
    vehicle: str | None = None,
    zone: str | None = None,
    workers: int | None = None,
    timeout: float = 3600.0,
    retry: bool = False,
    part_bytes: int | None = None,
    done: Callable[[str, str], None] | None = None,
) -> Summary:
    """Reads traces into a lake, which is made if it is not there. Those whose content is in it already are not read again.

    `sources`: files, patterns, folders with everything below them, URLs of fsspec. `db`: as for `cantap.read`. `retry`: traces that failed
    before are tried again in any case; with `retry` also those that were refused. `part_bytes`: the length of the parts in which several workers read
    one large trace of this machine; 0: none is divided. `done`: called with each trace and its state.
    """
    names = [sources] if isinstance(sources, (str, os.PathLike)) else list(sources)
    settings = Settings(_pairs(db), j1939, tuple(signals), zone, timeout)
    setup = settings.to_dict()
    store = Store(folder)
    found = traces([os.fspath(name) for name in names], vehicle)
    store.create()
    run = _Run(store, settings, setup, retry, done)
    workers = workers or os.cpu_count() or 1
    pool = ThreadPoolExecutor(workers)
    divided = Divided(pool, workers, part_bytes)
    with store.transactions.run():
        try:
            wanted = [trace for trace in found if not _is_inside(trace, store)]
            large = [trace for trace in wanted if divided.takes(trace)]
            list(pool.map(run.read, [trace for trace in wanted if trace not in large]))
            for trace in large:
                run.read(trace, divided)
        finally:
            # Ctrl-C does not wait for what has not begun.
            pool.shutdown(cancel_futures=True)
            run.close()
    return run.summary


class Divided:
    """Large traces, which all workers read together."""

    def __init__(self, pool: ThreadPoolExecutor, workers: int, part_bytes: int | None) -> None:
        self.pool, self._workers, self._part_bytes = pool, workers, part_bytes

    def part_bytes(self, size: int) -> int:
        """How long the parts of a trace of this length are."""
        return self._part_bytes or default_part_bytes(size, self._workers)

    def takes(self, trace: Trace) -> bool:
        """Whether it may be divided."""
        if self._workers == 1 or self._part_bytes == 0 or not isinstance(trace.source, str):
            return False
        try:
            size = os.path.getsize(trace.source)
        except OSError:
            return False
        return size >= 2 * self.part_bytes(size)


def _is_inside(trace: Trace, store: Store) -> bool:
    """Whether it is one of the lake's own files: the lake may be in the folder that has the traces."""
    return isinstance(trace.source, str) and Path(trace.source).resolve().is_relative_to(store.folder.resolve())


def _pairs(db: Any) -> tuple[tuple[int | None, str], ...]:
    if db is None:
        return ()
    if isinstance(db, (str, os.PathLike)):
        return ((None, os.fspath(db)),)
    if isinstance(db, Mapping):
        return tuple((channel, os.fspath(path)) for channel, path in db.items())
    return tuple((None, os.fspath(path)) for path in db)


class _Run:
    """The state of a run that its threads share."""

    def __init__(self, store: Store, settings: Settings, setup: dict[str, Any], retry: bool, done: Callable[[str, str], None] | None) -> None:
        self._store, self._settings, self._setup, self._retry, self._done = store, settings, setup, retry, done
        self._lock = threading.Lock()
        #: Contents that a thread has begun with, each with all of its names in this run.
        self._names: dict[str, set[str]] = {}
        self._places: list[_Workplace] = []
        self._of_thread = threading.local()
        self.summary = Summary()

    def close(self) -> None:
        for place in self._places:
            place.close()
        for sha256, names in self._names.items():
            self._store.add_names(sha256, names)

    def read(self, trace: Trace, divided: Divided | None = None) -> None:
        """Reads a trace, unless its content is known."""
        try:
            fetched = trace.fetch(self._place().folder)
        except OSError as error:
            # There is no content by which it would be known: the next run tries again.
            self._count(trace, FAILED, str(error), 0)
            return
        try:
            self._read(trace, fetched, divided)
        finally:
            fetched.discard()

    def _read(self, trace: Trace, fetched: Fetched, divided: Divided | None) -> None:
        with self._lock:
            is_first = fetched.sha256 not in self._names
            self._names.setdefault(fetched.sha256, set()).add(trace.name)
        if not is_first:
            self._count(trace, DUPLICATE, None, 0)
            return
        before = self._store.entry(fetched.sha256)
        if before is not None and before["setup"] == self._setup and not self._is_to_be_tried_again(before["state"]):
            self._count(trace, KNOWN, None, 0)
            return
        stem = stem_of(fetched.sha256, self._setup)
        staged = self._store.staging()
        try:
            answer = self._in_parts(trace, fetched, stem, staged, divided) if divided else None
            if answer is None:
                place = self._place()
                answer, staged_in = place.decode(trace, fetched, stem), place.written
            else:
                staged_in = staged
            self._keep(trace, fetched, before, answer, staged_in)
        finally:
            shutil.rmtree(staged, ignore_errors=True)

    def _keep(self, trace: Trace, fetched: Fetched, before: dict[str, Any] | None, answer: dict[str, Any], staged: Path) -> None:
        """Puts what came of a trace into the lake."""
        if not fetched.is_unchanged():
            with self._lock:
                del self._names[fetched.sha256]
            self._count(trace, FAILED, "it changed while it was read", 0)
            return
        names = {trace.name, *(before["names"] if before else ())}
        entry = {**answer, "sha256": fetched.sha256, "names": sorted(names), "setup": self._setup}
        self._store.put({"files": {}, **entry}, staged)
        self._count(trace, answer["state"], answer["problem"], answer["records"])

    def _in_parts(self, trace: Trace, fetched: Fetched, stem: str, staged: Path, divided: Divided) -> dict[str, Any] | None:
        """The entry of a large trace, whose rows are then in files below `staged`; `None` if it is to be read as one."""
        part_bytes = divided.part_bytes(fetched.bytes)
        if (found := divide(fetched.path, part_bytes)) is not None:
            of_file: list[Part] = [
                {"format": found.format, "pieces": list(pieces), "window": (None, None), "indexes": None, "first_rows": None} for pieces in found.parts
            ]
            if (entry := self._of_parts(trace, fetched, stem, staged, divided, of_file, None)) is not None:
                return entry
        indexes = staged / "indexes"
        windows = self._place().divide(trace, fetched, part_bytes, indexes)
        if windows is None:
            return None
        by_time: list[Part] = [
            {"format": None, "pieces": None, "window": (start_ns, end_ns), "indexes": str(indexes), "first_rows": None} for start_ns, end_ns, _ in windows
        ]
        return self._of_parts(trace, fetched, stem, staged, divided, by_time, [records for _, _, records in windows])

    def _of_parts(
        self, trace: Trace, fetched: Fetched, stem: str, staged: Path, divided: Divided, parts: list[Part], records: list[int] | None
    ) -> dict[str, Any] | None:
        """The same of these parts; `records`: how many each has, if it was divided by time.

        All rows are counted first: a row has its number, which depends on the parts before.
        """

        def read(number: int, first_rows: tuple[int, int] | None) -> dict[str, Any]:
            place = self._place()
            answer = place.decode(trace, fetched, f"{stem}.{number:04}", {**parts[number], "first_rows": first_rows})
            for files in answer.get("files", {}).values():
                for name in files:
                    (staged / name).parent.mkdir(parents=True, exist_ok=True)
                    os.replace(place.written / name, staged / name)
            return answer

        numbers = range(len(parts))
        counts = [Entry(**answer) for answer in divided.pool.map(read, numbers, [None for _ in numbers])]
        whole = together(counts, is_by_time=records is not None)
        if whole is None or records not in (None, [entry.records for entry in counts]):
            return None
        first_rows = [(0, 0)]
        for entry in counts:
            first_rows.append((first_rows[-1][0] + entry.records, first_rows[-1][1] + entry.signal_rows))
        files: dict[str, dict[str, int]] = {}
        for entry, answer in zip(counts, divided.pool.map(read, numbers, first_rows[:-1]), strict=True):
            for table, named in answer.pop("files", {}).items():
                files.setdefault(table, {}).update(named)
            if answer != entry.to_dict():
                return None
        return {**whole.to_dict(), "files": files}

    def _is_to_be_tried_again(self, state: str) -> bool:
        return state == FAILED or (self._retry and state == REFUSED)

    def _count(self, trace: Trace, state: str, problem: str | None, records: int) -> None:
        with self._lock:
            self.summary.states[state] += 1
            self.summary.records += records
            if problem:
                self.summary.problems[trace.name] = problem
            if self._done is not None:
                self._done(trace.name, state)

    def _place(self) -> _Workplace:
        if not hasattr(self._of_thread, "place"):
            self._of_thread.place = _Workplace(self._settings, self._store)
            with self._lock:
                self._places.append(self._of_thread.place)
        place: _Workplace = self._of_thread.place
        return place


class _Workplace:
    """A thread's folder, and the process that decodes for it."""

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        #: For copies of traces.
        self.folder = Path(tempfile.mkdtemp(prefix="cantap-lake-"))
        #: For rows until their trace is done: in the lake, so that files only get another name.
        self.written = store.staging()
        command = [sys.executable, "-m", "cantap.lake.decoding", str(self.folder), str(self.written)]
        self._process = Process(command, settings.timeout_s)

    def close(self) -> None:
        self._process.__exit__(None, None, None)
        for folder in (self.folder, self.written):
            shutil.rmtree(folder, ignore_errors=True)

    def decode(self, trace: Trace, fetched: Fetched, stem: str, part: Part | None = None) -> dict[str, Any]:
        """The entry of a trace, or of a part of it; its rows are then in files below `written`."""
        # What a process left that was ended.
        shutil.rmtree(self.written, ignore_errors=True)
        self.written.mkdir(parents=True)
        try:
            return self._process.ask(self._request(trace, fetched, stem, part, None))
        except Failed as failed:
            return Entry(trace.name, trace.vehicle, fetched.bytes, state=FAILED, problem=str(failed)).to_dict()

    def divide(self, trace: Trace, fetched: Fetched, part_bytes: int, indexes: Path) -> list[tuple[int | None, int | None, int]] | None:
        """The parts of a trace by time: from, to, records. `None` if it is to be read as one."""
        try:
            answer = self._process.ask(self._request(trace, fetched, "", None, (part_bytes, str(indexes))))
        except Failed:
            return None
        parts = answer["parts"]
        return None if parts is None else [(start_ns, end_ns, records) for start_ns, end_ns, records in parts]

    def _request(self, trace: Trace, fetched: Fetched, stem: str, part: Part | None, divide: tuple[int, str] | None) -> Request:
        return {
            "path": str(fetched.path),
            "trace": trace.name,
            "vehicle": trace.vehicle,
            "bytes": fetched.bytes,
            "databases": list(self._settings.databases),
            "database_names": [path for _, path in self._settings.databases],
            "j1939": self._settings.j1939,
            "signals": list(self._settings.signals),
            "zone": self._settings.zone,
            "rows": str(self.written),
            "stem": stem,
            "part": part,
            "divide": divide,
        }
