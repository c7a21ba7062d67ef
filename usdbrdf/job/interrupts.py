"""SIGINT, SIGTERM and SIGHUP as exceptions, which end a run where its work can be gone on with."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import NoReturn

# The last comes where a terminal is closed, or a connection to it breaks; not under nohup.
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Seconds until one that was swallowed comes again: by then whatever did so has returned.
_AGAIN = 0.05


class Terminated(BaseException):
    """SIGTERM or SIGHUP came. Not an Exception: nothing on the way may take it for a failure."""

    def __init__(self, number: int = signal.SIGTERM) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def interruptible() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt, the others ``Terminated`` in here, as far as they are not
    ignored; the handlers before are back afterwards.

    Compiled libraries call Python where they cannot pass an exception on: they print it and carry
    on. One that ends there comes again. Others fail because of it, with an error of their own:
    what is raised is the exception that came."""

    def interrupt(number: int, _frame: object) -> NoReturn:
        raise KeyboardInterrupt if number == signal.SIGINT else Terminated(number)

    before = {number: signal.getsignal(number) for number in _SIGNALS}
    replaced = {number: old for number, old in before.items() if old is not signal.SIG_IGN}
    for number in replaced:
        signal.signal(number, interrupt)
    try:
        with _coming_again():
            yield
    except Exception as error:
        if (ending := _behind(error)) is not None:
            raise ending from None
        raise
    finally:
        for number, handler in replaced.items():
            signal.signal(number, handler)


def _behind(error: BaseException) -> BaseException | None:
    """The exception of ours that another was raised because of, or while it was handled."""
    seen: list[BaseException] = []
    behind: BaseException | None = error
    while behind is not None and behind not in seen:
        if isinstance(behind, (KeyboardInterrupt, Terminated)):
            return behind
        seen.append(behind)
        behind = behind.__cause__ or behind.__context__
    return None


@contextmanager
def _coming_again() -> Iterator[None]:
    """An exception of ours that somebody hands to Python's hooks, for he cannot pass it on, is
    raised again."""
    printed, ignored = sys.excepthook, sys.unraisablehook
    waiting: list[threading.Timer] = []

    def again(value: BaseException | None) -> bool:
        if not isinstance(value, (KeyboardInterrupt, Terminated)):
            return False
        # As the signal that it was: another may be ignored.
        number = value.number if isinstance(value, Terminated) else signal.SIGINT
        later = threading.Timer(_AGAIN, _thread.interrupt_main, (number,))
        later.daemon = True
        waiting.append(later)
        later.start()
        return True

    def excepthook(
        kind: type[BaseException], value: BaseException, trace: TracebackType | None
    ) -> None:
        if not again(value):
            printed(kind, value, trace)

    def unraisablehook(told: sys.UnraisableHookArgs) -> None:
        if not again(told.exc_value):
            ignored(told)

    sys.excepthook, sys.unraisablehook = excepthook, unraisablehook
    try:
        yield
    finally:
        for later in waiting:
            later.cancel()
        sys.excepthook, sys.unraisablehook = printed, ignored


@contextmanager
def loading() -> Iterator[None]:
    """Hold signals back while modules are loaded, which may swallow the exception or take it for a
    failure of their own."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
