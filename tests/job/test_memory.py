"""How much memory there is, and that it is given back."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from usdbrdf.job import memory


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Writes a control group's limits and says which group this process is in."""

    def write(own: str, limits: dict[str, str]) -> None:
        (tmp_path / "own").write_text(own)
        for name, text in limits.items():
            (tmp_path / "cgroup" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "cgroup" / name).write_text(text + "\n")

    monkeypatch.setattr(memory, "_CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(memory, "_OWN_CGROUPS", tmp_path / "own")
    return write


V1 = "11:cpu,cpuacct:/batch\n7:memory:/batch/job\n0::/\n"


@pytest.mark.parametrize(
    ("own", "limits", "expected"),
    [
        ("0::/\n", {"memory.max": "max"}, None),
        ("0::/\n", {"memory.max": str(1 << 29)}, 1 << 29),
        ("0::/batch/job\n", {"batch/job/memory.max": "4096", "memory.max": "max"}, 4096),
        ("0::/batch/job\n", {"batch/job/memory.max": "max", "batch/memory.max": "8192"}, 8192),
        ("0::/kube:pod:1\n", {"kube:pod:1/memory.max": "4096", "memory.max": "max"}, 4096),
        ("0::/docker/of-the-host\n", {"memory.max": "4096"}, 4096),
        (V1, {"memory/batch/job/memory.limit_in_bytes": "4096"}, 4096),
        (V1, {"memory/memory.limit_in_bytes": "4096", "memory.max": "max"}, 4096),
        (V1, {"memory/batch/memory.limit_in_bytes": str((1 << 63) - 4096)}, None),
        ("", {"memory.max": "4096"}, None),
    ],
)
def test_a_container_or_batch_system_may_allow_less(groups, own, limits, expected):
    groups(own, limits)
    assert memory.machine_bytes() == (expected or psutil.virtual_memory().total)


def test_a_sandbox_without_proc_asks_the_system_itself(tmp_path, monkeypatch):
    """psutil reads files there; that they are missing has nothing to do with a disk."""
    whole, own = psutil.virtual_memory().total, psutil.Process().memory_info().rss

    def missing():
        raise FileNotFoundError(2, "No such file or directory", "/proc/meminfo")

    def gone():
        raise psutil.NoSuchProcess(os.getpid())

    monkeypatch.setattr(memory, "_OWN_CGROUPS", tmp_path / "none")
    monkeypatch.setattr(psutil, "virtual_memory", missing)
    monkeypatch.setattr(psutil, "Process", gone)
    assert memory.machine_bytes() >= whole  # of a container the host's
    assert memory.resident_bytes() > own / 2


def test_systems_without_control_groups(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "_OWN_CGROUPS", tmp_path / "none")
    assert memory.machine_bytes() == psutil.virtual_memory().total


def test_what_a_process_holds_is_known():
    before = memory.resident_bytes()
    held = np.ones(1 << 24)
    assert memory.resident_bytes() - before > 0.9 * held.nbytes


def test_freed_memory_goes_back():
    # Blocks too small to be mapped one by one, the last of which keeps the heap from shrinking.
    blocks = [bytearray(60_000) for _ in range(4000)]
    full = memory.resident_bytes()
    last = blocks.pop()
    blocks.clear()
    memory.give_back_freed()
    assert full - memory.resident_bytes() > 0.8 * 4000 * 60_000
    assert len(last) == 60_000


def test_freed_memory_is_used_again_where_dask_has_set_that_it_goes_back():
    code = (
        "import resource, sys; from usdbrdf.job.memory import keep_freed\n"
        "if sys.argv[1:]: keep_freed()\n"
        "def faults(): return resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "before = faults()\n"
        "for _ in range(100): b'1' * 1_000_000\n"
        "print(faults() - before)"
    )
    given = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}
    given["PYTHONPATH"] = str(Path(__file__).parents[2])
    told = [
        int(subprocess.check_output([sys.executable, "-c", code, *chosen], env=given))
        for chosen in ([], ["keep"])
    ]
    if told[0] < 20_000:
        pytest.skip("this C library does otherwise")
    assert told[1] < 2_000


def test_a_shell_that_leaves_no_addresses_is_told_in_a_sentence(tmp_path):
    """Libraries crash where they get none; the command line says so before it loads them."""
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))\n"
        "from usdbrdf.cli import main; sys.exit(main(['ingest', '.', '-o', sys.argv[1]]))"
    )
    search = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "asset")],
        env={**os.environ, "PYTHONPATH": search},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 4, done.stderr
    (sentence,) = done.stderr.splitlines()
    assert re.search(r"is 2 GiB.*ulimit -v.*\[environment\.memory\]$", sentence)
    assert not (tmp_path / "asset").exists()
