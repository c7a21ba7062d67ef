"""A task disturbed at its calls of the file system, as the kernel sees them: killed, its disk
full, its mount gone, the power off. Then the same task: the same bytes, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.fault_injection import run_watched


def disturbed(folder: Path, fault: str, stride: int) -> dict[str, object]:
    arguments = folder, fault, str(stride)
    done = run_watched("-m", "tests.job.disturbed_toy", *arguments, timeout_s=120)
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
