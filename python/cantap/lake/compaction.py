"""Joins a lake's small files, and removes those that are not used any more."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

import pyarrow as pa
import pyarrow.parquet as pq

from .joined import Member, is_joined, join, joined_name, members
from .store import DELTA_LOG, Store, StoreError
from .writing import TABLES

#: What query engines read well: few enough files, and enough of them for all cores.
FILE_BYTES = 128 << 20


@dataclass
class Compacted:
    """What became of a lake's files."""

    files: int = 0
    """How many were joined."""
    joined: int = 0
    """Into how many."""
    bytes: int = 0
    """The length of these."""
    problems: list[str] = field(default_factory=list)
    """Files that were left as they are because they cannot be read, in words."""


@dataclass(frozen=True)
class _File:
    name: str
    bytes: int
    first_ns: int
    members: tuple[Member, ...]


def compact(folder: str | os.PathLike[str], *, file_bytes: int = FILE_BYTES) -> Compacted:
    """Joins the files of each table, vehicle, day and channel that have less than half of `file_bytes`, in the order of their first times.

    Rows and ledger stay the same. Traces may be added meanwhile. The files that were joined are still there for those who read them: `vacuum` removes
    them. It can be killed at any moment: what is joined by then remains so, a vehicle at a time.
    """
    if file_bytes < 1:
        raise ValueError("a file has at least one byte")
    store = Store(folder)
    store.check()
    done = Compacted()
    with store.transactions.run():
        store.mend()
        waiting: dict[str, list[tuple[list[_File], str]]] = {}
        for place, files in sorted(_small(store, file_bytes, done).items()):
            for group in _filled(files, file_bytes):
                name = f"{place}/{joined_name([member for file in group for member in file.members])}"
                # Frames and signals of a vehicle: their entries are written once.
                waiting.setdefault(place.split("/")[1], []).append((group, name))
        for groups in waiting.values():
            _commit(store, [(group, name) for group, name in groups if _join(store, group, name, done)], done)
    return done


def _small(store: Store, file_bytes: int, done: Compacted) -> dict[str, list[_File]]:
    """The files to be joined, by folder."""
    found: dict[str, list[_File]] = {}
    seen: set[str] = set()
    for entry in store.entries():
        for files in entry["files"].values():
            for name, rows in files.items():
                if name in seen:
                    continue
                seen.add(name)
                try:
                    path = store.path(name)
                    if path.stat().st_size * 2 >= file_bytes:
                        continue
                    own = tuple(members(path)) if is_joined(name) else ((entry["sha256"], name, rows),)
                    first_ns = _first_ns(path)
                except (OSError, pa.ArrowInvalid, StoreError) as error:
                    done.problems.append(f"{name}: {error}")
                    continue
                found.setdefault(name.rpartition("/")[0], []).append(_File(name, path.stat().st_size, first_ns, own))
    return found


def _first_ns(path: Path) -> int:
    """The earliest time of a file."""
    metadata = pq.read_metadata(path)
    column = metadata.schema.to_arrow_schema().get_field_index("time_ns")
    groups = (metadata.row_group(number).column(column).statistics for number in range(metadata.num_row_groups))
    return min((int(found.min) for found in groups if found is not None and found.has_min_max), default=0)


def _filled(files: list[_File], file_bytes: int) -> Iterator[list[_File]]:
    """Those that become one file each."""
    group: list[_File] = []
    for file in sorted(files, key=lambda file: (file.first_ns, file.name)):
        if group and sum(other.bytes for other in group) + file.bytes > file_bytes:
            if len(group) > 1:
                yield group
            group = []
        group.append(file)
    if len(group) > 1:
        yield group


def _join(store: Store, group: list[_File], name: str, done: Compacted) -> bool:
    """Whether the files could be joined."""
    try:
        join([store.path(file.name) for file in group], [member for file in group for member in file.members], store.path(name))
    except (OSError, pa.ArrowInvalid, StoreError) as error:
        # One may be gone because its trace has got other rows meanwhile.
        if _are_named(store, group):
            done.problems.append(f"{name}: {error}")
        return False
    return True


def _commit(store: Store, groups: list[tuple[list[_File], str]], done: Compacted) -> None:
    """Makes the joined files count, apart from those of which a trace has got other rows meanwhile."""
    with store.transactions.writing():
        moves: dict[str, dict[str, dict[str, int]]] = {}
        for group, name in groups:
            if _are_named(store, group):
                for file in group:
                    for sha256, _, rows in file.members:
                        moved = moves.setdefault(sha256, {}).setdefault(file.name, {})
                        moved[name] = moved.get(name, 0) + rows
                done.files += len(group)
                done.joined += 1
                done.bytes += store.path(name).stat().st_size
        if moves:
            store.move(moves)


def _are_named(store: Store, group: list[_File]) -> bool:
    """Whether all entries still name these files."""
    return all(file.name in store.names_of(sha256) for file in group for sha256, _, _ in file.members)


def vacuum(folder: str | os.PathLike[str], *, retain_hours: float) -> list[Path]:
    """Removes files that no entry has named for so many hours, and returns them: those that were joined into others, and what interrupted runs left.

    Whoever opened the lake before that may still read them. Files of the current version of a Delta table stay in any case.
    """
    if not retain_hours >= 0:
        raise ValueError("give the hours for which files are kept that are not used any more: 0 or more")
    store = Store(folder)
    store.check()
    removed = []
    with store.transactions.alone(), store.transactions.writing():
        store.finish()
        of_delta = {path for table in TABLES for path in _of_delta(store.folder / table)}
        before = time.time() - retain_hours * 3600
        for path in sorted({*store.unused(), *store.stray()}):
            if path not in of_delta and path.stat().st_mtime <= before:
                path.unlink()
                removed.append(path)
    return removed


def _of_delta(table: Path) -> list[Path]:
    """The files of a Delta table's current version."""
    if not (table / DELTA_LOG).is_dir():
        return []
    try:
        from deltalake import DeltaTable
    except ModuleNotFoundError:
        raise StoreError(f"{table} is a Delta table, too, whose files must stay; install what knows them: pip install deltalake") from None
    delta = DeltaTable(str(table))
    paths = pa.table(delta.get_add_actions()).column("path").to_pylist()
    # The log has them as they are in URLs.
    return [table / form for path in paths for form in (path, unquote(path))]
