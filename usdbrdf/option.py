"""What an option is: a field of a frozen dataclass with its names, unit, limits and meaning.

The Python API takes these dataclasses (``options``), the command line and its help are made of them
(``command_parser``). A value out of its limits is refused when they are made, by a UsageError.
"""

from __future__ import annotations

import math
import typing
import unicodedata
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, dataclass_transform

from usdbrdf.errors import UsageError

T = TypeVar("T")
REQUIRED: Any = MISSING


class Option(NamedTuple):
    """What is known of a field beside its type, its default and its meaning."""

    names: tuple[str, ...]  # such as -o and --output; one word for what needs no name
    unit: str  # of the value, or what kind of thing it is; "" for flags and choices
    limits: tuple[float, float]  # of a number, both allowed
    unset: str = ""  # what None, the default, amounts to
    counts: tuple[int, ...] = ()  # how many numbers make up a value
    file: bool = False  # a file must lie there before any work begins
    none: str = ""  # the word for None on the command line
    empty: bool = False  # an empty word is None, as a job gives it whose parameter has no value
    words: tuple[str, ...] = ()  # that may stand in the place of a file
    url: bool = False  # a text with :// in it may stand in the place of a path, and stays one
    one_line: bool = False  # lines of text and other machines hold it: no control characters
    joined: bool = False  # given again it says more: the texts become one, with commas between
    shared: str = ""  # title in help, of what several tasks have
    help: str = ""  # its meaning, if that is not below the field

    @property
    def name(self) -> str:
        return self.names[-1]

    @property
    def placed(self) -> bool:
        """Whether it is told by its place, without a name."""
        return not self.name.startswith("-")


def option(said: str, default: T, limits: Any = (-math.inf, math.inf), **more: Any) -> T:
    """A dataclass field with an ``Option``; ``said`` holds its names and its unit."""
    words = said.split()
    names = tuple(word for word in words if word.startswith("-")) or tuple(words[:1])
    told = Option(names, " ".join(words[len(names) :]), limits, **more)
    return field(default=default, metadata={"option": told})


def is_one_line(text: str) -> bool:
    """Whether no control character or line break of any kind is in it."""
    return not any(unicodedata.category(c) in ("Cc", "Zl", "Zp") for c in text)


class OptionField(NamedTuple):
    """A field of an option class: its type without None, and its option; without option, ``kind``
    is an option class too."""

    name: str
    kind: Any
    default: Any
    option: Option | None

    @property
    def choices(self) -> tuple[str, ...]:
        return typing.get_args(self.kind) if typing.get_origin(self.kind) is Literal else ()

    def check(self, value: Any, subject: str) -> None:
        """Raise UsageError for a value that is none of the choices or out of the limits."""
        if self.option is not None and self.option.one_line and not is_one_line(str(value)):
            raise UsageError(
                f"{self.option.name} {str(value)!r}: has a line break or another control character "
                "in it, which a farm's jobs and a cluster's addresses cannot hold. Rename it, or "
                "give another. [usage.option]"
            )
        if self.option is not None and self.option.words and not isinstance(value, Path):
            if value is not None and value not in self.option.words:
                words = " or ".join(self.option.words)
                raise UsageError(f"{subject}: expected {words}, or a Path. [usage.option]")
            return
        if value is None or self.option is None:
            return
        (low, high), counts = self.option.limits, self.option.counts
        usable, expected = value in self.choices, ", ".join(self.choices)
        if self.kind in (int, float) or counts:
            numbers = value if counts else (value,)
            usable = all(low <= n <= high and math.isfinite(n) for n in numbers)
            usable &= not counts or len(numbers) in counts
            expected = "a whole number" if self.kind is int else "a finite number"
            expected = f"{' or '.join(map(str, counts))} finite numbers" if counts else expected
            bounds = (("at least", low), ("at most", high))
            told = [f"{word} {n:,}" for word, n in bounds if math.isfinite(n)]
            expected += " of " * bool(told) + " and ".join(told)
        elif not self.choices:
            return
        if not usable:
            raise UsageError(f"{subject}: expected {expected}. [usage.option]")


def option_fields(owner: type[Options]) -> list[OptionField]:
    """All that can be said to an option class."""
    types, found = typing.get_type_hints(owner), []
    for item in fields(owner):
        kind = types[item.name]
        if typing.get_origin(kind) in (Union, UnionType):
            kind = next(part for part in typing.get_args(kind) if part is not type(None))
        found.append(OptionField(item.name, kind, item.default, item.metadata.get("option")))
    return found


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
@dataclass(frozen=True, kw_only=True)
class Options:
    """What option classes share: they are frozen dataclasses, whose values are checked when they
    are made."""

    def __init_subclass__(cls) -> None:
        dataclass(cls, frozen=True, kw_only=True)

    def __post_init__(self) -> None:
        for item in option_fields(type(self)):
            if item.option is not None:
                value = getattr(self, item.name)
                item.check(value, f"{item.option.name} {value}")
