"""The dataset: written once, with proof that it is complete.

    OUTPUT/frames/vehicle=7/day=2026-03-01/channel=1/….parquet    a row per frame, loss, bus error
    OUTPUT/signals/vehicle=7/day=2026-03-01/channel=1/….parquet   a row per value, and the same losses and errors
    OUTPUT/vehicles/                                              what is known about each vehicle's buses
    OUTPUT/ledger/                                                the result for each input; written last
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from pyspark import StorageLevel
from pyspark.sql import DataFrame, SparkSession
from pyspark.sql import functions as f

from cantap.lake import columns, ledger

from . import inputs
from .inputs import Bus, File, InputError
from .worker import TRACES, Settings, decoder, local_path

#: The largest file that Spark can pass as a value: the limit of Java's arrays.
_LARGEST_VALUE = (1 << 31) - 16
_VEHICLES = "vehicle string, channel smallint, bitrate bigint, data_bitrate bigint"


class AccountError(Exception):
    """What was written differs from what was read; the message says where."""


@dataclass(frozen=True)
class Plan:
    """What to decode, and with what."""

    traces: list[File]
    buses: dict[str, list[Bus]]
    databases: dict[str, bytes]


def plan(spark: SparkSession, folder: str, vehicles: str | None) -> Plan:
    """Finds the traces, and reads the vehicles' table and its databases."""
    files = inputs.files_of(spark, folder)
    if vehicles is None:
        tables = [file.url for file in files if file.name == "vehicles.csv"]
        if not tables:
            raise InputError(f"{folder} has no vehicles.csv; see the README for what it says, or give --vehicles")
        vehicles = tables[0]
    (table,) = inputs.contents_of(spark, [vehicles]).values()
    buses = inputs.buses_of(table.decode(), vehicles)
    by_name = {file.name: file.url for file in files}
    wanted = sorted({name for bus in buses for name in bus.databases})
    missing = [name for name in wanted if name not in by_name]
    if missing:
        raise InputError(f"{vehicles} names {missing[0]}, which is not in {folder}")
    contents = inputs.contents_of(spark, [by_name[name] for name in wanted])
    databases = {name: contents[by_name[name]] for name in wanted}
    traces = [file for file in files if file.name not in databases and file.url != vehicles]
    traces = [file for file in traces if file.name != "vehicles.csv"]
    if not traces:
        raise InputError(f"{folder} has no traces")
    found = sorted({file.vehicle for file in traces if file.vehicle is not None})
    return Plan(traces, inputs.buses_by_vehicle(buses, found), databases)


def write(
    spark: SparkSession, work: Plan, settings: Settings, output: str, task_bytes: int
) -> Counter[str]:
    """Decodes all traces and writes the dataset; returns the number of traces in each state."""
    refuse_existing(spark, output)
    databases = spark.sparkContext.broadcast(work.databases)
    traces = _traces(spark, work, task_bytes)
    rows = traces.mapInArrow(decoder(settings, databases), columns.ddl(columns.STREAM))
    # A single pass over the traces gives frames, signals and ledger. A worker's results stay on its disk until all three are written;
    # results lost with a worker are computed again.
    rows = rows.persist(StorageLevel.DISK_ONLY)
    try:
        _write_part(rows, "frames", columns.FRAMES, output)
        _write_part(rows, "signals", columns.SIGNALS, output)
        entries = _entries(rows)
    finally:
        rows.unpersist()
    entries += [_homeless(file) for file in work.traces if file.vehicle is None]
    entries.sort(key=lambda entry: str(entry["trace"]))
    check(spark, entries, [file.name for file in work.traces], output)
    buses = [
        (vehicle, bus.channel, bus.bitrate, bus.data_bitrate) for vehicle in sorted(work.buses) for bus in work.buses[vehicle]
    ]
    spark.createDataFrame(buses, _VEHICLES).coalesce(1).write.parquet(f"{output}/vehicles")
    spark.createDataFrame(entries, ledger.DDL).coalesce(1).write.parquet(f"{output}/ledger")
    return Counter(str(entry["state"]) for entry in entries)


def refuse_existing(spark: SparkSession, output: str) -> None:
    """A dataset is never overwritten: a query in the meantime would get parts of both."""
    java = spark.sparkContext._jvm
    assert java is not None
    path = java.org.apache.hadoop.fs.Path(output)
    system = path.getFileSystem(spark.sparkContext._jsc.hadoopConfiguration())
    if system.exists(path) and len(system.listStatus(path)) > 0:
        raise InputError(f"{output} has something in it; give another folder, or delete it first")


