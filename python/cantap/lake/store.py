"""Where a lake's tables are: Parquet files, and the ledger that says which of them belong to it."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import pyarrow as pa
import pyarrow.parquet as pq

from . import columns
from .joined import is_joined, members, part_of
from .names import are_own, is_content
from .transactions import Moves, Transactions, moved, write_whole
from .writing import TABLES

if TYPE_CHECKING:
    import pyarrow.dataset

#: In the second, files may be joined: who does not know that would see their rows several times.
FORMAT, FORMAT_JOINED = 1, 2
_STAGING = ".writing"
DELTA_LOG = "_delta_log"


class StoreError(Exception):
    """The folder is no lake; the message says why."""


class Store:
    """A lake in a folder.

    `frames/` and `signals/` have a folder for each vehicle, day and channel, and in it a file for each trace, named by its content. `ledger/` has
    an entry for each trace, which names its files. Files that were joined are named by the entries of all traces whose rows they have.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.transactions = Transactions(self.folder)

    def create(self) -> None:
        """Makes it, unless it is there."""
        mark = self.folder / "lake.json"
        if not mark.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            # An interrupted run may have left the beginning of a mark.
            if any(not path.name.startswith((mark.name, f".{mark.name}.")) for path in self.folder.iterdir()):
                raise StoreError(f"{self.folder} has files and is no lake; give a new folder")
            write_whole(mark, json.dumps({"format": FORMAT}).encode())
        self.check()
        self._ledger.mkdir(exist_ok=True)

    def check(self) -> None:
        """Raises if the folder is no lake that this version knows."""
        try:
            found = json.loads((self.folder / "lake.json").read_bytes())["format"]
        except FileNotFoundError:
            raise StoreError(f"{self.folder} is no lake: it has no lake.json") from None
        except (ValueError, KeyError, TypeError):
            raise StoreError(f"{self.folder / 'lake.json'} is damaged") from None
        for name in ("ledger", _STAGING, *TABLES):
            if (self.folder / name).is_symlink():
                raise StoreError(f"{self.folder / name} is a link: a lake's folders are its own")
        if found not in (FORMAT, FORMAT_JOINED):
            raise StoreError(f"{self.folder} is a lake of format {found}, and this version knows up to {FORMAT_JOINED}; update cantap")

    def path(self, name: str) -> Path:
        """Where a file is. A lake of somebody else may have links in it, and files that they lead to are not the lake's."""
        path = self.folder / name
        if path.is_symlink() or path.parent.resolve() != (self.folder.resolve() / name).parent:
            raise StoreError(f"{path} is, or is behind, a link: what it leads to is not read, replaced or removed")
        return path

    @property
    def _ledger(self) -> Path:
        return self.folder / "ledger"

    def entry(self, sha256: str) -> dict[str, Any] | None:
        """What became of a content, if it has been read."""
        return self._entry(sha256, self.transactions.last()["moves"])

    def _entry(self, sha256: str, moves: Moves) -> dict[str, Any] | None:
        try:
            entry = json.loads((self._ledger / f"{sha256}.json").read_bytes())
        except (FileNotFoundError, ValueError):
            entry = None
        # It is written whole or not at all. If somebody has changed it, its trace is read again.
        is_entry = isinstance(entry, dict) and {"sha256", "names", "files", "setup", "state", "trace"} <= set(entry) and entry["sha256"] == sha256
        is_own = is_entry and is_content(sha256) and isinstance(entry["files"], dict) and all(map(are_own, entry["files"].values()))
        return moved(entry, moves) if is_own else None

    def entries(self) -> Iterator[dict[str, Any]]:
        """All of the ledger, by content, as it is at one moment."""
        self.check()
        while True:
            last = self.transactions.last()
            entries = [(path, self._entry(path.stem, last["moves"])) for path in sorted(self._ledger.glob("*.json"))]
            # Otherwise some may be from before a transaction, and others from after it.
            if self.transactions.last()["number"] == last["number"]:
                break
        for path, entry in entries:
            if entry is None:
                raise StoreError(f"{path} is damaged; remove it, and its trace is read again")
            yield entry

    def move(self, moves: Moves) -> None:
        """Files are replaced by others with the same rows, for all entries that name them at once. Only while `transactions.writing`. Those that were
        replaced stay until they are removed by age, which counts from now."""
        self.finish()
        write_whole(self.folder / "lake.json", json.dumps({"format": FORMAT_JOINED}).encode())
        last = self.transactions.begin(moves)
        self._carry_out(last)

    def finish(self) -> None:
        """Carries out what a killed process has begun. Only while `transactions.writing`."""
        last = self.transactions.last()
        if not last["done"]:
            self._carry_out(last)

    def _carry_out(self, last: dict[str, Any]) -> None:
        for sha256 in last["moves"]:
            entry = self._entry(sha256, last["moves"])
            if entry is not None:
                self._write_entry(entry)
        for name in {name for of_entry in last["moves"].values() for name in of_entry}:
            with suppress(FileNotFoundError):
                os.utime(self.path(name))
        self.transactions.end(last)

    def staging(self) -> Path:
        """A new folder for files that do not belong to the lake yet."""
        (self.folder / _STAGING).mkdir(exist_ok=True)
        return Path(tempfile.mkdtemp(dir=self.folder / _STAGING))

    def put(self, entry: dict[str, Any], staged: Path) -> None:
        """Takes a trace's files from a folder, and then its entry, which makes them visible."""
        for name in _files_of(entry):
            path = self.path(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            os.replace(staged / name, path)
        self.commit(entry)

    def commit(self, entry: dict[str, Any]) -> None:
        """Writes or replaces an entry whose files are there; those that it had before are removed."""
        with self.transactions.writing():
            self.finish()
            before = self.entry(entry["sha256"])
            shared = sorted(name for name in _files_of(before) if is_joined(name))
            if shared:
                self._divide(shared)
                before = self.entry(entry["sha256"])
            self._write_entry(entry)
            for name in _files_of(before) - _files_of(entry):
                self.path(name).unlink(missing_ok=True)

    def add_names(self, sha256: str, names: set[str]) -> None:
        """A trace's content has come under these names, too."""
        with self.transactions.writing():
            self.finish()
            entry = self.entry(sha256)
            if entry is not None and not names <= set(entry["names"]):
                self._write_entry({**entry, "names": sorted(names.union(entry["names"]))})

    def _write_entry(self, entry: dict[str, Any]) -> None:
        write_whole(self._ledger / f"{entry['sha256']}.json", json.dumps(entry, sort_keys=True).encode())

    def _divide(self, names: Iterable[str]) -> None:
        """Gives the traces of joined files a file each again, so that one of them can be replaced."""
        moves: dict[str, dict[str, dict[str, int]]] = {}
        for name in names:
            first_row = 0
            for sha256, own, rows in members(self.path(name)):
                if name in _files_of(self.entry(sha256)):
                    # It may not have been removed yet.
                    if _rows(self.path(own)) != rows:
                        part_of(self.path(name), first_row, rows, self.path(own))
                    moves.setdefault(sha256, {}).setdefault(name, {})[own] = rows
                first_row += rows
        self.move(moves)

    def mend(self) -> None:
        """Divides joined files with rows of traces whose entries somebody has removed: these rows are not seen then."""
        with self.transactions.writing():
            self.finish()
            self._mend()

    def _mend(self) -> None:
        said = [(name, rows) for table in TABLES for name, rows in self.files(table).items() if is_joined(name)]
        unlike = [name for name, rows in said if _rows(self.path(name)) not in (None, rows)]
        if unlike:
            self._divide(unlike)

    def forget(self) -> list[str]:
        """Removes the entries of traces whose files are not as they say, so that the traces are read again, and returns their names."""
        with self.transactions.writing():
            self.finish()
            self._mend()
            bad = {name for name, _ in self._problems()}
            entries = [entry for entry in self.entries() if bad & _files_of(entry)]
            for entry in entries:
                (self._ledger / f"{entry['sha256']}.json").unlink()
            self._mend()
        return [entry["trace"] for entry in entries]

    def names_of(self, sha256: str) -> set[str]:
        """The files that have a content's rows."""
        return _files_of(self.entry(sha256))

    def dataset(self, table: str) -> pyarrow.dataset.Dataset:
        """A table, `frames` or `signals`, of the traces in the ledger and nothing else."""
        if table not in TABLES:
            raise StoreError(f"a lake has no table '{table}'; it has {', '.join(TABLES)}")
        # It brings pandas, if that is there: more than a second for each process that decodes, none of which has a use for it.
        import pyarrow.dataset

        names = [str(self.path(name)) for name in self._files_as_said(table)]
        return pyarrow.dataset.dataset(names, schema=columns.schema(TABLES[table]), format="parquet")

    def files(self, table: str) -> dict[str, int]:
        """A table's files, each with its rows in the ledger."""
        found: dict[str, int] = {}
        for entry in self.entries():
            for name, rows in entry["files"].get(table, {}).items():
                found[name] = found.get(name, 0) + rows
        return found

    def _files_as_said(self, table: str) -> dict[str, int]:
        """The same; raises if a joined file has rows of traces that the ledger does not know."""
        found = self.files(table)
        for name, rows in found.items():
            if is_joined(name) and _rows(self.path(name)) != rows:
                raise StoreError(f"{name} is not as the ledger says; `cantap-lake compact` mends it if entries were removed, `check --forget` if it is damaged")
        return found

    def write_delta(self, table: str) -> int:
        """Makes a table a Delta table, too, of the files that it has now, in one transaction; returns its version. Nothing is copied. It needs the
        package `deltalake`.

        A version has what came since the last one. Only if files are gone, as after a compaction or with another database, it lists all of them again.
        """
        try:
            import deltalake
            from deltalake.transaction import AddAction, create_table_with_add_actions
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("Delta is written by deltalake; install it: pip install deltalake", name="deltalake") from error
        folder = self.folder / table
        schema = deltalake.Schema.from_arrow(columns.schema(TABLES[table]))
        files = {name.removeprefix(f"{table}/"): rows for name, rows in self._files_as_said(table).items()}

        def added(names: Iterable[str]) -> list[Any]:
            actions = []
            for name in names:
                about = self.path(f"{table}/{name}").stat()
                actions.append(AddAction(name, about.st_size, {}, int(about.st_mtime * 1000), True, json.dumps({"numRecords": files[name]})))
            return actions

        if not deltalake.DeltaTable.is_deltatable(str(folder)):
            folder.mkdir(exist_ok=True)
            create_table_with_add_actions(str(folder), schema, added(files), "error", name=table)
            return int(deltalake.DeltaTable(str(folder)).version())
        delta = deltalake.DeltaTable(str(folder))
        # The log has them as they are in a URL.
        known = {unquote(path) for path in pa.table(delta.get_add_actions(flatten=True)).column("path").to_pylist()}
        if known <= files.keys():
            new = [name for name in files if name not in known]
            if not new:
                return int(delta.version())
            delta.create_write_transaction(added(new), "append", schema)
        else:
            delta.create_write_transaction(added(files), "overwrite", schema)
        delta.update_incremental()
        return int(delta.version())

    def problems(self) -> Iterator[str]:
        """What of the ledger is not there as it says: each file's rows are counted."""
        return (problem for _, problem in self._problems())

    def _problems(self) -> Iterator[tuple[str, str]]:
        """A file, and what is wrong with it."""
        traces: dict[str, list[str]] = {}
        for entry in self.entries():
            for name in _files_of(entry):
                traces.setdefault(name, []).append(entry["trace"])
        for table in TABLES:
            for name, count in self.files(table).items():
                others = f" and {len(traces[name]) - 1} others" if len(traces[name]) > 1 else ""
                what = f"{name}, of {traces[name][0]}{others}"
                try:
                    rows = pq.read_metadata(self.path(name)).num_rows
                except (OSError, pa.ArrowInvalid, StoreError) as error:
                    yield name, f"{what}: {error}"
                    continue
                if rows != count:
                    yield name, f"{what}: it has {rows} {table}, and the ledger says {count}"

    def unused(self) -> list[Path]:
        """Files that no entry names: those that were joined into others, and those that an interrupted run left."""
        named = {name for entry in self.entries() for name in _files_of(entry)}
        there = (path for table in TABLES for path in (self.folder / table).rglob("*.parquet*") if path.is_file() and DELTA_LOG not in path.parts)
        return sorted(path for path in there if path.relative_to(self.folder).as_posix() not in named)

    def stray(self) -> list[Path]:
        """Files that an interrupted run left."""
        left = [path for path in (self.folder / _STAGING).rglob("*") if path.is_file()]
        whole = {stem_of(entry["sha256"], entry["setup"]) for entry in self.entries()}
        # What was joined, or was to be: who reads an older list of files may need it.
        return left + [path for path in self.unused() if not (path.suffix == ".parquet" and (is_joined(path.name) or path.stem.partition(".")[0] in whole))]


def _files_of(entry: dict[str, Any] | None) -> set[str]:
    return {name for files in (entry or {"files": {}})["files"].values() for name in files}


def _rows(path: Path) -> int | None:
    """A file's rows; `None` if it cannot be read."""
    try:
        return int(pq.read_metadata(path).num_rows)
    except (OSError, pa.ArrowInvalid):
        return None


def stem_of(sha256: str, setup: Any) -> str:
    """The name of a trace's files. Of other databases the same trace has other rows: until its entry is there, the old ones are."""
    digest = hashlib.sha256(json.dumps(setup, sort_keys=True).encode()).hexdigest()
    return f"{sha256[:32]}-{digest[:8]}"
