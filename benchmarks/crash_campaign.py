"""Does a step that was disturbed anywhere end in the same bytes when it is run again?

    python benchmarks/crash_campaign.py [--runs 10] [--cuts 20] [--rounds 1] [--steps shade fit]
        [--faults kill terminate ...] [--minutes 60] [--seed 0] [--work DIR] [--json FILE]

A tiny generated room is converted, one step at a time, each from an asset that lacks the step and
from one that has it with other options. The step runs in a forked process, whose calls of the file
system are counted (`system_calls.py`); at the n-th write, flush, rename, removal or creation, one
in each equal share of all calls of each kind, it is killed (SIGKILL), told to end (SIGTERM,
SIGINT), stopped while the same command runs beside it, finds its disk full, an input that cannot
be read, its mount gone, little memory, a clock that jumps, or the power off (`power_loss.py`:
`--cuts` for each start). Then the same command runs again: every file of the asset must have the
bytes of an undisturbed run, the artist's `edits.usda` those that it had, and no file of ours may be
left beside. What a run has finished must survive the power as it is. Exit code 1 if anything
differs.

A run of a step takes as long as its own work: it is forked from a process that has imported what
the steps import, and the asset before it is made once. In memory (`--work /dev/shm`) flushes take
no time. A run that ended before its call came counts for nothing. With `--rounds` all is done
several times, each at other calls, and what was found is written after each.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import itertools
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from generated_capture import write_tiny
from kill_sweep import STEPS, contents, verdict
from power_loss import LOSSES, WATCHED, Disk
from system_calls import Call, can_watch, run_watched

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
# Calls that change what a disk holds.
CHANGES = ("write", "sync", "rename", "unlink", "mkdir", "create")
FULL = ("write", "sync", "mkdir", "create")
SIGNALS = {"kill": signal.SIGKILL, "terminate": signal.SIGTERM, "interrupt": signal.SIGINT}
FAULTS = (*SIGNALS, "stop", "full", "unreadable", "unmounted", "memory", "clock", "power")
JUMPS = (3600, 10**8, 2 * 10**9)  # seconds; the last are years before 1970 and after 2038
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


class Campaign:
    """A folder with the capture and the assets; each case is CASES/room, equally far from it."""

    def __init__(self, work: Path, seed: int) -> None:
        self.work, self.capture = work, work / "scan"
        self.cases = itertools.count()
        self.rng = np.random.default_rng(seed)
        self.tally: dict[tuple[str, str], list[str]] = {}
        self.missed = 0
        # In a process of its own: it starts threads, and those of us who fork may have none.
        assert in_fork(lambda: write_tiny(self.capture) or 0) == 0

    def load(self) -> None:
        """Import what the steps import, once for all processes that are forked."""
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

    def ended(self, start: Start, fault: str, where: str, case: Path, status: int) -> None:
        """Run the same command again where a disturbed one ended, and note the result; ``where``
        is "" if nothing disturbed it, which then has to have ended well."""
        if not where and status == 0:
            self.missed += 1
            shutil.rmtree(case)
            return
        if not where:
            problem = f"before any call was disturbed: ended with {status} {said(case)[-300:]}"
            self.note(start, fault, problem)
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
        self.note(start, fault, "" if not problem else f"{where}: {problem} {said(case)[-300:]}")
        if not problem:
            shutil.rmtree(case)

    def note(self, start: Start, fault: str, problem: str) -> None:
        self.tally.setdefault((start.step, fault), []).append(problem)
        if problem:
            print(f"  {start.name}, {fault} at {problem}", flush=True)


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


def spread(
    campaign: Campaign, start: Start, kinds: Sequence[str], runs: int
) -> list[tuple[str, int]]:
    """Kind and number, from 1, of so many calls: each kind its share, and of its calls one in each
    equal part."""
    there = [kind for kind in kinds if start.calls[kind]]
    chosen = []
    for i, kind in enumerate(there):
        share = len(range(i, runs, len(there)))
        places = (np.arange(share) + campaign.rng.random(share)) / max(share, 1)
        chosen += [(kind, 1 + int(place * start.calls[kind])) for place in places]
    return sorted(set(chosen))


class At:
    """Does something at the n-th call of a kind, and lets all others happen; ``struck`` says where
    that was."""

    def __init__(self, kind: str, number: int, act: Callable[[Call], int | None]) -> None:
        self._kind, self._left, self._act = kind, number, act
        self.struck = ""

    def __call__(self, call: Call) -> int | None:
        if call.kind != self._kind:
            return None
        self._left -= 1
        if self._left:
            return None
        self.struck = f"{call.kind} of {call.path}"
        return self._act(call)


def disturb_by_signals(campaign: Campaign, start: Start, fault: str, runs: int) -> None:
    for kind, number in spread(campaign, start, CHANGES, runs):
        case = campaign.copy_of(start.before)

        def strike(call: Call) -> None:
            os.kill(call.process, SIGNALS[fault])

        work = campaign.work_of(case, start.step)
        status = run_watched(work, WATCHED, case, (where := At(kind, number, strike)))
        campaign.ended(start, fault, where.struck, case, status)


def stop(campaign: Campaign, start: Start, runs: int) -> None:
    """SIGSTOP, the same command beside it, which has to be refused, and SIGCONT."""
    for kind, number in spread(campaign, start, CHANGES, runs):
        case = campaign.copy_of(start.before)
        refused = []

        def strike(call: Call, case: Path = case, refused: list[int] = refused) -> None:
            os.kill(call.process, signal.SIGSTOP)
            refused.append(campaign.run(case, start.step))
            os.kill(call.process, signal.SIGCONT)

        work = campaign.work_of(case, start.step)
        status = run_watched(work, WATCHED, case, (where := At(kind, number, strike)))
        # Before the lock is taken and after it is given back there is nobody to meet.
        if refused not in ([], [5], [0]):
            status = 1
        what = where.struck and f"{where.struck}, beside it {refused}"
        campaign.ended(start, "stop", what, case, status)


def fill(campaign: Campaign, start: Start, fault: str, runs: int) -> None:
    """From the n-th call on, a disk that is full or a mount that is gone."""
    failing = FULL if fault == "full" else (*CHANGES, "open", "read")
    error = errno.ENOSPC if fault == "full" else errno.ESTALE
    for kind, number in spread(campaign, start, failing, runs):
        case, state = campaign.copy_of(start.before), {"failed": False}

        def fail(_: Call, state: dict[str, bool] = state) -> int:
            state["failed"] = True
            return error

        where = At(kind, number, fail)

        def answer(call: Call, where=where, state=state) -> int | None:  # type: ignore[no-untyped-def]
            return error if state["failed"] and call.kind in failing else where(call)

        kinds = WATCHED if fault == "full" else (*WATCHED, "read")
        status = run_watched(
            campaign.work_of(case, start.step), kinds, case if fault == "full" else case / "room",
            answer,
        )  # fmt: skip
        campaign.ended(start, fault, where.struck, case, status)


def make_unreadable(campaign: Campaign, start: Start, runs: int) -> None:
    """One read of an input, or of what an earlier step wrote, fails."""
    for kind, number in spread(campaign, start, ("read", "open"), runs):
        case = campaign.copy_of(start.before)
        status = run_watched(
            campaign.work_of(case, start.step), ("read", "open"), campaign.work,
            (where := At(kind, number, lambda _: errno.EIO)),
        )  # fmt: skip
        campaign.ended(start, "unreadable", where.struck, case, status)


def narrow(campaign: Campaign, start: Start, runs: int) -> None:
    """Addresses for all that is loaded and a little more."""
    with open("/proc/self/statm") as statm:
        loaded = int(statm.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    for more in np.geomspace(1 << 26, 1 << 32, runs):
        case = campaign.copy_of(start.before)
        work = campaign.work_of(case, start.step)
        limit = loaded + int(more)

        def limited(work: Callable[[], int] = work, limit: int = limit) -> int:
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            return work()

        campaign.ended(start, "memory", f"{limit >> 20} MiB", case, in_fork(limited))


def jump(campaign: Campaign, start: Start) -> None:
    """A clock that jumps back and on at every look, in a process of its own."""
    shim = campaign.work / "jumping_clock.so"
    source = Path(__file__).with_name("jumping_clock.c")
    if not shim.exists():
        subprocess.run(["cc", "-shared", "-fPIC", "-o", shim, source, "-ldl"], check=True)
    for seconds in JUMPS:
        case = campaign.copy_of(start.before)
        with (case / "said").open("w") as told:
            status = subprocess.run(
                [sys.executable, "-m", "usdbrdf", *campaign.command(case, start.step)],
                env={**os.environ, "LD_PRELOAD": str(shim), "CLOCK_JUMP": str(seconds),
                     "TMPDIR": str(case / "tmp")},
                stdout=told, stderr=told, timeout=LONGEST_SECONDS, check=False,
            ).returncode  # fmt: skip
        campaign.ended(start, "clock", f"{seconds} s", case, status)


def cut(campaign: Campaign, start: Start, cuts: int) -> None:
    """One run, of which the disk is kept as it may be were the power off at some of its calls."""
    case = campaign.copy_of(start.before)
    disk, passed, disks = Disk(case), Counter[str](), []
    wanted = set(spread(campaign, start, CHANGES, cuts))

    def see(call: Call) -> int | None:
        passed[call.kind] += 1
        if (moment := (call.kind, passed[call.kind])) in wanted:
            loss = LOSSES[len(disks) % len(LOSSES)]
            place = campaign.work / f"cut-{next(campaign.cases):05d}"
            disk.after(place, loss, campaign.rng)
            disks.append((place, f"{moment[0]} {moment[1]}, {loss} lost"))
        disk.see(call)
        return None

    run_watched(campaign.work_of(case, start.step), WATCHED, case, see)
    ended = campaign.work / f"cut-{next(campaign.cases):05d}"
    disk.after(ended, LOSSES[0], campaign.rng)
    found = contents(ended / "room")
    lost = [file for file, sha256 in start.expected.items() if found.get(file) != sha256]
    problem = f"of a finished run {len(lost)} files are lost, first {lost[0]}" if lost else ""
    campaign.note(start, "power", problem)
    for place, where in (*disks, (ended, "the end")):
        shutil.rmtree(place / "tmp", ignore_errors=True)  # which a machine that starts clears
        (place / "tmp").mkdir()
        campaign.ended(start, "power", where, place, -signal.SIGKILL)


def disturb(campaign: Campaign, start: Start, fault: str, runs: int, cuts: int) -> None:
    if fault in SIGNALS:
        disturb_by_signals(campaign, start, fault, runs)
    elif fault == "stop":
        stop(campaign, start, runs)
    elif fault in ("full", "unmounted"):
        fill(campaign, start, fault, runs)
    elif fault == "unreadable":
        make_unreadable(campaign, start, runs)
    elif fault == "memory":
        narrow(campaign, start, runs)
    elif fault == "clock" and shutil.which("cc"):
        jump(campaign, start)
    elif fault == "power":
        cut(campaign, start, cuts)


@contextmanager
def working_folder(parent: Path | None) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="crash-campaign-", dir=parent) as name:
        yield Path(name)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=10, help="of each fault, for each start")
    parser.add_argument("--cuts", type=int, default=20, help="of the power, for each start")
    parser.add_argument("--rounds", type=int, default=1, help="how many times all that")
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=STEPS)
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=FAULTS)
    parser.add_argument("--minutes", type=float, default=1e9, help="no new fault after these")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, help="folder for the assets; default: a temporary one")
    parser.add_argument("--json", type=Path, help="write the figures into this file")
    chosen = parser.parse_args(arguments)
    if not can_watch():
        print("left out: watching system calls wants Linux 5.19 or later on x86-64")
        return 0
    tasks_identity()  # once, for all processes that are forked
    began = time.monotonic()
    end = began + 60 * chosen.minutes
    with working_folder(chosen.work) as work:
        campaign = Campaign(work, chosen.seed)
        campaign.load()
        starts = list(campaign.starts(chosen.steps))
        for number in range(chosen.rounds):
            for fault, start in itertools.product(chosen.faults, starts):
                if time.monotonic() < end:
                    disturb(campaign, start, fault, chosen.runs, chosen.cuts)
                    print(f"{fault}, {start.name}: {time.monotonic() - began:.0f} s", flush=True)
            print(f"round {number + 1} of {chosen.rounds}")
            status = told(campaign, chosen.json)
            if time.monotonic() > end:
                break
    return status


def told(campaign: Campaign, file: Path | None) -> int:
    print(f"{'step':<10} {'fault':<12} {'runs':>5} {'same':>5}")
    for (step, fault), problems in sorted(campaign.tally.items()):
        print(f"{step:<10} {fault:<12} {len(problems):>5} {problems.count(''):>5}")
    every = [problem for problems in campaign.tally.values() for problem in problems]
    print(
        f"{every.count('')} of {len(every)} disturbed runs ended in the same bytes; "
        f"{campaign.missed} more had ended before",
        flush=True,
    )
    if file is not None:
        table = [
            {"step": step, "fault": fault, "runs": len(problems), "same": problems.count(""),
             "problems": [problem for problem in problems if problem]}
            for (step, fault), problems in sorted(campaign.tally.items())
        ]  # fmt: skip
        file.write_text(json.dumps(table, indent=2) + "\n")
    return 0 if all(problem == "" for problem in every) else 1


if __name__ == "__main__":
    sys.exit(main())
