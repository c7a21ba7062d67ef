"""The toy task, disturbed at each of its calls of the file system; run as a script.

python disturbed_toy.py FOLDER FAULT STRIDE

Disturbs every STRIDE-th call, runs the task again each time, and prints how many there were and the
first that did not end in the bytes of an undisturbed run. FAULT: kill, full, gone, power, and power
first, without an earlier run.
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import signal
import sys
from pathlib import Path

import numpy as np

from tests.job.toy_task import run_toy
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.atomic import sha256_of

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from power_loss import LOSSES, WATCHED, Disk
from system_calls import Call, can_watch, run_watched

_CHANGES = ("write", "sync", "rename", "unlink", "mkdir", "create")
_FULL = ("write", "sync", "mkdir", "create")
_ENDS = {"kill": {-signal.SIGKILL}, "full": {0, 4}, "gone": {0, 4}}


def toy(case: Path, textures: int = 2) -> int:
    """Exit status of the task in CASE/room, of which an earlier run made more textures."""
    try:
        run_toy(case / "room", textures=textures)
    except EnvironmentFailure:
        return 4
    return 0


def again(case: Path) -> dict[str, str]:
    """The files of the asset after the same task, and what else is in the case."""
    assert in_fork(case) == 0
    return {
        path.relative_to(case).as_posix(): sha256_of(path)
        for path in sorted(case.rglob("*"))
        if path.is_file() and path.suffix != ".computed"
    }


def in_fork(case: Path, textures: int = 2) -> int:
    process = os.fork()
    if process == 0:
        status = 1
        try:
            status = toy(case, textures)
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def started(folder: Path, name: str, *, first: bool = False) -> Path:
    """A new case, with what an earlier run left unless it is the first."""
    case = folder / name
    case.mkdir(parents=True)
    assert first or in_fork(case, textures=3) == 0
    return case


def disturbed(folder: Path, fault: str, number: int) -> tuple[Path, int, bool]:
    """Where the task was disturbed at its n-th call, how it ended, and whether it came so far."""
    case, passed = started(folder, f"{fault}-{number}"), itertools.count()
    struck = False

    def answer(call: Call) -> int | None:
        nonlocal struck
        if call.path.suffix == ".computed":  # the test's own
            return None
        if fault == "kill":
            if call.kind in _CHANGES and next(passed) == number:
                struck = True
                os.kill(call.process, signal.SIGKILL)
            return None
        struck = struck or (call.kind in _FULL and next(passed) == number)
        failing = call.kind in (_FULL if fault == "full" else (*_CHANGES, "open"))
        return (errno.ENOSPC if fault == "full" else errno.ESTALE) if struck and failing else None

    return case, run_watched(lambda: toy(case), WATCHED, case, answer), struck


def cut(folder: Path, stride: int, *, first: bool) -> list[Path]:
    """Disks as a power cut may leave them at some calls, and at the end of the task."""
    case = started(folder, "power", first=first)
    disk, passed, disks = Disk(case), itertools.count(), list[Path]()
    rng = np.random.default_rng(0)

    def see(call: Call) -> int | None:
        if call.kind in _CHANGES and next(passed) % stride == 0:
            disks.append(folder / f"cut-{len(disks)}")
            disk.after(disks[-1], LOSSES[len(disks) % len(LOSSES)], rng)
        disk.see(call)
        return None

    assert run_watched(lambda: toy(case), WATCHED, case, see) == 0
    disks.append(folder / "ended")
    disk.after(disks[-1], LOSSES[0], rng)
    return disks


def main() -> None:
    if not can_watch():
        sys.exit(77)
    folder, fault, stride = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    expected, wrong, runs = again(started(folder, "undisturbed")), [], 0
    if fault.startswith("power"):
        disks = cut(folder, stride, first=fault == "power first")
        lost = [
            name for name, sha256 in expected.items()
            if not (disks[-1] / name).is_file() or sha256_of(disks[-1] / name) != sha256
        ]  # fmt: skip
        wrong += [f"of a finished run {name} is lost" for name in lost]
        runs, cases = len(disks), [(disk, "") for disk in disks]
    else:
        cases = []
        for number in itertools.count(0, stride):
            case, status, struck = disturbed(folder, fault, number)
            if not struck:
                break
            runs += 1
            cases.append((case, "" if status in _ENDS[fault] else f"ended with {status}"))
    for case, problem in cases:
        found = again(case)
        names = {*expected, *found}
        differ = sorted(name for name in names if expected.get(name) != found.get(name))
        if problem or differ:
            wrong.append(f"{case.name}: {problem} {differ[:3]}")
    print(json.dumps({"runs": runs, "wrong": wrong[:5]}))


if __name__ == "__main__":
    main()
