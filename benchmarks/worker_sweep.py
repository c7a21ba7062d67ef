"""Does a conversion whose workers are killed or stopped, or that is interrupted, end in the same
bytes, and leave nothing behind?

    python benchmarks/worker_sweep.py CAPTURE [--workers 2] [--moments 3] [--stopped 30] [--seed 0]
        [--blows kill stop interrupt] [--work DIR] [--json FILE]
        [--texture='--texel-size 0.05'] [--shade='--rays 64'] [--fit='--max-pixels 300']

One asset is made undisturbed, step by step, each with its own options. Then, for each kind of blow,
`usdbrdf convert --workers` makes what texture, shade and fit make, and in each of these steps, at a
random time in each equal share of its duration, one worker is killed (SIGKILL), or stopped for a
while (SIGSTOP, SIGCONT), or the command itself, which is the scheduler's process, is interrupted
(SIGINT) and started again. At the end the same command runs once more: every file of the asset, the
stamps too, must be that of the undisturbed asset. After each command no process, no temporary file
and nothing in /dev/shm may be left of it. A blow that found no worker, or whose step had ended
before, is told as such and counts for nothing. With --work the undisturbed asset is kept there for
the next time. Exit code 1 if anything differs.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import psutil
from kill_sweep import contents, verdict

STEPS = ("texture", "shade", "fit")
BLOWS = ("kill", "stop", "interrupt")
# Seconds between looks at a run, and in which all that it started is to be gone.
LOOK, GONE = 0.05, 10.0
MEMORY = Path("/dev/shm")
# How a run ends that was interrupted.
INTERRUPTED = (-signal.SIGINT, 130)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--moments", type=int, default=3)
    parser.add_argument("--stopped", type=float, default=30.0, help="seconds until SIGCONT")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--blows", nargs="+", choices=BLOWS, default=BLOWS)
    for step in STEPS:
        parser.add_argument(f"--{step}", type=shlex.split, default=[], help="its own options")
    parser.add_argument("--work", type=Path, help="folder for the assets; default: a temporary one")
    parser.add_argument("--json", type=Path, help="each case is a line there, as it ends")
    chosen = parser.parse_args()
    options = {step: getattr(chosen, step) for step in STEPS}
    with ExitStack() as held:
        work = chosen.work or Path(held.enter_context(tempfile.TemporaryDirectory()))
        sweep = Sweep(work, chosen.capture.resolve(), chosen.workers, options, chosen.stopped)
        sweep.prepare()
        problems = 0
        for blow in chosen.blows:
            for line in sweep.series(blow, chosen.moments, np.random.default_rng(chosen.seed)):
                print(json.dumps(line), flush=True)
                problems += bool(line["problem"])
                if chosen.json is not None:
                    with chosen.json.open("a") as told:
                        told.write(json.dumps(line) + "\n")
    return 1 if problems else 0


def _hears_interrupts() -> None:
    """What a shell starts in the background would not."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Sweep:
    """Runs in copies of one asset, as it was before each step."""

    def __init__(
        self,
        work: Path,
        capture: Path,
        workers: int,
        options: Mapping[str, list[str]],
        stopped: float,
    ) -> None:
        self.work, self.capture, self.options, self.stopped = work, capture, options, stopped
        self.workers = str(workers)
        self.seconds: dict[str, float] = {}
        self.expected: dict[str, str] = {}

    def prepare(self) -> None:
        """The asset before its first step here, the one that is expected, and how long each step
        takes."""
        self.work.mkdir(parents=True, exist_ok=True)
        record = self.work / "undisturbed.json"
        if not record.is_file():
            case = self.new_case()
            self.run(case, "ingest", str(self.capture), "-o", str(case / "asset"))
            shutil.copytree(case, self.work / "ingested")
            seconds = {}
            for step in STEPS:
                words = str(case / "asset"), "--workers", self.workers, *self.options[step]
                process = self.started(case, step, *words)
                self.reached(process, case / "asset", step)
                began = time.perf_counter()
                self.ended(case, step, process)
                seconds[step] = time.perf_counter() - began
            self.run(case, *self.convert(case))
            found = {"seconds": seconds, "files": contents(case / "asset")}
            record.write_text(json.dumps(found))
            shutil.rmtree(case)
        known = json.loads(record.read_text())
        self.seconds, self.expected = known["seconds"], known["files"]
        told = ", ".join(f"{step} {spent:.0f} s" for step, spent in self.seconds.items())
        print(f"undisturbed: {told}; {len(self.expected)} files", flush=True)

    def new_case(self) -> Path:
        """A folder for an asset and for temporary files; all are equally deep."""
        case, before = Path(tempfile.mkdtemp(prefix="case-", dir=self.work)), self.work / "ingested"
        if before.is_dir():
            shutil.copytree(before, case, dirs_exist_ok=True)
        shutil.rmtree(case / "tmp", ignore_errors=True)
        (case / "tmp").mkdir()
        return case

    def convert(self, case: Path) -> list[str]:
        start = ["convert", str(self.capture), "-o", str(case / "asset")]
        own = [word for step in STEPS for word in self.options[step]]
        return [*start, "--workers", self.workers, *own]

    def started(self, case: Path, *arguments: str) -> subprocess.Popen[bytes]:
        with (case / "said").open("ab") as told:
            return subprocess.Popen(
                [sys.executable, "-m", "usdbrdf", *arguments, "-q"],
                env={**os.environ, "TMPDIR": str(case / "tmp")},
                stdout=told, stderr=told, preexec_fn=_hears_interrupts,
            )  # fmt: skip

    def run(self, case: Path, *arguments: str) -> None:
        self.ended(case, arguments[0], self.started(case, *arguments))

    def ended(self, case: Path, name: str, process: subprocess.Popen[bytes]) -> None:
        if status := process.wait():
            raise SystemExit(f"{name} ended with {status}: {(case / 'said').read_text()}")

    def series(
        self, blow: str, moments: int, rng: np.random.Generator
    ) -> Iterator[dict[str, object]]:
        """A line for each blow, and one for what it all came to."""
        case, before = self.new_case(), set(os.listdir(MEMORY))
        process, struck, problem = self.started(case, *self.convert(case)), 0, ""
        for step in STEPS:
            begun = 0.0
            for moment in range(moments):
                if not begun and self.reached(process, case / "asset", step):
                    begun = time.monotonic()
                share = (moment + rng.random()) / moments
                if blow == "interrupt":  # what is done already is not done again
                    share, begun = share - moment / moments, time.monotonic()
                due = begun + share * self.seconds[step]
                what = self.struck(process, case / "asset", step, blow, due)
                found = ""
                if what and blow == "interrupt":
                    if (status := process.wait()) not in INTERRUPTED:
                        found = f"ended with {status}; "
                    found += self.left(case, before)
                    process = self.started(case, *self.convert(case))
                struck += bool(what)
                problem += found
                yield {"blow": blow, "step": step, "struck": what, "problem": found}
        if status := process.wait():
            problem += f"ended with {status}; "
        problem += self.left(case, before)
        again = self.started(case, *self.convert(case)).wait()
        result = verdict(self.expected, contents(case / "asset")) if again == 0 else f"exit {again}"
        problem += self.left(case, before) + ("" if result == "identical" else result)
        said = (case / "said").read_text(errors="replace")
        if "Traceback" in said:
            problem += "; a traceback"
        if problem:
            problem += f": {said[-500:]}"
        else:
            shutil.rmtree(case)
        yield {"blow": blow, "struck": struck, "result": result, "problem": problem}

    def reached(self, process: subprocess.Popen[bytes], asset: Path, step: str) -> bool:
        """Wait until a step is at work; False where the command ended before."""
        while not self.at_work(asset, step):
            if process.poll() is not None:
                return False
            time.sleep(LOOK)
        return True

    def struck(
        self, process: subprocess.Popen[bytes], asset: Path, step: str, blow: str, due: float
    ) -> str:
        """Strike once that time has come, and say what was struck; "" where the step ended
        before."""
        while process.poll() is None and self.at_work(asset, step):
            time.sleep(LOOK)
            if time.monotonic() < due:
                continue
            if blow == "interrupt":
                process.send_signal(signal.SIGINT)
                return "the command"
            try:
                family = psutil.Process(process.pid).children(recursive=True)
                workers = [one for one in family if "spawn_main" in " ".join(one.cmdline())]
                if not workers:
                    continue  # they are not there yet
                worker = workers[int(due * 1e3) % len(workers)]
                worker.send_signal(signal.SIGKILL if blow == "kill" else signal.SIGSTOP)
            except psutil.Error:
                continue
            told = f"a worker of {len(workers)}"
            if blow == "stop":
                time.sleep(self.stopped)
                if not worker.is_running():
                    return f"{told}, gone by then"
                worker.resume()
            return told
        return ""

    def at_work(self, asset: Path, step: str) -> bool:
        state = asset / ".usdbrdf"
        return any(state.glob(f"work/{step}-*")) and not any(state.glob(f"stamps/*-{step}.json"))

    def left(self, case: Path, before: set[str]) -> str:
        """Processes, temporary files and shared memory that a run left, in words."""
        end = time.monotonic() + GONE
        while (found := self._left(case, before)) and time.monotonic() < end:
            time.sleep(LOOK)
        return f"left {found}; " if found else ""

    def _left(self, case: Path, before: set[str]) -> str:
        place, running = str(case / "tmp"), Counter[str]()
        for process in psutil.process_iter():
            try:
                if process.environ().get("TMPDIR") == place:
                    running[process.name()] += 1
            except psutil.Error:
                continue
        parts = [f"{n} processes {name}" for name, n in running.items()]
        parts += [f"temporary {name}" for name in os.listdir(place)]
        parts += [f"memory {name}" for name in sorted(set(os.listdir(MEMORY)) - before)]
        return ", ".join(parts)


if __name__ == "__main__":
    sys.exit(main())
