"""Signals that come while a compiled library calls Python."""

from __future__ import annotations

import ctypes
import os
import signal
import time

import pytest

from usdbrdf.job.interrupts import Terminated, interruptible

ENDS = [(signal.SIGTERM, Terminated), (signal.SIGINT, KeyboardInterrupt)]


@pytest.fixture(autouse=True)
def _heard():
    """A shell that runs this in the background has its SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("number", "ends"), ENDS)
def test_one_that_a_callback_swallows_comes_again(number, ends):
    @ctypes.CFUNCTYPE(None)
    def from_outside() -> None:
        os.kill(os.getpid(), number)
        time.sleep(1)

    @interruptible()
    def run() -> None:
        from_outside()  # which returns: nothing can be raised through it
        while time.monotonic() < started + 200:
            time.sleep(0.01)

    started = time.monotonic()
    with pytest.raises(ends):
        run()
    assert time.monotonic() < started + 100


def test_the_handlers_before_are_back():
    before = [signal.getsignal(number) for number, _ in ENDS]
    with interruptible():
        assert [signal.getsignal(number) for number, _ in ENDS] != before
    assert [signal.getsignal(number) for number, _ in ENDS] == before
