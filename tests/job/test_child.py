"""A child that crashes, hangs, runs out of memory or refuses its input is told apart."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from usdbrdf.errors import EnvironmentFailure, InputRefused, UsdBrdfError
from usdbrdf.job.child import run_child

CHILDREN = """
import os, signal, sys, time
import numpy as np
from usdbrdf.errors import InputRefused, UsageError

def double(arrays, parameters):
    print("chatter on stdout")
    return {name: array * parameters["factor"] for name, array in arrays.items()}

def die(arrays, parameters):
    print("about to die", file=sys.stderr, flush=True)
    os.kill(os.getpid(), getattr(signal, parameters["signal"]))

def hang(arrays, parameters):
    grandchild = os.fork()
    if grandchild:
        with open(parameters["note"], "w") as file:
            file.write(str(grandchild))
    time.sleep(60)

def refuse(arrays, parameters):
    raise InputRefused("mesh: no triangles. [mesh.empty]")

def broken(arrays, parameters):
    return {"x": 1 / 0}

def hungry(arrays, parameters):
    return {"x": np.ones(1 << 32)}

def objects(arrays, parameters):
    return {"x": np.array([object()])}
"""


@pytest.fixture
def child(tmp_path, monkeypatch):
    (tmp_path / "toy_children.py").write_text(CHILDREN)
    monkeypatch.syspath_prepend(str(tmp_path))

    def run(name, arrays=None, timeout_s=30.0, memory_limit_bytes=None, **parameters):
        return run_child(
            f"toy_children:{name}",
            arrays or {},
            parameters,
            timeout_s,
            "unwrap of <chair>",
            memory_limit_bytes=memory_limit_bytes,
        )

    return run


def test_arrays_there_and_back(child, capfd):
    given = {"file": np.arange(6.0).reshape(2, 3), "faces": np.zeros((0, 3), np.int32)}
    got = child("double", given, factor=2)
    assert list(got) == ["file", "faces"]
    assert np.array_equal(got["file"], given["file"] * 2)
    assert got["faces"].dtype == np.int32
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT", "SIGFPE"])
def test_crash_is_a_refused_input(child, name):
    expected = rf"^unwrap of <chair> crashed \({name}\).+about to die.+\[child\.crashed\]$"
    with pytest.raises(InputRefused, match=expected):
        child("die", signal=name)


def test_kill_from_outside_is_the_environment(child):
    with pytest.raises(EnvironmentFailure, match=r"out of memory.+\[child\.killed\]"):
        child("die", signal="SIGKILL")


def test_hang_is_stopped_with_all_that_it_started(child, tmp_path):
    started = time.monotonic()
    with pytest.raises(InputRefused, match=r"did not end within 2 s.+\[child\.timeout\]"):
        child("hang", timeout_s=2, note=str(tmp_path / "pid"))
    assert time.monotonic() - started < 10
    assert _ended(int((tmp_path / "pid").read_text()))


def _ended(pid):
    """Whether a process is gone, or a zombie that its new parent has not collected."""
    for _ in range(50):
        try:
            os.kill(pid, 0)
            status = Path(f"/proc/{pid}/status")
            if status.is_file() and "State:\tZ" in status.read_text():
                return True
        except (ProcessLookupError, FileNotFoundError):
            return True
        time.sleep(0.1)
    return False


def test_error_keeps_its_class_and_words(child):
    with pytest.raises(InputRefused, match=r"^mesh: no triangles\. \[mesh\.empty\]$"):
        child("refuse")


@pytest.mark.parametrize(("name", "what"), [("broken", "ZeroDivision"), ("objects", "ValueError")])
def test_bug_in_a_child_is_a_bug(child, name, what):
    with pytest.raises(UsdBrdfError, match=rf"failed: {what}.+\[child\.failed\]$") as caught:
        child(name)
    assert type(caught.value) is UsdBrdfError
    assert "Traceback" in str(caught.value.__cause__)


def test_memory_limit(child):
    with pytest.raises(EnvironmentFailure, match=r"out of memory"):
        child("hungry", memory_limit_bytes=8 << 30)


def test_pickled_arrays_do_not_leave(child):
    with pytest.raises(ValueError, match="Object arrays"):
        child("double", {"x": np.array([object()])}, factor=1)
