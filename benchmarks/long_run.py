"""Do many conversions in a row leave anything behind: memory, files, threads, temporary folders?

    python benchmarks/long_run.py [--conversions 200] [--command-line] [--json FILE]

The tiny room of `generated_capture.py` is converted again and again, each time into a new folder
and packed, in one process through the Python interface; with `--command-line` each in a process of
its own, where only what stays on disk is of interest. What the first conversions load and keep does
not count: memory is told by its growth over the last half. Exit code 1 beyond `LIMITS`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from generated_capture import write_tiny

OPTIONS = ("--texel-size", "1", "--rays", "16", "--max-pixels", "60")
# MiB that a conversion may add, and how many open files, threads and temporary folders more there
# may be at the end than after the first half.
LIMITS = {"resident": 0.05, "files": 0, "threads": 0, "folders": 0}


class State(NamedTuple):
    """What the process has: MiB of resident memory, open files, threads, temporary folders."""

    resident: float
    files: int
    threads: int
    folders: int


def state(temporary: Path) -> State:
    with open("/proc/self/statm") as statm:
        pages = int(statm.read().split()[1])
    return State(
        resident=pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20),
        files=len(os.listdir("/proc/self/fd")),
        threads=len(os.listdir("/proc/self/task")),
        folders=len(os.listdir(temporary)),
    )


def converted_here(capture: Path, asset: Path) -> None:
    from usdbrdf.delivery.package import package
    from usdbrdf.options import ConvertOptions, FitOptions, Sampling, ShadeOptions, TextureOptions
    from usdbrdf.pipeline import convert

    options = ConvertOptions(
        texture=TextureOptions(texel_size=1.0),
        shade=ShadeOptions(sampling=Sampling(max_rays=16)),
        fit=FitOptions(max_pixels=60),
    )
    convert(capture, asset, options)
    package(asset, asset.parent / "room.usdz")


def converted_by_command(capture: Path, asset: Path) -> None:
    command = [sys.executable, "-m", "usdbrdf", "convert", str(capture), "-o", str(asset), "-q"]
    subprocess.run([*command, *OPTIONS], check=True)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--conversions", type=int, default=200)
    parser.add_argument("--command-line", action="store_true")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after these")
    parser.add_argument("--json", type=Path, help="write the figures into this file")
    chosen = parser.parse_args(arguments)
    convert = converted_by_command if chosen.command_line else converted_here
    end = time.monotonic() + 60 * chosen.minutes
    states: list[State] = []
    with tempfile.TemporaryDirectory(prefix="long-run-") as name:
        capture, temporary = Path(name) / "scan", Path(name) / "tmp"
        temporary.mkdir()
        os.environ["TMPDIR"] = tempfile.tempdir = str(temporary)
        write_tiny(capture)
        for number in range(chosen.conversions):
            if time.monotonic() > end:
                break
            case = Path(name) / "made"
            convert(capture, case / "room")
            shutil.rmtree(case)
            states.append(state(temporary))
            if number % max(1, chosen.conversions // 20) == 0:
                print(f"{number + 1:>5}  {told(states[-1])}", flush=True)
        tempfile.tempdir = None
    return judged(states, chosen.json)


def told(one: State) -> str:
    return (
        f"{one.resident:8.1f} MiB  {one.files:>3} files  {one.threads:>3} threads  "
        f"{one.folders} temporary folders"
    )


def judged(states: Sequence[State], file: Path | None) -> int:
    half = states[len(states) // 2 :]
    growth = float(np.polyfit(np.arange(len(half)), [one.resident for one in half], 1)[0])
    more = {
        key: getattr(half[-1], key) - getattr(half[0], key)
        for key in ("files", "threads", "folders")
    }
    grown = {"resident": growth, **more}
    print(f"{len(states)} conversions; at the end {told(states[-1])}")
    print(f"memory grows by {growth:.3f} MiB a conversion over the last half; {more}")
    if file is not None:
        table = {
            "conversions": len(states),
            "grown": grown,
            "states": [*map(State._asdict, states)],
        }
        file.write_text(json.dumps(table, indent=2) + "\n")
    return int(any(grown[key] > limit for key, limit in LIMITS.items()))


if __name__ == "__main__":
    sys.exit(main())
