"""Writes the rows of one trace: a Parquet file for each table, vehicle, day and channel that it has."""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from . import columns

TABLES = {"frames": columns.FRAMES, "signals": columns.SIGNALS}
#: Rows that wait in memory until they are written: a quarter of a million are some tens of megabytes.
ROW_GROUP_ROWS = 1 << 18
#: What is nearly the same from row to row takes least as differences, and is in no dictionary.
_DIFFERENCES = ["row", "time", "time_ns"]
_NO_DICTIONARY = [*_DIFFERENCES, "raw", "value"]
_DAY_NS = 86_400 * 1_000_000_000


class Writing:
    """The files of a trace while they are written, in a folder apart from the lake's; `with` closes them."""

    def __init__(self, folder: Path, stem: str, vehicle: str, trace: str) -> None:
        self._folder = folder
        self._stem = stem
        self._vehicle = pa.array([vehicle])
        self._trace = pa.array([trace])
        self._files: dict[tuple[str, str], _File] = {}

    def __enter__(self) -> Writing:
        return self

    def __exit__(self, *error: object) -> None:
        for file in self._files.values():
            file.close(error[0] is None)

    def write(self, table: str, batch: pa.RecordBatch, first_row: int) -> None:
        """A batch of `cantap.scan`; `first_row` is the number of its first row within the trace."""
        rows = pc.add(_numbers(batch.num_rows), first_row)
        batch = pa.RecordBatch.from_arrays([*batch.columns, rows], [*batch.schema.names, "row"])
        for (channel, day), part in _places(batch):
            names = {"vehicle": self._vehicle[0].as_py(), "day": day, "channel": channel}
            folder = "/".join([table, *(f"{name}={quote(str(value), safe=' ')}" for name, value in names.items())])
            name = f"{folder}/{self._stem}.parquet"
            if (table, name) not in self._files:
                self._files[table, name] = _File(self._folder / name)
            self._files[table, name].write(self._columns(table, part, channel, day))

    def names(self) -> dict[str, dict[str, int]]:
        """The files by table, each with its rows."""
        found: dict[str, dict[str, int]] = {}
        for (table, name), file in self._files.items():
            found.setdefault(table, {})[name] = file.rows
        return found

    def _columns(self, table: str, batch: pa.RecordBatch, channel: int, day: datetime.date) -> pa.RecordBatch:
        """Texts stay numbers of texts, as Parquet has them."""
        rows = batch.num_rows
        known: dict[str, Any] = {
            "vehicle": _repeated(self._vehicle, rows),
            "trace": _repeated(self._trace, rows),
            "day": pa.repeat(pa.scalar(day, pa.date32()), rows),
            "channel": pa.repeat(pa.scalar(channel, pa.int16()), rows),
            "time": _micros(batch.column("time")),
            "time_ns": batch.column("time").cast(pa.int64()),
        }
        arrays, names = [], []
        for field in columns.schema(TABLES[table]):
            array = known.get(field.name)
            if array is None:
                array = batch.column(field.name)
            if not pa.types.is_dictionary(array.type):
                array = array.cast(field.type)
            arrays.append(array)
            names.append(field.name)
        return pa.RecordBatch.from_arrays(arrays, names)


class _File:
    """One of them."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._writer: pq.ParquetWriter | None = None
        self._waiting: list[pa.RecordBatch] = []
        self._waiting_rows = 0
        self.rows = 0

    def write(self, batch: pa.RecordBatch) -> None:
        self._waiting.append(batch)
        self._waiting_rows += batch.num_rows
        if self._waiting_rows >= ROW_GROUP_ROWS:
            self._flush()

    def _flush(self) -> None:
        if not self._waiting:
            return
        table = pa.Table.from_batches(self._waiting)
        if self._writer is None:
            # Readers find texts, whatever they are here.
            self._writer = pq.ParquetWriter(
                self._path,
                table.schema,
                compression="zstd",
                store_schema=False,
                use_dictionary=[name for name in table.column_names if name not in _NO_DICTIONARY],
                column_encoding={name: "DELTA_BINARY_PACKED" for name in _DIFFERENCES},
            )
        self._writer.write_table(table, row_group_size=max(table.num_rows, 1))
        self.rows += table.num_rows
        self._waiting, self._waiting_rows = [], 0

    def close(self, is_whole: bool) -> None:
        if is_whole:
            self._flush()
        if self._writer is None:
            return
        self._writer.close()
        if is_whole:
            with open(self._path, "rb") as file:
                os.fsync(file.fileno())
            written = pq.read_metadata(self._path).num_rows
            if written != self.rows:
                raise OSError(f"{self._path}: {written} rows were written instead of {self.rows}")


def _places(batch: pa.RecordBatch) -> Iterator[tuple[tuple[int, datetime.date], pa.RecordBatch]]:
    """The rows of each channel and day."""
    channels = pc.unique(batch.column("channel")).to_pylist()
    times = batch.column("time").cast(pa.int64())
    bounds = pc.min_max(times)
    first, last = (bounds[name].as_py() // _DAY_NS for name in ("min", "max"))
    for channel in channels:
        of_channel = batch if len(channels) == 1 else batch.filter(pc.equal(batch.column("channel"), channel))
        if first == last:
            yield (channel, _day(first)), of_channel
            continue
        times = of_channel.column("time").cast(pa.int64())
        # A trace in which time jumps may have a few, but hardly one for each row.
        days = sorted({ns // _DAY_NS for ns in times.to_pylist()})
        for day in days:
            is_on = pc.and_(pc.greater_equal(times, day * _DAY_NS), pc.less(times, (day + 1) * _DAY_NS))
            yield (channel, _day(day)), of_channel.filter(is_on)


def _day(number: int) -> datetime.date:
    return datetime.date(1970, 1, 1) + datetime.timedelta(days=number)


def _micros(time: pa.Array) -> pa.Array:
    """Rounded down, before 1970, too."""
    if pc.min(time.cast(pa.int64())).as_py() < 0:
        time = pc.floor_temporal(time, unit="microsecond")
    return time.cast(pa.timestamp("us", tz="UTC"), safe=False)


def _numbers(count: int) -> pa.Array:
    """From 0."""
    return _counted(max(count - 1, 1).bit_length()).slice(0, count)


@lru_cache
def _counted(bits: int) -> pa.Array:
    return pa.array(range(1 << bits), pa.int64())


def _repeated(text: pa.Array, rows: int) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.repeat(pa.scalar(0, pa.int8()), rows), text)
