"""What is asked of the machine before anything is loaded."""

from __future__ import annotations

import os
import threading

import pytest

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.compiler import refuse_unusable_settings
from usdbrdf.job.processes import refuse_few_threads


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch):
    for name in ("NUMBA_DISABLE_JIT", "NUMBA_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize(
    ("name", "value", "refused"),
    [
        ("NUMBA_DISABLE_JIT", "1", True),
        ("NUMBA_DISABLE_JIT", "-1", True),
        ("NUMBA_DISABLE_JIT", "0", False),
        ("NUMBA_DISABLE_JIT", "", False),
        ("NUMBA_DISABLE_JIT", "yes", False),  # numba takes it for its default as well
        ("NUMBA_NUM_THREADS", "0", True),
        ("NUMBA_NUM_THREADS", "-2", True),
        ("NUMBA_NUM_THREADS", "1", False),
        ("NUMBA_NUM_THREADS", "2", False),
        ("NUMBA_NUM_THREADS", "all", False),
    ],
)
def test_settings_of_the_compiler(monkeypatch, name, value, refused):
    refuse_unusable_settings()
    monkeypatch.setenv(name, value)
    if not refused:
        refuse_unusable_settings()
        return
    with pytest.raises(EnvironmentFailure, match=rf"^{name} is .*\[environment\.compiler\]$"):
        refuse_unusable_settings()


@pytest.mark.parametrize("granted", [0, 1, 5, 6, 100])
def test_three_cores_want_six_threads_which_are_gone_afterwards(monkeypatch, granted):
    start, started = threading.Thread.start, []

    def limited(thread):
        if len(started) == granted:
            raise RuntimeError("can't start new thread")
        start(thread)
        started.append(thread)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 5, 7}, raising=False)
    monkeypatch.setattr(threading.Thread, "start", limited)
    if granted < 6:
        with pytest.raises(RuntimeError, match="can't start"):
            refuse_few_threads()
    else:
        refuse_few_threads()
    assert len(started) == min(granted, 6)
    assert not any(thread.is_alive() for thread in started)
