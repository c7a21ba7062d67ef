"""What a campaign of disturbed steps works on (`crash_campaign.py`): each step about to run, the
cases of each fault, the same command again, and what came of it."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import re
import shutil
import signal
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from generated_capture import write_tiny
from kill_sweep import STEPS, contents, verdict
from numba import njit
from power_loss import WATCHED
from system_calls import Call, run_watched

from usdbrdf.cli import main as usdbrdf_main
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.identity import tasks_identity

# What makes the step short, and what makes its results differ from those.
OPTIONS = {
    "ingest": ([], ["--crease-angle", "41"]),
    "texture": (["--texel-size", "1"], ["--texel-size", "0.8"]),
    "shade": (["--rays", "16"], ["--rays", "16", "--seed", "1"]),
    "fit": (["--max-pixels", "60"], ["--max-pixels", "50"]),
}
LONGEST_SECONDS = 300  # whoever takes longer hangs
EDITS = "# The artist's.\n"
# How each may end: by the signal, with its exit code, with the machine's fault, or not disturbed.
ENDS = {
    "kill": {-signal.SIGKILL}, "terminate": {143}, "interrupt": {130}, "stop": {0},
    "full": {0, 4}, "unreadable": {0, 3, 4}, "unmounted": {0, 4}, "memory": {0, 4}, "clock": {0},
    "power": {-9},
}  # fmt: skip


@dataclass
class Start:
    """A step about to run: the asset as it is before and as it is after, and the calls between.

    calls   of each kind, how many there are
    """

    step: str
    again: bool
    before: Path
    expected: dict[str, str] = field(default_factory=dict)
    calls: Counter[str] = field(default_factory=Counter)

    @property
    def name(self) -> str:
        return f"{self.step} {'again' if self.again else 'first'}"


@dataclass(frozen=True)
class Series:
    """One fault at one start, at places that the seed chooses; each of its cases has a name."""

    start: Start
    fault: str
    seed: tuple[int, int]

    def named(self, case: object) -> str:
        seed, round_number = self.seed
        return f"{self.start.name}, {self.fault}, seed {seed}, round {round_number}: {case}"

    def rng(self, case: object = "") -> np.random.Generator:
        """The same in every process, whatever was disturbed before."""
        return np.random.default_rng([*self.seed, zlib.crc32(self.named(case).encode())])


class Results:
    """What came of each case that was run on these sources, in a file too if there is one."""

    def __init__(self, file: Path | None) -> None:
        self._file, self._code = file, tasks_identity()
        self.known: dict[str, dict[str, object]] = {}
        told = file.read_text() if file is not None and file.is_file() else ""
        for line in told.splitlines():
            with suppress(json.JSONDecodeError):  # it was stopped while it wrote
                if (result := json.loads(line))["code"] == self._code:
                    self.known[result["case"]] = result
        if file is not None and told and not told.endswith("\n"):
            file.write_text(f"{told}\n")

    def note(self, series: Series, case: object, problem: str | None) -> None:
        """problem  "" where the bytes are the same, None where nothing was disturbed"""
        result: dict[str, object] = {
            "case": series.named(case), "step": series.start.step, "fault": series.fault,
            "problem": problem, "code": self._code,
        }  # fmt: skip
        self.known[series.named(case)] = result
        if self._file is not None:
            with self._file.open("a") as file:
                file.write(json.dumps(result) + "\n")

    def tally(self) -> dict[tuple[str, str], list[str]]:
        """The problems of each step and fault, "" where there was none."""
        found: dict[tuple[str, str], list[str]] = {}
        for result in self.known.values():
            if result["problem"] is not None:
                step, fault = str(result["step"]), str(result["fault"])
                found.setdefault((step, fault), []).append(str(result["problem"]))
        return found


class Campaign:
    """A folder with the capture and the assets; each case is CASES/room, equally far from it."""

    def __init__(self, work: Path, results: Results) -> None:
        self.work, self.capture, self.results = work, work / "scan", results
        self.cases = itertools.count()
        # In a process of its own: it starts threads, and those of us who fork may have none.
        assert in_fork(lambda: write_tiny(self.capture) or 0) == 0

    def load(self) -> None:
        """Import what the steps import, and have numba ready, once for all processes that are
        forked."""
        njit("int64(int64)")(lambda number: number)
        names, before = self.work / "imported", self.work / "start"
        before.mkdir()
        for step in STEPS:
            case = self.copy_of(before)
            work = self.work_of(case, step)

            def noted(work: Callable[[], int] = work) -> int:
                status = work()
                names.write_text(" ".join(sys.modules))
                return status

            if (status := in_fork(noted)) != 0:
                raise SystemExit(f"{step} ended with {status}: {said(case)}")
            for name in names.read_text().split():
                with suppress(ImportError):  # the program's own "__mp_main__" and the like
                    importlib.import_module(name)
            shutil.rmtree(before)
            before = case
        shutil.rmtree(before)

    def starts(self, steps: Sequence[str]) -> Iterator[Start]:
        """Each step, where it has not been done and where it was done with other options."""
        before = self.work / "start"
        before.mkdir()
        for number, step in enumerate(STEPS):
            done = self._after(before, step)
            if step in steps:
                yield self._start(Start(step, False, before))
                other = self._after(before, step, 1)
                for later in STEPS[number + 1 :] if step == "ingest" else ():
                    other = self._after(other, later)
                yield self._start(Start(step, True, other))
            if step == "ingest":
                edits = done / "room" / "edits.usda"
                edits.write_text(edits.read_text() + EDITS)
            before = done

    def _after(self, before: Path, step: str, options: int = 0) -> Path:
        case = self.copy_of(before)
        if (status := self.run(case, step, options)) != 0:
            raise SystemExit(f"{step} ended with {status}: {said(case)}")
        (case / "said").unlink()
        return case

    def _start(self, start: Start) -> Start:
        case, seen = self.copy_of(start.before), Counter[str]()

        def count(call: Call) -> None:
            seen[call.kind] += 1

        def see(call: Call) -> int | None:
            count(call)
            return None

        kinds = (*WATCHED, "read")
        assert run_watched(self.work_of(case, start.step), kinds, self.work, see) == 0, said(case)
        start.expected, start.calls = contents(case / "room"), seen
        shutil.rmtree(case)
        print(f"{start.name}: {dict(seen)}", flush=True)
        return start

    def copy_of(self, before: Path) -> Path:
        """A new case that begins as another."""
        case = self.work / f"case-{next(self.cases):05d}"
        shutil.copytree(before, case)
        (case / "tmp").mkdir(exist_ok=True)
        return case

    def command(self, case: Path, step: str, options: int = 0) -> list[str]:
        """Arguments of `usdbrdf`."""
        asset = case / "room"
        place = [str(asset)] if step != "ingest" else [str(self.capture), "-o", str(asset)]
        return [step, "-q", *place, *OPTIONS[step][options]]

    def work_of(self, case: Path, step: str, options: int = 0) -> Callable[[], int]:
        """The command line, to be called in a process of its own."""
        arguments = self.command(case, step, options)

        def work() -> int:
            said = os.open(case / "said", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(said, 1)
            os.dup2(said, 2)
            signal.alarm(LONGEST_SECONDS)
            os.environ["TMPDIR"] = str(case / "tmp")
            tempfile.tempdir = None
            return usdbrdf_main(arguments)

        return work

    def run(self, case: Path, step: str, options: int = 0) -> int:
        """The step, undisturbed."""
        return in_fork(self.work_of(case, step, options))

    def ended(self, series: Series, name: object, where: str, case: Path, status: int) -> None:
        """Run the same command again where a disturbed one ended, and note the result; ``where``
        is "" if nothing disturbed it, which then has to have ended well."""
        start, fault = series.start, series.fault
        if not where and status == 0:
            self.results.note(series, name, None)
            shutil.rmtree(case)
            return
        if not where and status == -signal.SIGALRM:  # on a machine that others keep busy
            print(f"  undecided after {LONGEST_SECONDS} s: {series.named(name)}", flush=True)
            shutil.rmtree(case)
            return
        if not where:
            problem = f"before any call was disturbed: ended with {status} {said(case)[-300:]}"
            self.note(series, name, problem)
            return
        problem = ""
        if status not in ENDS[fault] and status != 0:
            problem = f"ended with {status}; "
        if fault in ("terminate", "interrupt", "full", "memory") and os.listdir(case / "tmp"):
            problem += "left a temporary folder; "
        if "Traceback" in said(case):
            problem += "a traceback; "
        for left in (case / "tmp").iterdir():
            os.utime(left, (0, 0))
        again = self.run(case, start.step)
        found = contents(case / "room")
        result = verdict(start.expected, found) if again == 0 else f"exit {again} again"
        in_fork(lambda: swept(case / "tmp"))
        if left := sorted({*os.listdir(case)} - {"room", "tmp", "said"}):
            problem += f"left {left}; "
        if left := [file.name for file in (case / "tmp").iterdir() if not is_probe(file)]:
            problem += f"left {left}; "
        problem += "" if result == "identical" else result
        self.note(series, name, problem and f"{where}: {problem} {said(case)[-300:]}")
        if not problem:
            shutil.rmtree(case)

    def note(self, series: Series, name: object, problem: str) -> None:
        self.results.note(series, name, problem)
        if problem:
            print(f"  {series.start.name}, {series.fault} at {problem}", flush=True)

    def waiting(self, series: Series, cases: int) -> list[int]:
        """The numbers of the cases, of so many, that have not been run."""
        names = map(series.named, range(cases))
        return [number for number, name in enumerate(names) if name not in self.results.known]


def in_fork(work: Callable[[], int]) -> int:
    """What ``work`` returns in a process of its own, or minus the signal that ended it."""
    process = os.fork()
    if process == 0:
        status = 1
        try:
            status = work()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def swept(temporary: Path) -> int:
    """What the next run of any command that starts a child does."""
    tempfile.tempdir = str(temporary)
    with scratch_folder():
        return 0


def is_probe(file: Path) -> bool:
    """Whether Python's own tempfile left it, which writes four bytes to see that it can."""
    named = re.fullmatch("[a-z0-9_]{8}", file.name)
    return bool(named) and file.is_file() and file.read_bytes() in (b"", b"blat")


def said(case: Path) -> str:
    file = case / "said"
    return file.read_text(errors="replace") if file.is_file() else ""
