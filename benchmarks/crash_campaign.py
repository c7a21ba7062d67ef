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
several times, each at other calls. With `--json` every result is a line there, and a campaign that
was stopped goes on where it was; what it found of other sources does not count.
"""

from __future__ import annotations

import argparse
import errno
import itertools
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from crash_cases import LONGEST_SECONDS, Campaign, Results, Series, in_fork
from kill_sweep import STEPS, contents
from power_loss import LOSSES, WATCHED, Disk
from system_calls import Call, can_watch, run_watched

# Calls that change what a disk holds.
CHANGES = ("write", "sync", "rename", "unlink", "mkdir", "create")
FULL = ("write", "sync", "mkdir", "create")
SIGNALS = {"kill": signal.SIGKILL, "terminate": signal.SIGTERM, "interrupt": signal.SIGINT}
FAULTS = (*SIGNALS, "stop", "full", "unreadable", "unmounted", "memory", "clock", "power")
JUMPS = (3600, 10**8, 2 * 10**9)  # seconds; the last are years before 1970 and after 2038


def spread(series: Series, kinds: Sequence[str], runs: int) -> list[tuple[str, int]]:
    """Kind and number, from 1, of so many calls: each kind its share, and of its calls one in each
    equal part."""
    calls, rng = series.start.calls, series.rng()
    there = [kind for kind in kinds if calls[kind]]
    chosen = []
    for i, kind in enumerate(there):
        share = len(range(i, runs, len(there)))
        places = (np.arange(share) + rng.random(share)) / max(share, 1)
        chosen += [(kind, 1 + int(place * calls[kind])) for place in places]
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


def each_place(
    campaign: Campaign, series: Series, kinds: Sequence[str], runs: int
) -> Iterator[tuple[int, Path, str, int]]:
    """Of each case that waits its number, a folder for it, and the call to be disturbed."""
    places = spread(series, kinds, runs)
    for name in campaign.waiting(series, len(places)):
        yield name, campaign.copy_of(series.start.before), *places[name]


def disturb_by_signals(campaign: Campaign, series: Series, runs: int) -> None:
    for name, case, kind, number in each_place(campaign, series, CHANGES, runs):

        def strike(call: Call) -> None:
            os.kill(call.process, SIGNALS[series.fault])

        work = campaign.work_of(case, series.start.step)
        status = run_watched(work, WATCHED, case, (where := At(kind, number, strike)))
        campaign.ended(series, name, where.struck, case, status)


def stop(campaign: Campaign, series: Series, runs: int) -> None:
    """SIGSTOP, the same command beside it, which has to be refused, and SIGCONT."""
    step = series.start.step
    for name, case, kind, number in each_place(campaign, series, CHANGES, runs):
        refused: list[int] = []

        def strike(call: Call, case: Path = case, refused: list[int] = refused) -> None:
            os.kill(call.process, signal.SIGSTOP)
            refused.append(campaign.run(case, step))
            os.kill(call.process, signal.SIGCONT)

        work = campaign.work_of(case, step)
        status = run_watched(work, WATCHED, case, (where := At(kind, number, strike)))
        # Before the lock is taken and after it is given back there is nobody to meet.
        if refused not in ([], [5], [0]):
            status = 1
        what = where.struck and f"{where.struck}, beside it {refused}"
        campaign.ended(series, name, what, case, status)


def fill(campaign: Campaign, series: Series, runs: int) -> None:
    """From the n-th call on, a disk that is full or a mount that is gone."""
    full = series.fault == "full"
    failing = FULL if full else (*CHANGES, "open", "read")
    error = errno.ENOSPC if full else errno.ESTALE
    for name, case, kind, number in each_place(campaign, series, failing, runs):
        state = {"failed": False}

        def fail(_: Call, state: dict[str, bool] = state) -> int:
            state["failed"] = True
            return error

        where = At(kind, number, fail)

        def answer(call: Call, where=where, state=state) -> int | None:  # type: ignore[no-untyped-def]
            return error if state["failed"] and call.kind in failing else where(call)

        kinds = WATCHED if full else (*WATCHED, "read")
        work, root = campaign.work_of(case, series.start.step), case if full else case / "room"
        status = run_watched(work, kinds, root, answer)
        campaign.ended(series, name, where.struck, case, status)


def make_unreadable(campaign: Campaign, series: Series, runs: int) -> None:
    """One read of an input, or of what an earlier step wrote, fails."""
    for name, case, kind, number in each_place(campaign, series, ("read", "open"), runs):
        status = run_watched(
            campaign.work_of(case, series.start.step), ("read", "open"), campaign.work,
            (where := At(kind, number, lambda _: errno.EIO)),
        )  # fmt: skip
        campaign.ended(series, name, where.struck, case, status)


def narrow(campaign: Campaign, series: Series, runs: int) -> None:
    """Addresses for all that is loaded and a little more."""
    with open("/proc/self/statm") as statm:
        loaded = int(statm.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    more = np.geomspace(1 << 26, 1 << 32, runs)
    for name in campaign.waiting(series, runs):
        case = campaign.copy_of(series.start.before)
        work = campaign.work_of(case, series.start.step)
        limit = loaded + int(more[name])

        def limited(work: Callable[[], int] = work, limit: int = limit) -> int:
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            return work()

        campaign.ended(series, name, f"{limit >> 20} MiB", case, in_fork(limited))


def jump(campaign: Campaign, series: Series) -> None:
    """A clock that jumps back and on at every look, in a process of its own."""
    shim = campaign.work / "jumping_clock.so"
    source = Path(__file__).with_name("jumping_clock.c")
    if not shim.exists():
        subprocess.run(["cc", "-shared", "-fPIC", "-o", shim, source, "-ldl"], check=True)
    for name in campaign.waiting(series, len(JUMPS)):
        case, seconds = campaign.copy_of(series.start.before), JUMPS[name]
        with (case / "said").open("w") as told:
            status = subprocess.run(
                [sys.executable, "-m", "usdbrdf", *campaign.command(case, series.start.step)],
                env={**os.environ, "LD_PRELOAD": str(shim), "CLOCK_JUMP": str(seconds),
                     "TMPDIR": str(case / "tmp")},
                stdout=told, stderr=told, timeout=LONGEST_SECONDS, check=False,
            ).returncode  # fmt: skip
        campaign.ended(series, name, f"{seconds} s", case, status)


def cut(campaign: Campaign, series: Series, cuts: int) -> None:
    """One run, of which the disk is kept as it may be were the power off at some of its calls."""
    start, places = series.start, spread(series, CHANGES, cuts)
    # The last case is the power off once the run has ended.
    names = campaign.waiting(series, len(places) + 1)
    if not names:
        return
    wanted = {places[name]: name for name in names if name < len(places)}
    case = campaign.copy_of(start.before)
    disk, passed, disks = Disk(case), Counter[str](), []

    def see(call: Call) -> int | None:
        passed[call.kind] += 1
        if (moment := (call.kind, passed[call.kind])) in wanted:
            name, loss = wanted[moment], LOSSES[wanted[moment] % len(LOSSES)]
            place = campaign.work / f"cut-{next(campaign.cases):05d}"
            disk.after(place, loss, series.rng(name))
            disks.append((name, place, f"{moment[0]} {moment[1]}, {loss} lost"))
        disk.see(call)
        return None

    run_watched(campaign.work_of(case, start.step), WATCHED, case, see)
    if len(places) in names:
        ended = campaign.work / f"cut-{next(campaign.cases):05d}"
        disk.after(ended, LOSSES[0], series.rng("the end"))
        found = contents(ended / "room")
        lost = [file for file, sha256 in start.expected.items() if found.get(file) != sha256]
        if lost:
            problem = f"of a finished run {len(lost)} files are lost, first {lost[0]}"
            campaign.note(series, "what is finished", problem)
        disks.append((len(places), ended, "the end"))
    shutil.rmtree(case)
    for name, place, where in disks:
        shutil.rmtree(place / "tmp", ignore_errors=True)  # which a machine that starts clears
        (place / "tmp").mkdir()
        campaign.ended(series, name, where, place, -signal.SIGKILL)


def disturb(campaign: Campaign, series: Series, runs: int, cuts: int) -> None:
    fault = series.fault
    if fault in SIGNALS:
        disturb_by_signals(campaign, series, runs)
    elif fault == "stop":
        stop(campaign, series, runs)
    elif fault in ("full", "unmounted"):
        fill(campaign, series, runs)
    elif fault == "unreadable":
        make_unreadable(campaign, series, runs)
    elif fault == "memory":
        narrow(campaign, series, runs)
    elif fault == "clock" and shutil.which("cc"):
        jump(campaign, series)
    elif fault == "power":
        cut(campaign, series, cuts)


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
    parser.add_argument("--json", type=Path, help="add each result to this file, one a line")
    chosen = parser.parse_args(arguments)
    if not can_watch():
        print("left out: watching system calls wants Linux 5.19 or later on x86-64")
        return 0
    began = time.monotonic()
    end = began + 60 * chosen.minutes
    # The sources' hashes, too, are found once for all processes that are forked.
    results = Results(chosen.json)
    with working_folder(chosen.work) as work:
        campaign = Campaign(work, results)
        campaign.load()
        starts = list(campaign.starts(chosen.steps))
        every = itertools.product(range(chosen.rounds), chosen.faults, starts)
        for number, fault, start in every:
            if time.monotonic() < end:
                series = Series(start, fault, (chosen.seed, number))
                disturb(campaign, series, chosen.runs, chosen.cuts)
                passed = time.monotonic() - began
                print(f"{fault}, {start.name}, round {number + 1}: {passed:.0f} s", flush=True)
    return told(results)


def told(results: Results) -> int:
    print(f"{'step':<10} {'fault':<12} {'runs':>5} {'same':>5}")
    tally = results.tally()
    for (step, fault), problems in sorted(tally.items()):
        print(f"{step:<10} {fault:<12} {len(problems):>5} {problems.count(''):>5}")
    every = [problem for problems in tally.values() for problem in problems]
    print(
        f"{every.count('')} of {len(every)} disturbed runs ended in the same bytes; "
        f"{len(results.known) - len(every)} more had ended before",
        flush=True,
    )
    return 0 if all(problem == "" for problem in every) else 1


if __name__ == "__main__":
    sys.exit(main())
