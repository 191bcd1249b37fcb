"""Parquet files as read by other programs: pyarrow, DuckDB, Polars and pandas must agree; their result is printed as JSON."""
import json
import sys

import duckdb
import pandas
import polars
import pyarrow.dataset
import pyarrow.parquet

frames, signals, dataset, messages, wide = sys.argv[1:]


def same(*found):
    assert len({json.dumps(one) for one in found}) == 1, found
    return found[0]


def by_event(rows):
    return sorted([str(event), int(count)] for event, count in rows)


EVENTS = "SELECT event, count(*) FROM '{}' GROUP BY 1"
SUMS = (
    "SELECT message || '.' || signal, count(value), sum(value), min(raw), max(raw)"
    " FROM '{}' WHERE event = 'value' GROUP BY 1"
)


def sums(rows):
    return sorted([str(name), int(count), round(float(total), 3), int(low), int(high)] for name, count, total, low, high in rows)


table = pyarrow.parquet.read_table(frames)
# pandas keeps nanoseconds and the zone.
frame = pandas.read_parquet(frames)
lazy = polars.read_parquet(frames)
found = {
    "frames": same(
        by_event(duckdb.sql(EVENTS.format(frames)).fetchall()),
        by_event((one["values"], one["counts"]) for one in table["event"].value_counts().to_pylist()),
        by_event(frame["event"].value_counts().items()),
        by_event(lazy.group_by(polars.col("event").cast(polars.String)).len().rows()),
    ),
    "first_ns": same(
        table["time"].cast("int64")[0].as_py(),
        int(frame["time"].iloc[0].value),
        lazy["time"].cast(polars.Int64)[0],
    ),
    "data_bytes": same(
        sum(len(data) for data in table["data"].to_pylist() if data is not None),
        sum(len(data) for data in frame["data"] if data is not None),
        duckdb.sql(f"SELECT sum(octet_length(data))::BIGINT FROM '{frames}'").fetchall()[0][0],
    ),
    "zone": str(table.schema.field("time").type),
}
of_polars = (
    polars.read_parquet(signals)
    .filter(polars.col("event").cast(polars.String) == "value")
    .with_columns(name=polars.concat_str([polars.col("message").cast(polars.String), polars.col("signal").cast(polars.String)], separator="."))
    .group_by("name")
    .agg(polars.col("value").count(), polars.col("value").sum().alias("sum"), polars.col("raw").min().alias("low"), polars.col("raw").max().alias("high"))
)
found["signals"] = same(sums(duckdb.sql(SUMS.format(signals)).fetchall()), sums(of_polars.rows()))
# Folders become columns.
partitioned = pyarrow.dataset.dataset(dataset, partitioning="hive").to_table()
places = partitioned.group_by(["vehicle", "day", "channel"]).aggregate([([], "count_all")]).to_pylist()
HIVE = f"read_parquet('{dataset}/**/*.parquet', hive_partitioning=true)"
found["dataset"] = same(
    sorted([str(one["vehicle"]), str(one["day"]), int(one["channel"]), one["count_all"]] for one in places),
    sorted(
        [str(vehicle), str(day), int(channel), rows]
        for vehicle, day, channel, rows in duckdb.sql(
            f"SELECT vehicle, day, channel, count(*) FROM {HIVE} GROUP BY ALL"
        ).fetchall()
    ),
)
one = pyarrow.parquet.read_table(messages)
found["message"] = {
    "rows": one.num_rows,
    "columns": one.column_names,
    "units": {field.name: field.metadata[b"unit"].decode() for field in one.schema if field.metadata and b"unit" in field.metadata},
}
found["wide"] = {"rows": pyarrow.parquet.read_table(wide).num_rows, "columns": pyarrow.parquet.read_table(wide).num_columns}
print(json.dumps(found))
