"""A task disturbed at its calls of the file system, as the kernel sees them: killed, its disk
full, its mount gone, the power off. Then the same task: the same bytes, and nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def disturbed(folder: Path, fault: str, stride: int) -> dict[str, object]:
    done = subprocess.run(
        [sys.executable, "-m", "tests.job.disturbed_toy", str(folder), fault, str(stride)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    if done.returncode == 77:
        pytest.skip("watching system calls wants Linux 5.19 or later on x86-64")
    assert done.returncode == 0, done.stderr
    told: dict[str, object] = json.loads(done.stdout)
    return told


@pytest.mark.fault("R1")
@pytest.mark.fault("R2")
@pytest.mark.parametrize(
    ("fault", "stride"), [("kill", 17), ("full", 6), ("gone", 29), ("power", 5), ("power first", 5)]
)
def test_the_same_task_ends_in_the_same_bytes(tmp_path, fault, stride):
    told = disturbed(tmp_path, fault, stride)
    assert told["wrong"] == []
    assert told["runs"] >= 4
