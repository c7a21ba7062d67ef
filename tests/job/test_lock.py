"""Two runs in one folder: the second is told who the first is."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from usdbrdf.errors import FolderBusy
from usdbrdf.job.lock import folder_lock

ROOT = Path(__file__).parents[2]
HOLD = """
import sys, time
from pathlib import Path
from usdbrdf.job.lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def holder(tmp_path):
    search = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": search},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_second_run_is_refused_at_once_and_told_who_holds_it(tmp_path, holder):
    started = time.monotonic()
    with (
        pytest.raises(FolderBusy, match=rf"pid {holder.pid} on .+ since .+\[lock.busy\]"),
        folder_lock(tmp_path),
    ):
        pass
    assert time.monotonic() - started < 1


def test_lock_of_a_killed_run_is_free(tmp_path, holder):
    holder.kill()
    holder.wait()
    with folder_lock(tmp_path):
        pass


def test_waiting_for_the_first_run(tmp_path, holder):
    timer = threading.Timer(0.3, lambda: (holder.stdin.write("\n"), holder.stdin.flush()))
    timer.start()
    with folder_lock(tmp_path, wait_s=20):
        timer.join()


def test_second_lock_in_one_process_is_refused_and_the_first_survives(tmp_path, toy_process):
    with folder_lock(tmp_path):
        with pytest.raises(FolderBusy, match="another thread"), folder_lock(tmp_path):
            pass
        attempt = subprocess.run(
            [sys.executable, "-c", HOLD, str(tmp_path)],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            input="\n",
            timeout=30,
            check=False,
        )
        assert "FolderBusy" in attempt.stderr
    assert (tmp_path / "lock").read_bytes() == b""


def test_folder_busy_through_the_stage(tmp_path, toy, toy_process):
    toy.run_toy(tmp_path / "room")
    with folder_lock(tmp_path / "room/.usdbrdf"):
        assert "FolderBusy" in toy_process(tmp_path / "room").stderr
