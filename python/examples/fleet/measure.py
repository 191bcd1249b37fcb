"""Measures the job on this machine: `python measure.py TRACE DATABASE --traces 20 40 80 --workers 2`.

Fleets of these sizes are made of copies of one trace, ten for each vehicle, and decoded by a Spark cluster of worker processes here. Prints seconds of
the decoding, and the processor seconds of everything that took part: on a machine that others use as well only those can be compared.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

from cantap_fleet import command
from pyspark.sql import SparkSession

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Processor(threading.Thread):
    """Processor seconds of all processes below this one, including those that have ended. Processes that run only between two samples are missed."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._used: dict[tuple[int, str], float] = {}
        self._over = threading.Event()

    def run(self) -> None:
        while not self._over.wait(0.2):
            self.look()

    def look(self) -> None:
        """Records what each has used so far."""
        parents: dict[int, int] = {}
        used: dict[int, tuple[str, float]] = {}
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                # proc(5): after the name in brackets come the state, the parent, and as 14th and 15th field the time.
                fields = (folder / "stat").read_text().rsplit(") ", 1)[1].split()
            except (OSError, IndexError):
                continue
            number = int(folder.name)
            parents[number] = int(fields[1])
            used[number] = (fields[19], (int(fields[11]) + int(fields[12])) / _TICKS_PER_S)
        below = {os.getpid()}
        while more := {number for number, parent in parents.items() if parent in below} - below:
            below |= more
        for number in below & used.keys():
            # With its start time: process numbers are reused.
            start, seconds = used[number]
            self._used[number, start] = seconds

    def seconds(self) -> float:
        """The total so far."""
        self.look()
        return sum(list(self._used.values()))


def make(folder: Path, trace: Path, database: Path, traces: int) -> None:
    """A fleet of copies."""
    shutil.copy(database, folder / "car.dbc")
    (folder / "vehicles.csv").write_text("vehicle,databases,bitrate\n*,car.dbc,500000\n")
    suffixes = "".join(trace.suffixes)
    for number in range(traces):
        vehicle = folder / f"{number // 10:04}"
        vehicle.mkdir(exist_ok=True)
        shutil.copy(trace, vehicle / f"drive{number % 10}{suffixes}")


def main() -> int:
    """Measures once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trace", type=Path)
    parser.add_argument("database", type=Path)
    parser.add_argument("--traces", type=int, nargs="+", default=[20, 40, 80])
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    os.environ["PYSPARK_PYTHON"] = sys.executable
    with tempfile.TemporaryDirectory(prefix="cantap-fleet-") as name:
        folder = Path(name)
        processor = Processor()
        processor.start()
        spark = (
            SparkSession.builder.master(f"local-cluster[{chosen.workers},1,1024]")
            .config("spark.ui.enabled", "false")
            .config("spark.ui.showConsoleProgress", "false")
            .getOrCreate()
        )
        spark.sparkContext.setLogLevel("ERROR")
        failed = 0
        # This excludes what a cluster does only once: starting workers, compiling code.
        for number, traces in enumerate((8, *chosen.traces)):
            fleet = folder / f"fleet{number}"
            fleet.mkdir()
            make(fleet, chosen.trace, chosen.database, traces)
            begin, used = time.monotonic(), processor.seconds()
            failed |= command.run(spark, ["decode", str(fleet), str(folder / "out")])
            seconds, used = time.monotonic() - begin, processor.seconds() - used
            shutil.rmtree(folder / "out", ignore_errors=True)
            print(
                f"{'' if number else 'warming up: '}{traces} traces, {chosen.workers} workers: {seconds:.1f} s, "
                f"{traces / seconds:.2f} traces/s; {used:.1f} processor seconds, {traces / used:.2f} traces per second and core",
                flush=True,
            )
        spark.stop()
    return failed


if __name__ == "__main__":
    sys.exit(main())
