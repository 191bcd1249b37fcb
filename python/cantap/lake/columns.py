"""The columns of the datasets: `cantap`'s own, in Spark's types.

Spark has neither unsigned integers nor nanoseconds: numbers have the next wider type, and in addition to `time`, in microseconds,
there is `time_ns`.
"""

from __future__ import annotations

import pyarrow as pa
import pyarrow.compute as pc

#: Names and Spark's types. The first three are folders.
COMMON = {
    "vehicle": "string",
    "day": "date",
    "channel": "smallint",
    "trace": "string",
    "row": "bigint",
    "time": "timestamp",
    "time_ns": "bigint",
    "event": "string",
    "detail": "string",
    "count": "bigint",
    "at_least": "boolean",
    "tec": "smallint",
    "rec": "smallint",
    "tag": "bigint",
    "id": "int",
    "extended": "boolean",
}
FRAMES = COMMON | {
    "remote": "boolean",
    "fd": "boolean",
    "brs": "boolean",
    "esi": "boolean",
    "late": "boolean",
    "direction": "string",
    "dlc": "smallint",
    "data": "binary",
    "device_ns": "bigint",
}
SIGNALS = COMMON | {
    "message": "string",
    "signal": "string",
    "value": "double",
    "raw": "decimal(20,0)",
    "text": "string",
    "unit": "string",
}
FOLDERS = ["vehicle", "day", "channel"]
#: A task delivers rows of both, and its part of the ledger, in one stream, marked by `part`.
STREAM = {"part": "string"} | FRAMES | SIGNALS | {"entry": "string"}

_ARROW: dict[str, pa.DataType] = {
    "string": pa.string(),
    "date": pa.date32(),
    "smallint": pa.int16(),
    "int": pa.int32(),
    "bigint": pa.int64(),
    "boolean": pa.bool_(),
    "double": pa.float64(),
    "binary": pa.binary(),
    "decimal(20,0)": pa.decimal128(20, 0),
    "timestamp": pa.timestamp("us", tz="UTC"),
}


def ddl(columns: dict[str, str]) -> str:
    """The columns for Spark."""
    return ", ".join(f"`{name}` {kind}" for name, kind in columns.items())


def schema(columns: dict[str, str]) -> pa.Schema:
    """The columns for Arrow."""
    return pa.schema([(name, _ARROW[kind]) for name, kind in columns.items()])


STREAM_SCHEMA = schema(STREAM)


def rows_of(batch: pa.RecordBatch, part: str, vehicle: str, trace: str, first_row: int) -> pa.RecordBatch:
    """A batch of `cantap.scan` as rows of the stream; `first_row` is the number of its first row within the trace."""
    rows = batch.num_rows
    time = batch.column("time")
    known: dict[str, pa.Array] = {
        "part": pa.repeat(part, rows),
        "vehicle": pa.repeat(vehicle, rows),
        "trace": pa.repeat(trace, rows),
        "row": pa.array(range(first_row, first_row + rows), pa.int64()),
        "time_ns": time.cast(pa.int64()),
        "time": pc.floor_temporal(time, unit="microsecond"),
        "day": pc.floor_temporal(time, unit="day").cast(pa.timestamp("s", tz="UTC")).cast(pa.date32()),
    }
    if "device_ns" in batch.schema.names:
        # More than 292 years are no device's time.
        device = batch.column("device_ns")
        known["device_ns"] = pc.if_else(pc.less(device, pa.scalar(1 << 63, pa.uint64())), device, pa.scalar(None, pa.uint64()))
    arrays = []
    for field in STREAM_SCHEMA:
        if field.name in known:
            arrays.append(known[field.name].cast(field.type))
        elif field.name in batch.schema.names:
            arrays.append(batch.column(field.name).cast(field.type))
        else:
            arrays.append(pa.nulls(rows, field.type))
    return pa.RecordBatch.from_arrays(arrays, schema=STREAM_SCHEMA)


def entry_of(entry: str, vehicle: str, trace: str) -> pa.RecordBatch:
    """The ledger's entry of a trace as a row of the stream."""
    row = {"part": "ledger", "vehicle": vehicle, "trace": trace, "entry": entry}
    return pa.RecordBatch.from_pylist([row], schema=STREAM_SCHEMA)
