"""What a waiting person sees: a bar on a terminal, now and then a plain line in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")

_SECONDS_BETWEEN_LINES = 30.0

_quiet = False


def set_quiet(quiet: bool) -> None:
    """Silence ``progress`` and ``say`` (the command line's -q)."""
    global _quiet
    _quiet = quiet


def say(line: str) -> None:
    """One plain line to stderr, above a running bar; control characters are shown, not obeyed."""
    if _quiet or sys.stderr is None:
        return
    tqdm.write(printable(line), file=sys.stderr)


def warn(sentence: str) -> None:
    """Say what was left out or may be wrong, and go on."""
    say(f"warning: {sentence}")


def progress(iterable: Iterable[T], *, total: int, label: str, unit: str) -> Iterator[T]:
    """The same items; ``unit`` is a plural noun ("frames"). stdout is never touched."""
    if _quiet or sys.stderr is None:
        yield from iterable
    elif sys.stderr.isatty():
        yield from tqdm(
            iterable, total=total, desc=printable(label), unit=f" {unit}", file=sys.stderr
        )
    else:
        yield from _with_lines(iterable, total, label, unit)


def _with_lines(iterable: Iterable[T], total: int, label: str, unit: str) -> Iterator[T]:
    due = time.monotonic() + _SECONDS_BETWEEN_LINES
    for done, item in enumerate(iterable):
        if time.monotonic() >= due:
            say(f"{label}: {done} of {total} {unit}")
            due = time.monotonic() + _SECONDS_BETWEEN_LINES
        yield item


def printable(text: str) -> str:
    """The text with control characters escaped, but for newlines and tabs."""
    return "".join(
        char if char.isprintable() or char in "\n\t" else char.encode("unicode_escape").decode()
        for char in text
    )
