"""What is told while a run works: a bar on a terminal or now and then a line in a log, on stderr;
results on stdout.

A reader that goes away, or a full disk behind stderr, never changes the work or its status.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any, TextIO, TypeVar

from usdbrdf.errors import EnvironmentFailure, UsdBrdfError

T = TypeVar("T")
_SECONDS_BETWEEN_LINES = 30.0
_quiet = False
_line_hearer: Callable[[str], None] | None = None


def fill_closed_streams() -> None:
    """Standard streams that are closed lead nowhere, before a file of ours takes their number and
    gets what some library prints."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


def keep_usd_off_stdout() -> None:
    """Take TF_DEBUG away before USD is loaded: it prints what that asks for among our results, and
    puts files into the current folder."""
    os.environ.pop("TF_DEBUG", None)


def set_quiet(quiet: bool) -> None:
    """Silence ``progress`` and ``say`` (the command line's -q)."""
    global _quiet
    _quiet = quiet


def tell_lines_to(hearer: Callable[[str], None] | None) -> None:
    """Give the lines in which ``progress`` tells how far it is to ``hearer``, where they go into a
    log; None: to stderr again."""
    global _line_hearer
    _line_hearer = hearer


def say(line: str) -> None:
    """One plain line to stderr unless quiet, above a running bar; newlines and control characters
    are shown, not obeyed."""
    if not _quiet:
        tell(in_one_line(line))


def tell(line: str) -> None:
    """The same for what must be said, quiet or not, in as many lines as it has."""
    if sys.stderr is None:
        return
    # No bar is running where it was never loaded.
    tqdm: Any = sys.modules.get("tqdm")
    try:
        if tqdm is None:
            sys.stderr.write(f"{printable(line)}\n")
            sys.stderr.flush()
        else:
            tqdm.tqdm.write(printable(line), file=sys.stderr)
    except (OSError, ValueError):  # the latter where it is closed
        _give_up(sys.stderr)


def show(text: str, *, whole: bool = False) -> None:
    """Lines to stdout. EnvironmentFailure where they cannot be written. A reader who goes away has
    seen enough, unless it is a program that needs the ``whole``: then UsdBrdfError."""
    if sys.stdout is None:  # closed from the start
        if whole:
            raise EnvironmentFailure("stdout is closed. [environment.output]")
        return
    try:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
    except OSError as error:
        _give_up(sys.stdout)
        left = isinstance(error, BrokenPipeError)
        if left and whole:
            raise UsdBrdfError("stdout: its reader went away. [environment.output]") from error
        if not left:
            raise EnvironmentFailure(
                f"stdout cannot be written ({error.strerror}). [environment.output]"
            ) from error


def _give_up(stream: TextIO) -> None:
    """Send what is left in a stream nowhere: the interpreter would try it once more at its end, and
    make a status of the failure."""
    with suppress(OSError, ValueError), open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def warn(sentence: str) -> None:
    """Say what was left out or may be wrong, and go on."""
    say(f"warning: {sentence}")


def progress(iterable: Iterable[T], *, total: int, label: str, unit: str) -> Iterator[T]:
    """The same items; ``unit`` is a plural noun ("frames"). stdout is never touched."""
    if _quiet or sys.stderr is None:
        yield from iterable
    elif sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(
            iterable, total=total, desc=printable(label), unit=f" {unit}", file=sys.stderr
        )
    else:
        start = time.monotonic()
        due = start + _SECONDS_BETWEEN_LINES
        for done, item in enumerate(iterable):
            if (now := time.monotonic()) >= due:
                line = f"{label}: {done} of {total} {unit}{_left(now - start, done, total)}"
                (_line_hearer or say)(line)
                due = now + _SECONDS_BETWEEN_LINES
            yield item


def _left(seconds: float, done: int, total: int) -> str:
    """How much longer it takes, if it goes on like this; the first items tell little."""
    if done < 2:
        return ""
    left = seconds / done * (total - done)
    return f", about {left:.0f} s left" if left < 100 else f", about {left / 60:.0f} min left"


def in_one_line(text: str) -> str:
    """The text with newlines escaped, too: a sentence that quotes a name, or words of a library,
    stays one."""
    return text.replace("\n", "\\n")


def printable(text: str) -> str:
    """The text with control characters escaped, but for newlines and tabs."""
    return "".join(
        char if char.isprintable() or char in "\n\t" else char.encode("unicode_escape").decode()
        for char in text
    )
