"""What is compiled beside a first run is what the run needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.scenes import make_capture, poses_down_and_up
from usdbrdf.job import first_run
from usdbrdf.job.first_run import compiling_beside
from usdbrdf.warm_up import _write_capture

ROOT = Path(__file__).resolve().parents[2]
_COUNT = """
import json, sys
from numba.core import event
compiled = []
class Heard(event.Listener):
    def on_start(self, event): ...
    def on_end(self, event):
        compiled.append(event.data["dispatcher"].py_func.__qualname__)
event.register("numba:compile", Heard())
from usdbrdf.cli import main
assert main(["convert", "-q", *sys.argv[1:]]) == 0
print(json.dumps(compiled))
"""


@pytest.fixture
def started(tmp_path, monkeypatch):
    """What was started, and of what the first compiled kernel tells."""
    found, ended, told = [], [], []

    @contextmanager
    def child(function, arrays, parameters, timeout_s, label):
        found.append((function, parameters))
        try:
            yield
        finally:
            ended.append(function)

    @contextmanager
    def when_compiling(tell):
        told.append(tell)
        yield

    monkeypatch.setattr(first_run, "mark_of_compiled", lambda _: tmp_path / "done")
    monkeypatch.setattr(first_run.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(first_run, "child", child)
    monkeypatch.setattr(first_run, "when_compiling", when_compiling)
    return SimpleNamespace(found=found, ended=ended, told=told, mark=tmp_path / "done")


def test_it_begins_with_the_first_kernel_that_is_compiled(started, capsys):
    with compiling_beside():
        assert started.found == []
        started.told[0]()
        deadline = time.monotonic() + 300
        while not started.found:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        started.told[0]()
    assert started.found == [("usdbrdf.warm_up:compile_all", {"done": str(started.mark)})]
    assert len(started.ended) == 1
    assert capsys.readouterr().err.count("compiling for this machine") == 1


def test_nothing_is_started_where_nothing_is_compiled(started, monkeypatch, capsys):
    with compiling_beside():
        pass
    started.mark.touch()
    with compiling_beside():
        assert len(started.told) == 1
    started.mark.unlink()
    monkeypatch.setattr(first_run.os, "cpu_count", lambda: 1)
    with compiling_beside():
        assert len(started.told) == 1
    assert started.found == []
    assert capsys.readouterr().err == ""


def test_the_room_is_a_capture(tmp_path):
    """With a lamp that frames show: its loops are to be compiled too."""
    _write_capture(tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert all((tmp_path / frame["file_path"]).is_file() for frame in frames)


def test_what_a_run_needs_was_compiled(tmp_path):
    """Of a room with the same things in it as the sample; all in a cache of its own."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]),
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }
    mark = tmp_path / "done"
    code = f"from usdbrdf.warm_up import compile_all; compile_all({{}}, {{'done': {str(mark)!r}}})"
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True)
    assert mark.exists()
    made = make_capture(tmp_path / "room", poses=poses_down_and_up(8, 4), noise=0.02)
    place = [str(made.folder), "-o", str(tmp_path / "out"), "--texel-size", "0.1"]
    done = subprocess.run(
        [sys.executable, "-c", _COUNT, *place],
        env=environment, check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert json.loads(done.stdout.splitlines()[-1]) == []
