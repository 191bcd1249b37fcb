"""Arguments that may be one thing or several."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any, SupportsIndex


def channels(channel: SupportsIndex | Iterable[SupportsIndex]) -> list[int]:
    """One channel or several."""
    one: Any = channel
    try:
        # NumPy's numbers are no `int`, but can be used as one. So could its arrays, by their type.
        return [operator.index(one)]
    except TypeError:
        pass
    return _several(channel, "channel", "a number or several numbers")


def words(words: str | Iterable[str], argument: str) -> list[str]:
    """One text or several; `argument` is what they are called."""
    return [words] if isinstance(words, str) else _several(words, argument, "a text or several texts")


def identifiers(ids: str | SupportsIndex | Iterable[str | SupportsIndex], argument: str) -> list[str]:
    """One identifier or several, as patterns in hexadecimal digits or as numbers."""
    one: Any = ids
    several: list[Any]
    try:
        several = [operator.index(one)]
    except TypeError:
        several = [ids] if isinstance(ids, str) else _several(ids, argument, "a text, a number, or several of them")
    return [one if isinstance(one, str) else _digits(operator.index(one), argument) for one in several]


def _digits(number: int, argument: str) -> str:
    if not 0 <= number <= 0x1FFF_FFFF:
        raise ValueError(f"{argument}: {number:#x} is not an identifier; they go up to 0x1FFFFFFF")
    return f"{number:03X}" if number <= 0x7FF else f"{number:08X}"


def _several(values: Any, argument: str, wanted: str) -> list[Any]:
    if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        raise TypeError(f"{argument} is {wanted}, not {type(values).__name__}")
    return list(values)
