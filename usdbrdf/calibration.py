"""Numbers that were fitted or chosen, and are neither mathematics nor a format's limit.

``calibration.json`` beside this file holds them with ``value``, ``unit``, ``meaning``, ``on`` (the
captures or the judgement that they rest on), ``by`` (the program that measured them, if one did)
and ``date``. Modules read them at import, so that kernels freeze them. What is measured on a
capture that calibrated a number says little about that number: see ``on`` before trusting it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any


def number(name: str) -> float:
    """The value of one entry, in its ``unit``."""
    value = entries()[name]["value"]
    if not isinstance(value, float):
        raise TypeError(f"{name}: {value!r} is no number with a decimal point. [calibration.type]")
    return value


def count(name: str) -> int:
    """The value of an entry that counts things."""
    value = entries()[name]["value"]
    if not isinstance(value, int):
        raise TypeError(f"{name}: {value!r} is no whole number. [calibration.type]")
    return value


def numbers(name: str) -> tuple[float, ...]:
    """The values of an entry that has several, in the order that its ``meaning`` tells."""
    return tuple(float(value) for value in entries()[name]["value"])


def pair(name: str) -> tuple[float, float]:
    """The two values of an entry, such as (mean, standard deviation)."""
    first, second = numbers(name)
    return first, second


def pairs(name: str) -> Mapping[str, tuple[float, float]]:
    """The table of an entry, word -> two values; it cannot be changed."""
    table = entries()[name]["value"]
    return MappingProxyType({word: (float(a), float(b)) for word, (a, b) in table.items()})


@cache
def entries() -> Mapping[str, Mapping[str, Any]]:
    """All entries as they stand in the file, by name."""
    text = Path(__file__).with_suffix(".json").read_text("utf-8")
    return MappingProxyType(json.loads(text))
