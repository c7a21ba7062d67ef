"""What other processes change of a conversion: no byte, and how much of its time.

    python benchmarks/cluster.py CAPTURE [-o FOLDER] [--turns 3] [--kills 20] -- --texel-size 0.05

The capture is ingested once; what follows `--` are more options of `usdbrdf convert`, which does
the rest in fresh copies, in turns: in one process, and on 1, 2 and 4 workers. Then on 2 workers of
which one is killed with SIGKILL every few seconds; with one that is stopped (SIGSTOP); and with a
scheduler of its own: that is killed, and started for the same command once more; one of its workers
may write no file of more than 64 KiB, as if its disk were full; and one is in a network of its own
(root alone may make one), which is cut. Every published file counts.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
from measure import Spent, figure, median, ratio, report

from usdbrdf.files.atomic import sha256_of

WORKERS = (1, 2, 4)
# Seconds: between blows, at least and at most; and that a unit may take where one worker hangs.
BLOWS, LIMIT = (2.0, 6.0), 30.0
FULL_DISK, CUT_OFF = "full-disk", "cut-off"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    given = sys.argv[1:]
    end = given.index("--") if "--" in given else len(given)
    chosen = parser.parse_args(given[:end])
    with tempfile.TemporaryDirectory(prefix="cluster-") as scratch:
        bench = Bench(Path(scratch), chosen.capture.resolve(), given[end + 1 :], chosen.seed)
        results = bench.measure(chosen.turns, chosen.kills)
    report("cluster", results, chosen.output)
    return 0 if all(item["holds"] for item in results["figures"]) else 1


class Bench:
    """Runs of the steps on copies of one asset."""

    def __init__(self, folder: Path, capture: Path, options: Sequence[str], seed: int) -> None:
        self.folder, self.chance = folder, random.Random(seed)
        self.capture, self.options = capture, options
        self.made = folder / "made" / "asset"
        run("ingest", str(capture), "-o", str(self.made))

    def measure(self, turns: int, kills: int) -> dict[str, Any]:
        alone = self.steps("alone-0")
        spent: dict[int, list[Spent]] = {0: [alone[0]], **{n: [] for n in WORKERS}}
        differ: dict[str, int] = {}

        def count(name: str, found: dict[str, str]) -> None:
            names = found.keys() | alone[1].keys()
            differ[name] = sum(found.get(n) != alone[1].get(n) for n in names)
            print(f"{name}: {differ[name]} of {len(alone[1])} files differ", file=sys.stderr)

        for turn in range(turns):
            for workers in WORKERS if turn == 0 else (2,):
                took, found = self.steps(f"{workers}-{turn}", "--workers", str(workers))
                spent[workers].append(took)
                count(f"{workers} workers, turn {turn}", found)
            if turn + 1 < turns:
                took, found = self.steps(f"alone-{turn + 1}")
                spent[0].append(took)
                count(f"one process, turn {turn + 1}", found)
        blows = Blows(kills, self.chance, signal.SIGKILL)
        took, found = self.steps("killed", "--workers", "2", during=blows)
        count(f"{blows.struck} kills", found)
        stopped = Blows(1, self.chance, signal.SIGSTOP)
        given = ("--workers", "2", "--unit-limit", str(LIMIT))
        _, found = self.steps("stopped", *given, during=stopped)
        count(f"{stopped.struck} stopped", found)
        status, found = self.scheduler_killed()
        count("scheduler killed", found)
        statuses = {}
        for name, second in (("full disk", FULL_DISK), ("cut network", CUT_OFF)):
            statuses[name], found = self.second_worker_fails(second)
            count(name, found)
        same = [figure(f"{name}: files that differ", n, "", most=0) for name, n in differ.items()]
        of_engine = ratio(spent[2][:turns], spent[0][:turns])
        return {
            "seconds": {str(n): median(own)._asdict() for n, own in spent.items() if own},
            "turns": {str(n): [one._asdict() for one in own] for n, own in spent.items()},
            "kills": blows.struck,
            "killed": took._asdict(),
            "scheduler's end": status,
            "first ends": statuses,
            "figures": [
                *same,
                figure("kills", blows.struck, "", least=kills),
                figure("stopped workers", stopped.struck, "", least=1),
                figure("exit code without scheduler", status, "", least=4, most=4),
                figure("2 workers / one process, CPU", of_engine.cpu, "times", most=1.15),
                figure("2 workers / one process, clock", of_engine.wall, "times", most=1.15),
            ],
        }

    def fresh(self, name: str) -> Path:
        return shutil.copytree(self.made, self.folder / name / "asset")

    def steps(
        self, name: str, *options: str, during: Blows | None = None
    ) -> tuple[Spent, dict[str, str]]:
        """What the steps spend on a copy, and the hashes of what they publish."""
        asset = self.fresh(name)
        before, start = _cpu_of_children(), time.perf_counter()
        self.convert(asset, *options, during=during)
        spent = Spent(_cpu_of_children() - before, time.perf_counter() - start)
        print(f"{name}: {spent.cpu:.1f} s of CPU, {spent.wall:.1f} s", file=sys.stderr)
        found = contents(asset)
        shutil.rmtree(asset.parent)
        return spent, found

    def convert(
        self, asset: Path, *more: str, during: Blows | None = None, check: bool = True
    ) -> int:
        given = (str(self.capture), "-o", str(asset), *self.options, *more)
        return run("convert", *given, during=during, check=check)

    def scheduler_killed(self) -> tuple[int, dict[str, str]]:
        """Exit status of the step whose scheduler was killed, and what the next one published."""
        asset = self.fresh("scheduler")

        def strike(process: subprocess.Popen[bytes]) -> None:
            while not list(asset.glob(".usdbrdf/work/shade-*/*/checkpoints/tile-*")):
                time.sleep(0.1)
            process.kill()

        with scheduler() as (address, process, _):
            thread = threading.Thread(target=strike, args=(process,), daemon=True)
            thread.start()
            status = self.convert(asset, "--scheduler", address, check=False)
            thread.join()
        with scheduler() as (address, *_):
            self.convert(asset, "--scheduler", address)
        return status, contents(asset)

    def second_worker_fails(self, second: str) -> tuple[int, dict[str, str]]:
        """Exit status where one of two workers fails, and what that or, after a refusal, the same
        command with good workers published."""
        asset = self.fresh(second)
        with scheduler(second) as (address, _, cut):
            thread = threading.Thread(target=self._cut, args=(asset, cut), daemon=True)
            thread.start()
            given = ("--scheduler", address, "--unit-limit", str(LIMIT))
            status = self.convert(asset, *given, check=False)
            thread.join()
        if status:
            with scheduler() as (address, *_):
                self.convert(asset, "--scheduler", address)
        return status, contents(asset)

    def _cut(self, asset: Path, cut: Callable[[], None]) -> None:
        while not list(asset.glob(".usdbrdf/work/shade-*/*/checkpoints/tile-*")):
            time.sleep(0.1)
        cut()


class Blows:
    """Signals to workers at random times."""

    def __init__(self, most: int, chance: random.Random, number: signal.Signals) -> None:
        self.struck, self._most, self._chance, self._number = 0, most, chance, number

    def rain(self, process: subprocess.Popen[bytes], over: threading.Event) -> None:
        while self.struck < self._most and not over.wait(self._chance.uniform(*BLOWS)):
            try:
                family = psutil.Process(process.pid).children(recursive=True)
                workers = [one for one in family if "spawn_main" in " ".join(one.cmdline())]
                if workers:
                    self._chance.choice(workers).send_signal(self._number)
                    self.struck += 1
            except psutil.Error:
                continue


def run(*arguments: str, during: Blows | None = None, check: bool = True) -> int:
    process = subprocess.Popen([sys.executable, "-m", "usdbrdf", *arguments, "-q"])
    over = threading.Event()
    thread = threading.Thread(target=during.rain, args=(process, over)) if during else None
    if thread:
        thread.start()
    status = process.wait()
    over.set()
    if thread:
        thread.join()
    if check and status:
        raise SystemExit(f"usdbrdf {' '.join(arguments)} ended with {status}")
    return status


@contextmanager
def scheduler(
    second: str = "",
) -> Iterator[tuple[str, subprocess.Popen[bytes], Callable[[], None]]]:
    """Address and process of a scheduler on this machine, with two workers, the ``second`` of which
    may be one that fails; and what cuts that one off."""
    host, prefix, cut = "127.0.0.1", list[str](), lambda: None
    with ExitStack() as stack:
        if second == CUT_OFF:
            host, prefix, cut = stack.enter_context(network())
        with socket.socket() as free:
            free.bind((host, 0))
            port = free.getsockname()[1]
        address, processes = f"tcp://{host}:{port}", []

        def start(program: str, *words: str, before: Sequence[str] = ()) -> None:
            command = [sys.executable, "-m", f"distributed.cli.{program}", *words, "--no-dashboard"]
            nowhere = subprocess.DEVNULL
            one = {"NUMBA_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // 2))}
            processes.append(
                subprocess.Popen(
                    [*before, *command], stdout=nowhere, stderr=nowhere, env=os.environ | one
                )
            )

        start("dask_scheduler", "--host", host, "--port", str(port))
        worker = "dask_worker", address, "--nthreads", "1", "--no-nanny", "--memory-limit", "0"
        start(*worker)
        if second == FULL_DISK:
            prefix = ["prlimit", "--fsize=65536"]
        start(*worker, before=prefix)
        try:
            yield address, processes[0], cut
        finally:
            for process in processes:
                process.kill()
                process.wait()


@contextmanager
def network() -> Iterator[tuple[str, list[str], Callable[[], None]]]:
    """This machine's address in a network with one other, what begins a command there, and what
    cuts that network."""
    name, inside = "usdbrdf", "usdbrdf-in"
    own, other = "10.213.7.1", "10.213.7.2"

    def ip(*words: str) -> None:
        subprocess.run(["ip", *words], check=True)

    ip("netns", "add", name)
    try:
        ip("link", "add", name, "type", "veth", "peer", "name", inside, "netns", name)
        ip("address", "add", f"{own}/24", "dev", name)
        ip("link", "set", name, "up")
        within = ["ip", "netns", "exec", name]
        for words in (
            ("address", "add", f"{other}/24", "dev", inside),
            ("link", "set", inside, "up"),
        ):
            subprocess.run([*within, "ip", *words], check=True)
        yield own, within, lambda: ip("link", "set", name, "down")
    finally:
        ip("netns", "delete", name)


def contents(asset: Path) -> dict[str, str]:
    return {
        path.relative_to(asset).as_posix(): sha256_of(path)
        for path in asset.rglob("*")
        if path.is_file() and ".usdbrdf" not in path.parts
    }


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())
