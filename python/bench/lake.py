"""What a lake costs beside `cantap decode`: many small traces, or one large one, in processor seconds per million frames.

    python bench/lake.py CANTAP --traces 10000 --database a.dbc --database b.dbc
    python bench/lake.py CANTAP --large 5000000 --database a.dbc
    python bench/lake.py - --large 5000000 --format mf4 --database a.dbc

With `-` the package itself takes the command's place: `cantap.scan` of the whole trace, whose signals pyarrow writes as one file.
"""

import argparse
import itertools
import json
import os
import random
import re
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from cantap.lake import Store

import cantap

FORMATS = ["blf", "mf4", "log", "asc", "trc", "pcapng"]


def measured(*arguments):
    """Processor seconds of a program with its children, seconds by the clock, and the memory of the largest process so far in MiB."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run([str(argument) for argument in arguments], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, time.monotonic() - began, after.ru_maxrss / 1024


class Watched:
    """The most bytes in a folder, looked at four times a second."""

    def __init__(self, folder):
        self.folder, self.most, self._is_over = folder, 0, threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._is_over.set()
        self._thread.join()

    def _watch(self):
        while not self._is_over.wait(0.25):
            self.most = max(self.most, bytes_in(self.folder))


def bytes_in(folder):
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.stat().st_size if path.is_file() else 0
        except OSError:
            pass  # It was removed in that moment.
    return total


def frames(database, count, start, rng):
    """Frames of a database's messages with random data, 2,000 a second on two channels."""
    messages = [(int(number), int(length)) for number, length in re.findall(r"^BO_ (\d+) \w+ *: *(\d+)", database.read_text("latin-1"), re.M)]
    messages = [(number & 0x1FFFFFFF, number >> 31, min(length, 8)) for number, length in messages if number & 0x7FFFFFFF < 1 << 29]
    rows = [rng.choice(messages) for _ in range(count)]
    return pa.table(
        {
            "time": pa.array([start * 1_000_000_000 + at * 500_000 for at in range(count)], pa.timestamp("ns", tz="UTC")),
            "channel": pa.array([at % 2 + 1 for at in range(count)], pa.uint8()),
            "id": pa.array([number for number, _, _ in rows], pa.uint32()),
            "extended": pa.array([bool(is_extended) for _, is_extended, _ in rows]),
            "data": pa.array([rng.randbytes(length) for _, _, length in rows], pa.binary()),
        }
    )


def small(folder, databases, count, of_each, rng):
    """Many traces of all formats, below a folder for each database."""
    table = {database: frames(database, of_each, 0, rng) for database in databases}
    time_of = {database: table[database].column("time").cast(pa.int64()) for database in databases}
    for number, database, suffix in zip(range(count), itertools.cycle(databases), itertools.cycle(FORMATS), strict=False):
        path = folder / database.stem / f"{number:05}.{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        start = (1_770_000_000 + number * 60) * 1_000_000_000
        times = pc.add(time_of[database], start).cast(pa.timestamp("ns", tz="UTC"))
        cantap.write(table[database].set_column(0, "time", times), path)


def large(path, database, count, rng):
    """One trace of so many frames."""
    table = frames(database, 200_000, 0, rng)
    times = table.column("time").cast(pa.int64())

    def batches():
        for first in range(0, count, table.num_rows):
            moved = pc.add(times, 1_770_000_000_000_000_000 + first * 500_000).cast(table.schema.field("time").type)
            yield from table.set_column(0, "time", moved).slice(0, count - first).to_batches()

    cantap.write(pa.RecordBatchReader.from_batches(table.schema, batches()), path)


def add(lake, sources, database, workers, *more):
    command = [sys.executable, "-m", "cantap.lake.command", "add", lake, *sources, "--db", database, "--workers", workers, *more]
    return measured(*command)


SCAN = """
import sys
import cantap
import pyarrow as pa
import pyarrow.parquet as pq
reader = pa.RecordBatchReader.from_stream(cantap.scan(sys.argv[1], db=sys.argv[2]))
with pq.ParquetWriter(sys.argv[3], reader.schema, compression="zstd") as writer:
    for batch in reader:
        writer.write_batch(batch)
"""