def _traces(spark: SparkSession, work: Plan, task_bytes: int) -> DataFrame:
    """A row for each trace in a vehicle's folder, in partitions that become tasks."""
    at_home = [file for file in work.traces if file.vehicle is not None]
    near = [file for file in at_home if local_path(file.url) is not None]
    if len(near) == len(at_home):
        return _in_tasks(spark, [_row(file, work) for file in near], task_bytes)
    # Workers have no access to Hadoop file systems: Spark reads what they cannot open themselves, file by file.
    spark.conf.set("spark.sql.execution.arrow.maxRecordsPerBatch", 1)
    rows = spark.createDataFrame([_row(file, work) for file in at_home], TRACES).drop("content")
    folders = sorted({file.url[: -len(file.name)] for file in at_home})
    binary = spark.read.format("binaryFile").option("recursiveFileLookup", True).load(folders)
    binary = binary.where(f.col("length") < _LARGEST_VALUE)
    handed = {row["path"] for row in binary.select("path").collect()}
    contents = binary.select(f.col("path").alias("url"), "content")
    order = [name.split()[0] for name in TRACES.split(", ")]
    fetched = contents.join(f.broadcast(rows), "url").select(order)
    left = [_row(file, work) for file in at_home if file.url not in handed]
    return fetched.union(spark.createDataFrame(left, TRACES).coalesce(1)) if left else fetched


def _row(file: File, work: Plan) -> tuple[Any, ...]:
    buses = work.buses[file.vehicle or ""]
    setup = {
        "databases": [(bus.channel, name) for bus in buses for name in bus.databases],
        "j1939": any(bus.j1939 for bus in buses),
    }
    return (file.url, file.name, file.vehicle, file.bytes, json.dumps(setup), None)


def _in_tasks(spark: SparkSession, rows: Sequence[tuple[Any, ...]], task_bytes: int) -> DataFrame:
    """Large traces each have a task; small ones share one, four times as many as there are cores if there are so many."""
    parallel = 4 * spark.sparkContext.defaultParallelism
    most = -(-len(rows) // parallel)
    tasks: list[list[tuple[Any, ...]]] = []
    room = 0
    for row in rows:
        if not tasks or row[3] > room or len(tasks[-1]) >= most:
            tasks.append([])
            room = task_bytes
        tasks[-1].append(row)
        room -= row[3]
    distributed = spark.sparkContext.parallelize(tasks, len(tasks)).flatMap(lambda task: task)
    return spark.createDataFrame(distributed, TRACES)


def _write_part(rows: DataFrame, part: str, wanted: dict[str, str], output: str) -> None:
    chosen = rows.where(f.col("part") == part).select(list(wanted))
    ordered = chosen.sortWithinPartitions(*columns.FOLDERS, "trace", "row")
    ordered.write.option("compression", "zstd").partitionBy(*columns.FOLDERS).parquet(f"{output}/{part}")


def _entries(rows: DataFrame) -> list[dict[str, Any]]:
    found = rows.where(f.col("part") == "ledger").select("entry").collect()
    return [json.loads(row["entry"]) for row in found]


def _homeless(file: File) -> dict[str, Any]:
    problem = "it lies in no vehicle's folder; move it into one"
    return ledger.Entry(file.name, "", file.bytes, state=ledger.REFUSED, problem=problem).to_dict()


def check(
    spark: SparkSession, entries: Iterable[dict[str, Any]], traces: Iterable[str], output: str
) -> None:
    """Checks that each input has one entry, and each entry's rows exist once: numbered from 0 without a gap."""
    entries = list(entries)
    times = Counter(str(entry["trace"]) for entry in entries)
    for trace in traces:
        if times[trace] != 1:
            raise AccountError(f"{trace} has {times[trace]} entries")
    for part, wanted, count in (
        ("frames", columns.FRAMES, "records"),
        ("signals", columns.SIGNALS, "signal_rows"),
    ):
        written = read(spark, output, part, wanted).groupBy("trace").agg(
            f.count("*").alias("rows"), f.min("row").alias("first"), f.max("row").alias("last"), f.sum("row").alias("sum")
        )
        found = {row["trace"]: (row["rows"], row["first"], row["last"], row["sum"]) for row in written.collect()}
        for entry in entries:
            rows = int(entry[count])
            due = (rows, 0, rows - 1, rows * (rows - 1) // 2) if rows else None
            if found.pop(entry["trace"], None) != due:
                raise AccountError(f"{part} of {entry['trace']} are not the {rows} rows that were read")
        if found:
            raise AccountError(f"{part} has rows of {min(found)}, which has no entry")


def read(spark: SparkSession, output: str, part: str, wanted: dict[str, str]) -> DataFrame:
    """A part of the dataset. The schema is given: Spark would read a vehicle called 007 as 7."""
    return spark.read.schema(columns.ddl(wanted)).parquet(f"{output}/{part}")
