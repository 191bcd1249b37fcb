"""What runs on the workers: traces in, rows out."""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import pyarrow as pa
from cantap.lake import columns
from cantap.lake.decoding import Request
from cantap.lake.isolation import Failed, Process
from cantap.lake.ledger import FAILED, REFUSED, Entry


if TYPE_CHECKING:
    from pyspark import Broadcast

#: A trace, as passed to workers. `setup` is JSON: the databases, each with its channel, and whether they are J1939.
TRACES = "url string, trace string, vehicle string, bytes bigint, setup string, content binary"


@dataclass(frozen=True)
class Settings:
    """Settings that are the same for all traces."""

    signals: tuple[str, ...]
    zone: str | None
    timeout_s: float


class _Workplace:
    """A folder for work in progress, and the process that decodes."""

    def __init__(self, settings: Settings, databases: dict[str, bytes]) -> None:
        self._settings = settings
        self._databases = databases
        self._folder = Path(tempfile.mkdtemp(prefix="cantap-fleet-"))
        command = [sys.executable, "-m", "cantap.lake.decoding", str(self._folder)]
        self._process = Process(command, settings.timeout_s)

    def close(self) -> None:
        self._process.__exit__(None, None, None)
        shutil.rmtree(self._folder, ignore_errors=True)

    def decode(self, row: dict[str, Any]) -> Iterator[pa.RecordBatch]:
        """A trace's rows, followed by its entry."""
        trace, vehicle = row["trace"], row["vehicle"]
        rows = self._folder / "rows.arrow"
        try:
            request = self._request(row, rows)
            answer = self._process.ask(request)
            state = answer["state"]
        except Failed as failed:
            state = FAILED
            answer = Entry(trace, vehicle, row["bytes"], state=FAILED, problem=str(failed)).to_dict()
        if state not in (REFUSED, FAILED):
            with pa.memory_map(str(rows)) as file, pa.ipc.open_stream(file) as reader:
                yield from reader
        rows.unlink(missing_ok=True)
        yield columns.entry_of(json.dumps(answer), vehicle, trace)

    def _request(self, row: dict[str, Any], rows: Path) -> Request:
        setup = json.loads(row["setup"])
        return {
            "path": self._local(row),
            "trace": row["trace"],
            "vehicle": row["vehicle"],
            "bytes": row["bytes"],
            "databases": [(channel, self._database(name)) for channel, name in setup["databases"]],
            "database_names": [name for _, name in setup["databases"]],
            "j1939": setup["j1939"],
            "signals": list(self._settings.signals),
            "zone": self._settings.zone,
            "rows": str(rows),
            "stem": None,
            "part": None,
            "divide": None,
        }

    def _local(self, row: dict[str, Any]) -> str:
        """The trace's path for this machine's programs."""
        if (path := local_path(row["url"])) is not None:
            return path
        if row["content"] is None:
            raise Failed("Spark does not hand out files of 2 GiB or more, or whose names begin with _ or .")
        # Keep its name: the suffix determines the format.
        fetched = self._folder / "trace" / PurePosixPath(row["trace"]).name
        shutil.rmtree(fetched.parent, ignore_errors=True)
        fetched.parent.mkdir()
        fetched.write_bytes(row["content"])
        return str(fetched)

    def _database(self, name: str) -> str:
        path = self._folder / "databases" / name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(self._databases[name])
        return str(path)


def local_path(url: str) -> str | None:
    """The path of a file in a file system that every worker has mounted in the same place; `None` for other file systems."""
    if not url.startswith("file:"):
        return None
    path = url.removeprefix("file:")
    return os.path.normpath("/" + path.lstrip("/"))


def decoder(
    settings: Settings, databases: Broadcast[dict[str, bytes]]
) -> Callable[[Iterable[pa.RecordBatch]], Iterable[pa.RecordBatch]]:
    """The function for `mapInArrow`."""

    def decode(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        workplace = _Workplace(settings, databases.value)
        try:
            for batch in batches:
                for row in batch.to_pylist():
                    yield from workplace.decode(row)
        finally:
            workplace.close()

    return decode