def report(what, cost, of_frames, **more):
    seconds, clock, memory = cost
    print(json.dumps({"what": what, "processor_s_per_million": round(seconds * 1e6 / of_frames, 2), "processor_s": round(seconds, 2), "s": round(clock, 1), "frames": of_frames, "largest_process_mib": round(memory), **more}), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", help="the program cantap, built as the package is")
    parser.add_argument("--database", type=Path, action="append", required=True)
    parser.add_argument("--traces", type=int, default=0)
    parser.add_argument("--of-each", type=int, default=500, help="frames in a small trace")
    parser.add_argument("--sample", type=int, default=50, help="how many of the small ones cantap decodes one by one")
    parser.add_argument("--large", type=int, default=0, help="frames of the large trace")
    parser.add_argument("--format", default="blf", choices=["blf", "mf4"], help="of the large trace")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    arguments = parser.parse_args()
    rng = random.Random(1)
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        if arguments.traces:
            small(folder / "traces", arguments.database, arguments.traces, arguments.of_each, rng)
            for workers in arguments.workers:
                costs = [add(folder / f"lake{workers}", [folder / "traces" / database.stem], database, workers) for database in arguments.database]
                cost = (sum(cost[0] for cost in costs), sum(cost[1] for cost in costs), max(cost[2] for cost in costs))
                entries = list(Store(folder / f"lake{workers}").entries())
                assert len(entries) == arguments.traces and all(entry["frames"] == arguments.of_each for entry in entries)
                report(f"lake, {arguments.traces} traces, {workers} workers", cost, arguments.traces * arguments.of_each)
            report("compact", measured(sys.executable, "-m", "cantap.lake.command", "compact", folder / f"lake{arguments.workers[0]}"), arguments.traces * arguments.of_each)
            for step in ("decode", "convert"):
                each = []
                for database in arguments.database:
                    of_database = sorted((folder / "traces" / database.stem).iterdir())[: arguments.sample]
                    db = ["--db", database] if step == "decode" else []
                    out = ["-o", folder / "out.parquet"] if step == "decode" else [folder / "out.parquet"]
                    for trace in of_database:
                        each.append(measured(arguments.command, step, *db, trace, *out))
                        (folder / "out.parquet").unlink()
                report(f"cantap {step}, {len(each)} of them, one process each", (sum(cost[0] for cost in each), sum(cost[1] for cost in each), 0), len(each) * arguments.of_each)
        if arguments.large:
            trace, database = folder / f"large.{arguments.format}", arguments.database[0]
            large(trace, database, arguments.large, rng)
            part = f"{max(trace.stat().st_size // 8 >> 20, 1)}M"
            for workers, more in [(workers, ["--split", split]) for workers in arguments.workers for split in ("0", part)[: workers]]:
                lake = folder / f"large{workers}{more[1]}"
                temporary = folder / "temporary"
                temporary.mkdir(exist_ok=True)
                os.environ["TMPDIR"] = str(temporary)
                with Watched(temporary) as in_temporary, Watched(lake) as in_lake:
                    cost = add(lake, [trace], database, workers, *more)
                [entry] = Store(lake).entries()
                sizes = {"lake_mib": bytes_in(lake) >> 20, "most_in_lake_mib": in_lake.most >> 20, "most_in_tmpdir_mib": in_temporary.most >> 20}
                report(f"lake, {trace.stat().st_size >> 20} MiB, {workers} workers {' '.join(more)}", cost, entry["frames"], **sizes)
            if arguments.command == "-":
                cost = measured(sys.executable, "-c", SCAN, trace, database, folder / "out.parquet")
                report("cantap.scan, signals as one file", cost, entry["frames"])
                return
            for step, options, out in (("decode", ["--db", database], ["-o"]), ("convert", [], [])):
                report(f"cantap {step}", measured(arguments.command, step, *options, trace, *out, folder / "out.parquet"), entry["frames"])
                (folder / "out.parquet").unlink()


if __name__ == "__main__":
    main()
