"""What a program that is checked with `mypy --strict` may pass and gets: checked by `cargo xtask ci --only python`, and never run."""

import datetime
from typing import Any

import cantap
import numpy as np
import pandas as pd
import polars as pl
from typing_extensions import assert_type

moment = np.datetime64("2026-03-01T12:00:00")
table = cantap.read("drive.blf", start=moment, end=np.timedelta64(10, "s"), channel=np.uint8(1))
cantap.read("drive.blf", start=datetime.timedelta(seconds=1), end=np.float64(2.5), channel=[0, np.int64(1)])
cantap.decode("drive.blf", {np.uint8(0): "car.dbc"}, start=np.int64(3))
cantap.stats("drive.blf", {1: 500_000}, data_bitrate=np.int64(2_000_000))
assert_type(table.to_polars(), pl.DataFrame)
frame: pd.DataFrame = table.to_pandas()
for name, column in table.to_numpy().items():
    assert_type(name, str)
    assert_type(column.size, int)
speed = table["Speed"]
assert_type(speed, cantap.Column)
assert_type(speed[2:4], cantap.Column)
assert_type(table[2:4], cantap.Table)
assert_type(table[["time", "Speed"]], cantap.Table)
assert_type(table.schema["time"], str)
assert_type(table[0], cantap.Row)
for row in cantap.search("drive.blf", id=[0x123, "18FEF1??"]):
    assert_type(row, cantap.Row)
said = cantap.conversations("drive.blf", protocol=["uds", "obd"], fields="uds.*", db="car.dbc", start=moment)
assert_type(said, cantap.Table)
assert_type(cantap.write(said, "drive.mcap", db="car.dbc", signals=["Speed"]), dict[str, int])
with cantap.open("virtual") as device:
    for table in device.conversations(0.5, protocol="j1939"):
        assert_type(table, cantap.Table)
assert_type(cantap.selftest("virtual", load_time="1s")["passed"], Any)
