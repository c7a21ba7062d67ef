"""What is asked of the machine before anything is loaded."""

from __future__ import annotations

import os
import threading

import pytest

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.compiler import refuse_unusable_settings
from usdbrdf.job.processes import refuse_few_threads

THREADS = "OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS", "PXR_WORK_THREAD_LIMIT"


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch):
    for name in ("NUMBA_DISABLE_JIT", "NUMBA_NUM_THREADS", *THREADS):
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


def test_settings_in_the_current_folder_that_numba_does_not_read(tmp_path, monkeypatch):
    """Without PyYAML, which nothing of ours needs, and in a folder that is closed to us."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / ".numba_config.yaml").write_text("DISABLE_JIT: 1")
    monkeypatch.setattr("usdbrdf.job.compiler.find_spec", lambda name: None, raising=False)
    refuse_unusable_settings()
    (tmp_path / ".numba_config.yaml").unlink()

    def closed(self, **_):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr("pathlib.Path.stat", closed)
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


@pytest.mark.parametrize(
    ("cores", "settings", "asked"),
    [
        (3, {}, 6),
        (256, {}, 64 + 256),
        (128, {"OPENBLAS_NUM_THREADS": "1", "PXR_WORK_THREAD_LIMIT": "2"}, 1 + 2),
        (128, {"OPENBLAS_NUM_THREADS": "no", "OMP_NUM_THREADS": "8"}, 8 + 128),
        (4, {"OMP_NUM_THREADS": "16", "PXR_WORK_THREAD_LIMIT": "-3"}, 4 + 1),
        (4, {"OMP_NUM_THREADS": "0", "PXR_WORK_THREAD_LIMIT": "-9"}, 4 + 1),
        (2, {"PXR_WORK_THREAD_LIMIT": "8"}, 2 + 2),
    ],
)
def test_no_more_threads_are_asked_for_than_the_libraries_start(
    monkeypatch, cores, settings, asked
):
    """A limit under which these work, as they are told to start few, is none for us."""
    started = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    monkeypatch.setattr(threading.Thread, "start", lambda thread: started.append(thread))
    monkeypatch.setattr(threading.Thread, "join", lambda _: None)
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    refuse_few_threads()
    assert len(started) == asked
