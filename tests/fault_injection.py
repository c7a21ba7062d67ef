"""Faults at named points of a run, from outside the program: its functions are wrapped.

A fault is ``kill@POINT`` (SIGKILL to this process) or ``enospc@POINT`` (OSError, disk full), and
``:K`` after the point means its K-th pass, counted from 1; without it, the first. The points:

    publish:before_replace, publish:after_replace   around every rename to a final name
    image:before_write                              an image is about to be written
    TASK:before_write                               the work asked for an output's place
    TASK:checkpoint                                 a checkpoint is stored, older states too
    TASK:before_publish                             all is made; the journal is still to be written
    TASK:mid_publish                                one output has been moved into the asset
    TASK:after_publish                              all have, and what is no longer made is gone
    TASK:before_stamp                               the stamp is about to be written
    TASK:after_stamp                                the journal is still there
"""

from __future__ import annotations

import errno
import itertools
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import usdbrdf.files.atomic
import usdbrdf.files.images
import usdbrdf.job.task

ROOT = Path(__file__).parents[1]
VARIABLE = "FAULT_OF_TEST"  # of the environment of a process that is to arm itself


class Fault:
    """Counts the passes of points and strikes at one of them."""

    def __init__(self, fault: str) -> None:
        self._action, _, self._where = fault.partition("@")
        self._passes: Counter[str] = Counter()
        self._task = ""

    def point(self, name: str) -> None:
        """Pass a point."""
        self._passes[name] += 1
        if self._where not in (f"{name}:{self._passes[name]}", name):
            return
        if self._action == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def arm(self, patch: Callable[[Any, str, Any], None]) -> None:
        """Wrap the program's functions; ``patch(object, name, value)`` sets an attribute."""

        def around(owner: Any, name: str, before: str = "", after: str = "") -> None:
            function = getattr(owner, name)

            def wrapped(*arguments: Any, **options: Any) -> Any:
                if before:
                    self.point(before.format(task=self._task))
                result = function(*arguments, **options)
                if after:
                    self.point(after.format(task=self._task))
                return result

            patch(owner, name, wrapped)

        task = usdbrdf.job.task
        self._note_tasks(patch)
        self._around_renames(patch)
        self._around_stamps(patch)
        around(usdbrdf.files.images, "write_image", before="image:before_write")
        around(task.TaskRun, "_place", after="{task}:before_write")
        around(task.TaskRun, "save", after="{task}:checkpoint")
        around(task, "move", after="{task}:mid_publish")
        around(task, "_retire", after="{task}:after_publish")

    def _note_tasks(self, patch: Callable[[Any, str, Any], None]) -> None:
        stamp_of = usdbrdf.job.task.stamp_of

        def noting(name: str, *arguments: Any) -> Any:
            self._task = name
            return stamp_of(name, *arguments)

        patch(usdbrdf.job.task, "stamp_of", noting)

    def _around_renames(self, patch: Callable[[Any, str, Any], None]) -> None:
        replace = os.replace

        def replacing(*arguments: Any) -> None:
            # Other libraries rename too, numba in its cache for one.
            ours = sys._getframe(1).f_globals["__name__"] == "usdbrdf.files.atomic"
            if ours:
                self.point("publish:before_replace")
            replace(*arguments)
            if ours:
                self.point("publish:after_replace")

        patch(os, "replace", replacing)

    def _around_stamps(self, patch: Callable[[Any, str, Any], None]) -> None:
        write_stamp = usdbrdf.job.task.write_stamp

        def writing(path: Any, stamp: Any) -> None:
            is_journal = path.name.startswith("publishing-")
            self.point(f"{self._task}:{'before_publish' if is_journal else 'before_stamp'}")
            write_stamp(path, stamp)
            if not is_journal:
                self.point(f"{self._task}:after_stamp")

        patch(usdbrdf.job.task, "write_stamp", writing)


def arm_from_environment() -> None:
    """For processes that tests start: the fault that VARIABLE names, if any."""
    if os.environ.get(VARIABLE):
        Fault(os.environ[VARIABLE]).arm(setattr)


def inject(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fault in this process, until ``monkeypatch`` undoes it."""
    Fault(fault).arm(monkeypatch.setattr)


def killed_at_each_change(work: Callable[[], object]) -> Iterator[int]:
    """Do the work in forked processes that are killed before its first change of names, its second,
    and so on, until one is not. For processes without threads: see ``run_fresh``."""
    for number in itertools.count(1):
        if (child := os.fork()) == 0:
            status = 1
            try:
                _kill_at(number)
                work()
                status = 0
            finally:
                os._exit(status)
        ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        usdbrdf.files.atomic._swept.clear()  # what comes next is another process
        assert ended in (0, -signal.SIGKILL), ended
        if ended == 0:
            return
        yield number


def _kill_at(number: int) -> None:
    """Kill this process at its so-manieth change of names."""
    left = itertools.count(number, -1)

    def around(change: Callable[..., Any]) -> Callable[..., Any]:
        def changing(*arguments: Any, **named: Any) -> Any:
            if next(left) == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            return change(*arguments, **named)

        return changing

    for name in ("replace", "rename", "mkdir", "unlink", "rmdir"):
        setattr(os, name, around(getattr(os, name)))


def run_fresh(program: str, *arguments: str | Path) -> str:
    """What a program says that runs in a process of its own, which imports what tests do."""
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def run_watched(*arguments: str | Path, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """A run of Python that watches its own system calls, which has to end well; where the kernel
    lets nobody watch, such a program ends with 77 and the test is skipped."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    if done.returncode == 77:
        pytest.skip("watching system calls wants Linux 5.19 or later on x86-64")
    assert done.returncode == 0, done.stderr
    return done
