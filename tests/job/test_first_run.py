"""What is compiled beside a first run is what the run needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

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


def test_nothing_is_started_where_all_was_compiled(tmp_path, monkeypatch, capsys):
    mark, started = tmp_path / "done", []
    monkeypatch.setattr(first_run, "mark_of_compiled", lambda _: mark)
    monkeypatch.setattr(first_run.os, "cpu_count", lambda: 2)

    def child(function, arrays, parameters, timeout_s, label):
        started.append((function, parameters))
        return open(os.devnull)

    monkeypatch.setattr(first_run, "child", child)
    with compiling_beside():
        assert started == [("usdbrdf.warm_up:compile_all", {"done": str(mark)})]
    assert "compiling for this machine" in capsys.readouterr().err
    mark.touch()
    with compiling_beside():
        assert len(started) == 1
    assert capsys.readouterr().err == ""
    mark.unlink()
    monkeypatch.setattr(first_run.os, "cpu_count", lambda: 1)
    with compiling_beside():
        assert len(started) == 1


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
