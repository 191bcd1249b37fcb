"""The command line."""

from __future__ import annotations

import argparse
import atexit
import re
import shutil
import sys
import tempfile
import zipfile
from importlib import resources
from pathlib import Path

from cantap.lake.ledger import FAILED, REFUSED
from pyspark.sql import SparkSession

from . import dataset, questions
from .dataset import AccountError
from .inputs import InputError
from .worker import Settings

_UNITS = {"": 1, "k": 1 << 10, "m": 1 << 20, "g": 1 << 30}


def _bytes(text: str) -> int:
    found = re.fullmatch(r"(\d+)([kmg]?)", text.lower())
    if not found or int(found[1]) == 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a size; write 64M or 2G")
    return int(found[1]) * _UNITS[found[2]]


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"'{text}' is not a time; give seconds, more than 0")
    return seconds


def _number(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    if name not in {name for numbers in questions.QUESTIONS.values() for name in numbers}:
        raise argparse.ArgumentTypeError(f"no question has a number '{name}'; the numbers are speed, pressure")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number; write {name}=80") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="job.py", description="Decodes the traces of a fleet, and asks what they say.")
    commands = parser.add_subparsers(dest="command", required=True)
    decode = commands.add_parser("decode", help="make a dataset out of a folder of traces")
    decode.add_argument("input", help="the folder, of any file system that Spark has: a folder for each vehicle in it")
    decode.add_argument("output", help="a new folder for the dataset")
    decode.add_argument("--vehicles", metavar="FILE", help="what is known about the vehicles [default: INPUT/vehicles.csv]")
    decode.add_argument("--signal", metavar="PATTERN", action="append", default=[], help="only these signals; can be repeated")
    decode.add_argument("--zone", help="of dates in traces that name none, such as Europe/Berlin [default: UTC]")
    decode.add_argument(
        "--task-bytes", metavar="SIZE", type=_bytes, default="64M", help="how much small traces of one task have together [default: 64M]"
    )
    decode.add_argument(
        "--timeout", metavar="SECONDS", type=_seconds, default=3600.0, help="longest time for one trace [default: 3600]"
    )
    ask = commands.add_parser("ask", help="put the questions to a dataset")
    ask.add_argument("dataset", help="what decode made")
    ask.add_argument("question", nargs="*", help=f"{', '.join(questions.QUESTIONS)} [default: all]")
    ask.add_argument("--set", metavar="NAME=NUMBER", type=_number, action="append", default=[], help="such as speed=80")
    ask.add_argument("--save", metavar="FOLDER", help="write each answer there as Parquet instead of showing its first rows")
    return parser


def ship(spark: SparkSession) -> None:
    """Sends this package to the workers, wherever it comes from; a session that already has it keeps it."""
    name = f"{__package__}.zip"
    if any(file.endswith(name) for file in spark.sparkContext.listFiles):
        return
    folder = tempfile.mkdtemp(prefix="cantap-fleet-")
    # Spark serves the file from its place, as long as the driver runs.
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    with zipfile.ZipFile(Path(folder) / name, "w") as archive:
        for part in sorted(resources.files(__package__).iterdir(), key=lambda part: part.name):
            if part.name.endswith(".py"):
                archive.writestr(f"{__package__}/{part.name}", part.read_bytes())
    spark.sparkContext.addPyFile(str(Path(folder) / name))


def _decode(spark: SparkSession, arguments: argparse.Namespace) -> int:
    dataset.refuse_existing(spark, arguments.output)
    work = dataset.plan(spark, arguments.input, arguments.vehicles)
    settings = Settings(tuple(arguments.signal), arguments.zone, arguments.timeout)
    states = dataset.write(spark, work, settings, arguments.output, arguments.task_bytes)
    words = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
    print(f"{states.total()} traces: {words}. Problems are listed in {arguments.output}/ledger")
    # A job that could not decode anything is not a success.
    return 1 if states[REFUSED] + states[FAILED] == states.total() else 0


def _ask(spark: SparkSession, arguments: argparse.Namespace) -> int:
    for question in arguments.question:
        if question not in questions.QUESTIONS:
            raise InputError(f"there is no question '{question}'; there are {', '.join(questions.QUESTIONS)}")
    questions.open_dataset(spark, arguments.dataset)
    for question in arguments.question or questions.QUESTIONS:
        answer = questions.ask(spark, question, dict(arguments.set))
        if arguments.save:
            answer.coalesce(1).write.parquet(f"{arguments.save.rstrip('/')}/{question}")
        else:
            print(question)
            answer.show(20, truncate=False)
    return 0


def run(spark: SparkSession, arguments: list[str] | None = None) -> int:
    """Runs the job in an existing session; the exit code is 1 for failure, and a wrong command line ends the program with 2."""
    return _run(spark, _chosen(arguments))


def _chosen(arguments: list[str] | None) -> argparse.Namespace:
    chosen = _parser().parse_args(arguments)
    for name in ("input", "output", "dataset"):
        if hasattr(chosen, name):
            setattr(chosen, name, getattr(chosen, name).rstrip("/") or "/")
    return chosen


def _run(spark: SparkSession, chosen: argparse.Namespace) -> int:
    # Hours and days are UTC, wherever the driver is.
    spark.conf.set("spark.sql.session.timeZone", "UTC")
    try:
        ship(spark)
        return _decode(spark, chosen) if chosen.command == "decode" else _ask(spark, chosen)
    except (InputError, AccountError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def main(arguments: list[str] | None = None) -> int:
    """The entry point for `spark-submit`."""
    # A wrong command line is reported before Spark starts.
    chosen = _chosen(arguments)
    spark = SparkSession.builder.appName("cantap-fleet").getOrCreate()
    try:
        return _run(spark, chosen)
    finally:
        spark.stop()
