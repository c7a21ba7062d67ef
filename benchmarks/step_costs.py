"""What each step of a conversion costs: CPU seconds, how many of them while only one thread had
work, bytes read and written, memory.

    python benchmarks/step_costs.py CAPTURE [--texels 100000 400000] [--json FILE]

Each step runs as a command of its own, once for each number of texels. What the same command takes
when there is nothing to do (loading, hashing) is subtracted from its CPU seconds. "Serial" counts
what was spent while no more than one thread of the command and its children was running or waiting
for a core, looked at a hundred times a second: it holds on a busy machine too.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

STEPS = ("ingest", "texture", "shade", "fit")
_TICKS = os.sysconf("SC_CLK_TCK")


class Cost(NamedTuple):
    """Of a command: CPU seconds, those of one thread alone, bytes, MiB."""

    cpu: float
    serial: float
    read: int
    written: int
    peak_MiB: int


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--texels", type=int, nargs="+", default=[100_000, 400_000])
    parser.add_argument("--json", type=Path, help="write the figures into this file")
    chosen = parser.parse_args(arguments)
    runs = []
    with tempfile.TemporaryDirectory(prefix="step-costs-") as scratch:
        for texels in chosen.texels:
            found = measured(chosen.capture, Path(scratch) / f"asset-{texels}", texels)
            runs.append(found)
            print(json.dumps(found), flush=True)
    if chosen.json is not None:
        chosen.json.write_text(json.dumps({"runs": runs}, indent=2) + "\n")
    return 0


def measured(capture: Path, asset: Path, texels: int) -> dict[str, object]:
    words = {
        "ingest": [str(capture), "-o", str(asset)],
        "texture": [str(asset), "--max-texels", str(texels)],
        "shade": [str(asset)],
        "fit": [str(asset)],
    }
    costs = {}
    for step in STEPS:
        command = [sys.executable, "-m", "usdbrdf", step, *words[step], "-q"]
        work, nothing = cost_of(command), cost_of(command)
        costs[step] = work._replace(
            cpu=round(work.cpu - nothing.cpu, 2), serial=round(work.serial - nothing.serial, 2)
        )._asdict()
    stamp = json.loads((asset / ".usdbrdf/stamps/2-texture.json").read_text())["summary"]
    return {"texels": stamp.get("texels", texels), "steps": costs}


def cost_of(command: Sequence[str]) -> Cost:
    process = subprocess.Popen(command)
    serial = before = 0.0
    moved = (0, 0)
    while True:
        running, spent = state_of(process.pid)
        if running <= 1:
            serial += spent - before
        before, moved = max(spent, before), bytes_of(process.pid) or moved
        ended, status, used = os.wait4(process.pid, os.WNOHANG)
        if ended:
            process.returncode = os.waitstatus_to_exitcode(status)
            break
        time.sleep(0.01)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    return Cost(used.ru_utime + used.ru_stime, serial, *moved, used.ru_maxrss // 1024)


def state_of(pid: int) -> tuple[int, float]:
    """How many threads of a process and those below it have work, and its CPU seconds so far, with
    those of children that have ended."""
    running, spent = 0, 0.0
    for process in below(pid):
        try:
            own = fields_of(Path(f"/proc/{process}/stat"))
            spent += sum(int(own[i]) for i in (11, 12, 13, 14)) / _TICKS
            for task in Path(f"/proc/{process}/task").iterdir():
                running += fields_of(task / "stat")[0] == "R"
        except (OSError, IndexError):  # it ended meanwhile
            continue
    return running, spent


def below(pid: int) -> Iterator[int]:
    yield pid
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from below(int(child))
    except OSError:
        return


def fields_of(stat: Path) -> list[str]:
    """From the state on; the name before it may hold anything."""
    return stat.read_text().rpartition(")")[2].split()


def bytes_of(pid: int) -> tuple[int, int] | None:
    """Read and written, from the disk or not, with what ended children did."""
    try:
        rows = dict(r.split(": ") for r in Path(f"/proc/{pid}/io").read_text().splitlines())
    except OSError:
        return None
    return int(rows["rchar"]), int(rows["wchar"])


if __name__ == "__main__":
    sys.exit(main())
