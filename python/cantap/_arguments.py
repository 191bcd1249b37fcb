"""Arguments that may be one thing or several, and texts in the command's grammar (docs/grammar.md)."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from typing import Any, SupportsIndex

ALL = ("both", "all")
"""All channels, as the command's `-c` has it."""


def channels(channel: str | SupportsIndex | Iterable[str | SupportsIndex], every: Iterable[int] = ()) -> list[Any]:
    """One channel or several, as numbers or texts, which the compiled half reads; `every` if all are wanted."""
    if isinstance(channel, str):
        return list(every) if channel in ALL else channel.split(",")
    one: Any = channel
    try:
        # NumPy's numbers are no `int`, but can be used as one. So could its arrays, by their type.
        return [operator.index(one)]
    except TypeError:
        pass
    several = _several(channel, "channel", "a number, a text such as 'can0', or several of them")
    return [number if isinstance(number, str) else _index(number, "channel") for number in several]


def rates(rates: Any, argument: str) -> list[tuple[Any, Any]]:
    """Bit rates, each with its channel, or `None` for all: a number, texts such as `500k` and `2:250k`, or a mapping from channels."""
    if rates is None:
        return []
    if isinstance(rates, Mapping):
        return list(rates.items())
    several = rates if isinstance(rates, (list, tuple)) else [rates]
    return [_rate(rate, argument) for rate in several]


def _rate(rate: Any, argument: str) -> tuple[Any, Any]:
    if isinstance(rate, str):
        channel, colon, number = rate.rpartition(":")
        return (channel, number) if colon else (None, rate)
    if isinstance(rate, (SupportsIndex, float)):
        return None, rate
    raise TypeError(f"{argument} is a number, a text such as '500k', or one for each channel in a mapping, not {type(rate).__name__}")


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


def _index(number: Any, argument: str) -> int:
    try:
        return operator.index(number)
    except TypeError:
        raise TypeError(f"{argument} is a number or a text, not {type(number).__name__}") from None


def _several(values: Any, argument: str, wanted: str) -> list[Any]:
    if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        raise TypeError(f"{argument} is {wanted}, not {type(values).__name__}")
    return list(values)
