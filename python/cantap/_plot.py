"""Plots of tables, with Matplotlib."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ._native import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOT_SIGNALS = ("time", "channel", "id")


def plot(table: Table, signals: Iterable[str], axes: Axes | None, options: dict[str, Any]) -> Axes:
    """Signals over time, as steps: a value holds until the next one."""
    if axes is None:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots()
    options = {"drawstyle": "steps-post", **options}
    units = []
    for label, unit, time, values in _series(table, list(signals)):
        axes.plot(time, values, label=f"{label} [{unit}]" if unit else label, **options)
        units.append(unit)
    axes.set_xlabel("time (UTC)")
    if len(set(units)) == 1 and units[0]:
        axes.set_ylabel(units[0])
    axes.legend()
    return axes


def _series(table: Table, signals: list[str]) -> list[tuple[str, str, Any, Any]]:
    if all(name in table for name in ("signal", "value", "time")):
        return _of_values(table, signals)
    if "time" not in table:
        raise ValueError("this table has no time to plot over")
    numeric = [name for name in table.column_names if name not in NOT_SIGNALS and table.schema[name] == "float64"]
    if not numeric and not signals:
        raise ValueError("this table has no signals; read it with db=, or use cantap.decode")
    for signal in signals:
        if signal not in table:
            raise ValueError(f"there is no signal '{signal}'; there are {', '.join(numeric)}")
    time = np.asarray(table["time"])
    return [
        (name, table.column_metadata(name).get("unit", ""), time, np.asarray(table[name], dtype=float))
        for name in signals or numeric
    ]


def _of_values(table: Table, signals: list[str]) -> list[tuple[str, str, Any, Any]]:
    """Of a table with a row for each value."""
    columns = {name: np.asarray(table[name]) for name in ("time", "signal", "message", "value", "unit")}
    there = sorted({signal for signal in columns["signal"] if signal is not None})
    for signal in signals:
        if signal not in there:
            raise ValueError(f"there is no signal '{signal}'; there are {', '.join(there)}")
    series = []
    for signal in signals or there:
        rows = columns["signal"] == signal
        units = {unit for unit in columns["unit"][rows] if unit is not None}
        unit = units.pop() if len(units) == 1 else ""
        series.append((signal, unit, columns["time"][rows], columns["value"][rows].astype(float)))
    return series
