"""Where a lake's tables are: Parquet files, and the ledger that says which of them belong to it."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset
import pyarrow.parquet as pq

from . import columns

TABLES = {"frames": columns.FRAMES, "signals": columns.SIGNALS}
FORMAT = 1
ROW_GROUP_ROWS = 1 << 20
DELTA_LOG = "_delta_log"


class StoreError(Exception):
    """The folder is no lake; the message says why."""


class Store:
    """A lake in a folder.

    `frames/` and `signals/` have a folder for each vehicle, day and channel, and in it a file for each trace, named by its content. `ledger/` has
    an entry for each trace, which names its files.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    def create(self) -> None:
        """Makes it, unless it is there."""
        mark = self.folder / "lake.json"
        if not mark.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            # An interrupted run may have left the beginning of a mark.
            if any(not path.name.startswith((mark.name, f".{mark.name}.")) for path in self.folder.iterdir()):
                raise StoreError(f"{self.folder} has files and is no lake; give a new folder")
            _write_whole(mark, json.dumps({"format": FORMAT}).encode())
        self._check()
        self._ledger.mkdir(exist_ok=True)

    def _check(self) -> None:
        try:
            found = json.loads((self.folder / "lake.json").read_bytes())["format"]
        except FileNotFoundError:
            raise StoreError(f"{self.folder} is no lake: it has no lake.json") from None
        except (ValueError, KeyError, TypeError):
            raise StoreError(f"{self.folder / 'lake.json'} is damaged") from None
        if found != FORMAT:
            raise StoreError(f"{self.folder} is a lake of format {found}, and this version knows {FORMAT}; update cantap")

    @property
    def _ledger(self) -> Path:
        return self.folder / "ledger"

    def entry(self, sha256: str) -> dict[str, Any] | None:
        """What became of a content, if it has been read."""
        try:
            entry = json.loads((self._ledger / f"{sha256}.json").read_bytes())
        except (FileNotFoundError, ValueError):
            entry = None
        # It is written whole or not at all. If somebody has changed it, its trace is read again.
        is_entry = isinstance(entry, dict) and {"sha256", "names", "files", "setup", "state", "trace"} <= set(entry)
        return entry if is_entry and isinstance(entry["files"], dict) else None

    def entries(self) -> Iterator[dict[str, Any]]:
        """All of the ledger, by content."""
        self._check()
        for path in sorted(self._ledger.glob("*.json")):
            entry = self.entry(path.stem)
            if entry is None:
                raise StoreError(f"{path} is damaged; remove it, and its trace is read again")
            yield entry

    def write(self, entry: dict[str, Any], rows: Iterator[pa.RecordBatch]) -> None:
        """Writes a trace's rows, and then its entry, which makes them visible."""
        before = self.entry(entry["sha256"])
        # Of other databases the same trace has other rows: until the entry is there, the old ones are.
        setup = hashlib.sha256(json.dumps(entry["setup"], sort_keys=True).encode()).hexdigest()
        with _Files(self.folder, f"{entry['sha256'][:32]}-{setup[:8]}") as written:
            for batch in rows:
                written.write(batch)
        entry["files"] = written.names()
        self.write_entry(entry)
        for files in (before or {"files": {}})["files"].values():
            for name in set(files) - {name for named in entry["files"].values() for name in named}:
                (self.folder / name).unlink(missing_ok=True)

    def write_entry(self, entry: dict[str, Any]) -> None:
        """Writes or replaces an entry."""
        _write_whole(self._ledger / f"{entry['sha256']}.json", json.dumps(entry, sort_keys=True).encode())

    def dataset(self, table: str) -> pyarrow.dataset.Dataset:
        """A table, `frames` or `signals`, of the traces in the ledger and nothing else."""
        if table not in TABLES:
            raise StoreError(f"a lake has no table '{table}'; it has {', '.join(TABLES)}")
        names = [str(self.folder / name) for entry in self.entries() for name in entry["files"].get(table, {})]
        return pyarrow.dataset.dataset(names, schema=columns.schema(TABLES[table]), format="parquet")

    def write_delta(self, table: str) -> int:
        """Makes a table a Delta table, too, of the files that it has now, in one transaction; returns its version. Nothing is copied. It needs the
        package `deltalake`."""
        try:
            import deltalake
            from deltalake.transaction import AddAction, create_table_with_add_actions
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("Delta is written by deltalake; install it: pip install deltalake", name="deltalake") from error
        folder = self.folder / table
        schema = deltalake.Schema.from_arrow(columns.schema(TABLES[table]))
        actions: list[Any] = []
        for entry in self.entries():
            for name, rows in entry["files"].get(table, {}).items():
                about = (self.folder / name).stat()
                path = (self.folder / name).relative_to(folder).as_posix()
                actions.append(AddAction(path, about.st_size, {}, int(about.st_mtime * 1000), True, json.dumps({"numRecords": rows})))
        if deltalake.DeltaTable.is_deltatable(str(folder)):
            delta = deltalake.DeltaTable(str(folder))
            delta.create_write_transaction(actions, "overwrite", schema)
            delta.update_incremental()
            return int(delta.version())
        folder.mkdir(exist_ok=True)
        create_table_with_add_actions(str(folder), schema, actions, "error", name=table)
        return int(deltalake.DeltaTable(str(folder)).version())

    def problems(self) -> Iterator[str]:
        """What of the ledger is not there as it says: each file's rows are counted."""
        for entry in self.entries():
            for table, files in entry["files"].items():
                for name, count in files.items():
                    try:
                        rows = pq.read_metadata(self.folder / name).num_rows
                    except (OSError, pa.ArrowInvalid) as error:
                        yield f"{name}, of {entry['trace']}: {error}"
                        continue
                    if rows != count:
                        yield f"{name}, of {entry['trace']}: it has {rows} {table}, and the ledger says {count}"

    def stray(self) -> list[Path]:
        """Files that no entry names: an interrupted run left them."""
        named = {name for entry in self.entries() for files in entry["files"].values() for name in files}
        there = (path for table in TABLES for path in (self.folder / table).rglob("*.parquet*") if path.is_file() and DELTA_LOG not in path.parts)
        return sorted(path for path in there if path.relative_to(self.folder).as_posix() not in named)


