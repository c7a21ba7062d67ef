"""Signals that come while a compiled library calls Python."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time

import pytest

from usdbrdf.job.interrupts import Terminated, interruptible

ENDS = [
    (signal.SIGTERM, Terminated),
    (signal.SIGINT, KeyboardInterrupt),
    (signal.SIGHUP, Terminated),
]


@pytest.fixture(autouse=True)
def _heard():
    """A shell that runs this in the background has its SIGINT ignored."""
    before = {number: signal.getsignal(number) for number, _ in ENDS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(("number", "ends"), ENDS)
def test_one_that_a_callback_swallows_comes_again(number, ends):
    """As itself: the others may be ignored."""
    for other in {number for number, _ in ENDS} - {number}:
        signal.signal(other, signal.SIG_IGN)

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


@pytest.mark.fault("R3")
@pytest.mark.parametrize(("number", "ends"), ENDS)
@pytest.mark.parametrize("explicit", [True, False])
def test_one_that_a_library_takes_for_its_own_failure_is_what_is_raised(number, ends, explicit):
    """As Mitsuba does while it renders: an error of its own, because of ours."""

    def library() -> None:
        try:
            os.kill(os.getpid(), number)
            time.sleep(10)
        except BaseException as cause:
            if explicit:
                raise RuntimeError("the callback failed") from cause
            raise RuntimeError("the callback failed")  # noqa: B904 (what a library may do)

    with pytest.raises(ends), interruptible():
        library()


def test_a_failure_without_one_is_what_it_is():
    with pytest.raises(RuntimeError, match="its own"), interruptible():
        raise RuntimeError("its own") from ValueError("and why")


@pytest.mark.fault("R3")
def test_a_terminal_that_is_closed_ends_a_run_as_a_signal_to_terminate_does(tmp_path):
    """Unless nohup has it ignored: then the run goes on."""
    code = """
import os, signal, sys
from usdbrdf.errors import UsdBrdfError
from usdbrdf.files.atomic import temporary_folder
from usdbrdf import cli
from pathlib import Path
if sys.argv[2] == "nohup":
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
def work(_arguments):
    with temporary_folder(Path(sys.argv[1]) / "made"):
        os.kill(os.getpid(), signal.SIGHUP)
    return 0
cli._run = work
sys.exit(cli.main([]))
"""
    for how, status in (("", 143), ("nohup", 0)):
        done = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path), how], capture_output=True, text=True
        )
        assert done.returncode == status, done.stderr
        assert not list(tmp_path.iterdir())
    assert "Traceback" not in done.stderr
