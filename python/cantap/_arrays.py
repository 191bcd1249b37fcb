"""Tables as NumPy arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from ._native import Table


def to_numpy(table: Table) -> dict[str, Any]:
    """The columns by name; missing values are masked."""
    return {name: _column(table, name) for name in table.column_names}


def _column(table: Table, name: str) -> Any:
    kind, raw, missing, texts, width = table._parts(name)
    values: Any = np.frombuffer(raw, dtype=kind)
    if kind == "uint8" and name == "data":
        values = values.reshape(len(table), width)
    if texts is not None:
        # A placeholder for rows without a text: they are masked.
        values = np.array([*texts, ""], dtype=object)[values]
    if missing is None:
        return values
    mask = np.frombuffer(missing, dtype=bool)
    if values.ndim == 2:
        mask = mask.reshape(values.shape)
    return np.ma.masked_array(values, mask=mask)
