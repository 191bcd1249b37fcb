"""Files that have the rows of several traces, one trace after the other, and say in their metadata whose."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import pyarrow as pa
import pyarrow.parquet as pq

from .names import are_own, is_content

#: Rows that are held in memory at a time.
ROW_GROUP_ROWS = 1 << 20
_PREFIX = "joined-"
_MEMBERS = b"cantap.members"

#: A trace's content, the file that it had for itself, and its rows.
Member = tuple[str, str, int]


def is_joined(name: str) -> bool:
    """Whether a file is one of several traces."""
    return PurePosixPath(name).name.startswith(_PREFIX)


def members(path: Path) -> list[Member]:
    """Whose rows a joined file has, in their order."""
    metadata = pq.read_metadata(path).metadata or {}
    found = [(sha256, name, rows) for sha256, name, rows in json.loads(metadata.get(_MEMBERS, b"[]"))]
    if not found or not all(is_content(sha256) and are_own({name: rows}) for sha256, name, rows in found):
        raise OSError(f"{path} does not say whose rows it has, or names files outside of the lake; remove it, and `cantap-lake check --forget` the rest")
    return found


def joined_name(parts: Sequence[Member]) -> str:
    """The name of the file with these rows: the same ones always have the same."""
    digest = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    return f"{_PREFIX}{digest[:32]}.parquet"


def join(sources: Sequence[Path], parts: Sequence[Member], target: Path) -> None:
    """Writes the rows of several files into one, and compares it with them before it gets its name."""
    schema = pq.read_schema(sources[0]).remove_metadata()
    schema = schema.with_metadata({_MEMBERS: json.dumps(parts).encode()})
    with _new(target) as temporary:
        with pq.ParquetWriter(temporary, schema, compression="zstd") as writer:
            for group in _groups(sources):
                writer.write_table(group.replace_schema_metadata(schema.metadata), row_group_size=ROW_GROUP_ROWS)
        written = pq.ParquetFile(temporary)
        for number, group in enumerate(_groups(sources)):
            if not written.read_row_group(number).equals(group):
                raise OSError(f"{target}: what was written is not what was read; is the disk or the memory faulty?")
        if written.metadata.num_rows != sum(rows for _, _, rows in parts):
            raise OSError(f"{target}: it would have {written.metadata.num_rows} rows, and the ledger says {sum(rows for _, _, rows in parts)}")


def part_of(path: Path, first_row: int, rows: int, target: Path) -> None:
    """Writes some of a joined file's rows into a file of their own."""
    file = pq.ParquetFile(path)
    schema = file.schema_arrow.remove_metadata()
    with _new(target) as temporary, pq.ParquetWriter(temporary, schema, compression="zstd") as writer:
        before = 0
        for number in range(file.num_row_groups):
            count = file.metadata.row_group(number).num_rows
            start, end = max(first_row - before, 0), min(first_row + rows - before, count)
            if start < end:
                group = file.read_row_group(number).slice(start, end - start)
                writer.write_table(group.replace_schema_metadata(None), row_group_size=ROW_GROUP_ROWS)
            before += count


def _groups(sources: Sequence[Path]) -> Iterator[pa.Table]:
    """All rows, in tables of `ROW_GROUP_ROWS`."""
    waiting: list[pa.Table] = []
    count = 0
    for source in sources:
        file = pq.ParquetFile(source)
        for number in range(file.num_row_groups):
            waiting.append(file.read_row_group(number).replace_schema_metadata(None))
            count += waiting[-1].num_rows
            while count >= ROW_GROUP_ROWS:
                table = pa.concat_tables(waiting)
                yield table.slice(0, ROW_GROUP_ROWS)
                waiting, count = [table.slice(ROW_GROUP_ROWS)], count - ROW_GROUP_ROWS
    if count:
        yield pa.concat_tables(waiting)


@contextmanager
def _new(target: Path) -> Iterator[Path]:
    """A file that gets its name once it is complete."""
    temporary = target.with_name(f".{target.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
