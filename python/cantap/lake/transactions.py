"""Changes of several entries of a ledger at once, and who may write to a lake at the same time.

A transaction says which file has an entry's rows from now on. It counts from the moment when its file is there; only then are the entries
themselves changed, and whoever reads an entry meanwhile applies it. A process that is killed in between leaves that to the next one that writes.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .names import are_own, is_content, is_own

try:
    import fcntl
except ModuleNotFoundError:  # Windows has no locks that several readers share.
    fcntl = None  # type: ignore[assignment]

#: By content: the file that had its rows, and those that have them, with how many.
Moves = Mapping[str, Mapping[str, Mapping[str, int]]]


class Busy(Exception):
    """Another process is at work on the lake."""


class Transactions:
    """The last transaction of a lake, and its locks, which the system releases when a process ends in whatever way."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / "moves.json"

    @contextmanager
    def writing(self) -> Iterator[None]:
        """While entries are changed: one process and thread at a time, for moments."""
        with _locked(self._folder / ".commit.lock"):
            yield

    @contextmanager
    def run(self) -> Iterator[None]:
        """While traces are added or files joined: nobody removes files meanwhile."""
        with _locked(self._folder / ".run.lock", shared=True):
            yield

    @contextmanager
    def alone(self) -> Iterator[None]:
        """While files are removed: raises `Busy` if anybody adds traces or joins files."""
        try:
            with _locked(self._folder / ".run.lock", waits=False):
                yield
        except BlockingIOError:
            raise Busy(f"{self._folder}: traces are being added or files joined; try again when that is done") from None

    def last(self) -> dict[str, Any]:
        """The last one: its `number`, its `moves`, and whether it is `done`."""
        try:
            last = json.loads(self._path.read_bytes())
        except FileNotFoundError:
            return {"number": 0, "moves": {}, "done": True}
        is_last = isinstance(last, dict) and {"number", "moves", "done"} <= set(last) and isinstance(last["moves"], dict)
        if not is_last or not all(_is_move(sha256, files) for sha256, files in last["moves"].items()):
            raise ValueError(f"{self._path} is damaged, or names files outside of the lake; nothing is read or written by it")
        return dict(last)

    def begin(self, moves: Moves) -> dict[str, Any]:
        """Makes a transaction count. Only with the lock, and when the last one is done."""
        last = {"number": self.last()["number"] + 1, "moves": moves, "done": False}
        write_whole(self._path, json.dumps(last).encode())
        return dict(last)

    def end(self, last: dict[str, Any]) -> None:
        """All entries are as it says."""
        write_whole(self._path, json.dumps({**last, "moves": {}, "done": True}).encode())


def _is_move(sha256: Any, files: Any) -> bool:
    return is_content(sha256) and isinstance(files, dict) and all(is_own(name) and are_own(new) for name, new in files.items())


def moved(entry: dict[str, Any], moves: Moves) -> dict[str, Any]:
    """An entry as a transaction has it."""
    of_entry = moves.get(entry["sha256"])
    if not of_entry:
        return entry
    files: dict[str, dict[str, int]] = {}
    for table, named in entry["files"].items():
        for name, rows in named.items():
            for new, moved_rows in of_entry.get(name, {name: rows}).items():
                of_table = files.setdefault(table, {})
                of_table[new] = of_table.get(new, 0) + moved_rows
    return {**entry, "files": files}


@contextmanager
def _locked(path: Path, *, shared: bool = False, waits: bool = True) -> Iterator[None]:
    if fcntl is None:
        raise OSError("a lake is written to on Linux and macOS only: this system has no locks for it; it can be read here")
    with open(path, "ab") as file:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if waits else fcntl.LOCK_NB))
        yield


def write_whole(path: Path, content: bytes) -> None:
    """A file is there with all of its content, or as it was before."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