class _Files:
    """The files of a trace while they are written."""

    def __init__(self, folder: Path, stem: str) -> None:
        self._folder = folder
        self._stem = stem
        #: With the name that it has until it is complete, and its own.
        self._open: dict[tuple[str, str], tuple[pq.ParquetWriter, Path, Path]] = {}
        self._rows: dict[tuple[str, str], int] = {}

    def __enter__(self) -> _Files:
        return self

    def write(self, batch: pa.RecordBatch) -> None:
        """Rows of one part, as the decoding process has written them."""
        table = batch.column("part")[0].as_py()
        wanted = columns.schema(TABLES[table])
        rows = pa.Table.from_batches([batch]).select(wanted.names)
        for place in rows.select(columns.FOLDERS).group_by(columns.FOLDERS).aggregate([]).to_pylist():
            chosen = rows
            for name, value in place.items():
                chosen = chosen.filter(pc.is_null(pc.field(name)) if value is None else pc.field(name) == pa.scalar(value, wanted.field(name).type))
            self._writer(table, place, wanted).write_table(chosen.cast(wanted), row_group_size=ROW_GROUP_ROWS)

    def _writer(self, table: str, place: dict[str, Any], schema: pa.Schema) -> pq.ParquetWriter:
        folder = "/".join([table, *(f"{name}={quote(str(value), safe=' ')}" for name, value in place.items())])
        name = f"{folder}/{self._stem}.parquet"
        if (table, name) not in self._open:
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
            self._open[table, name] = (pq.ParquetWriter(temporary, schema, compression="zstd"), temporary, path)
        return self._open[table, name][0]

    def names(self) -> dict[str, dict[str, int]]:
        """The files by table, each with its rows."""
        found: dict[str, dict[str, int]] = {}
        for table, name in self._open:
            found.setdefault(table, {})[name] = self._rows[table, name]
        return found

    def __exit__(self, *error: object) -> None:
        for key, (writer, temporary, path) in self._open.items():
            writer.close()
            if error[0] is None:
                self._rows[key] = pq.read_metadata(temporary).num_rows
                os.replace(temporary, path)
            else:
                temporary.unlink(missing_ok=True)


def _write_whole(path: Path, content: bytes) -> None:
    """A file is there with all of its content, or as it was before."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
