"""Questions to a dataset: the SQL beside this file."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources

from pyspark.sql import DataFrame, SparkSession

from cantap.lake import columns, ledger

from . import dataset
from .inputs import InputError

#: The questions, and their adjustable parameters.
QUESTIONS: dict[str, dict[str, float]] = {
    "period_jitter": {},
    "condition": {"speed": 120.0, "pressure": 50.0},
    "bus_load": {},
}


def open_dataset(spark: SparkSession, output: str) -> None:
    """Makes `frames`, `signals`, `vehicles` and `ledger` available as SQL tables."""
    try:
        ledger_table = spark.read.schema(ledger.DDL).parquet(f"{output}/ledger")
    except Exception as error:
        # Spark has a single class for all errors in a query.
        if "PATH_NOT_FOUND" not in str(error):
            raise
        raise InputError(f"{output} has no ledger: its job did not end; delete it and run that again") from None
    ledger_table.createOrReplaceTempView("ledger")
    spark.read.parquet(f"{output}/vehicles").createOrReplaceTempView("vehicles")
    dataset.read(spark, output, "frames", columns.FRAMES).createOrReplaceTempView("frames")
    dataset.read(spark, output, "signals", columns.SIGNALS).createOrReplaceTempView("signals")


def ask(spark: SparkSession, question: str, numbers: Mapping[str, float] | None = None) -> DataFrame:
    """The answer to one of the questions, for an open dataset."""
    text = resources.files(__package__).joinpath("sql", f"{question}.sql").read_text()
    known = QUESTIONS[question]
    chosen = {name: number for name, number in (numbers or {}).items() if name in known}
    return spark.sql(text, args=known | chosen)
