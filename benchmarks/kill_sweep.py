"""Does a conversion that was killed at any moment end in the same bytes when it is run again?

    python benchmarks/kill_sweep.py CAPTURE [--kills 20] [--seed 0] -- --texel-size 0.05

One conversion runs undisturbed; what follows `--` are more options of `usdbrdf convert`. Then as
many as asked are started in fresh folders, killed with SIGKILL at random times, one in each equal
share of that duration, and started again by the same command. Every file of the asset counts, the
stamps too. Exit code 1 if one differs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from usdbrdf.files.atomic import TEMPORARY_PREFIX, sha256_of

STEPS = ("ingest", "texture", "shade", "fit")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, help="folder for the assets; default: a temporary one")
    given = list(sys.argv[1:] if arguments is None else arguments)
    end = given.index("--") if "--" in given else len(given)
    chosen = parser.parse_args(given[:end])
    with tempfile.TemporaryDirectory(prefix="kill-sweep-", dir=chosen.work) as name:
        same = sweep(chosen.capture, Path(name), chosen.kills, chosen.seed, given[end + 1 :])
    print(f"{same} of {chosen.kills} results are identical")
    return 0 if same == chosen.kills else 1


def sweep(capture: Path, work: Path, kills: int, seed: int, options: Sequence[str]) -> int:
    """Number of killed conversions that ended like the undisturbed one."""

    def command(asset: Path) -> list[str]:
        start = [sys.executable, "-m", "usdbrdf", "convert", str(capture), "-o", str(asset), "-q"]
        return [*start, *options]

    def asset_of(case: str) -> Path:
        # One name and depth for all: the assets' contents name both.
        (work / case).mkdir()
        return work / case / "asset"

    # The first run compiles what the others find in numba's cache.
    subprocess.run(command(asset_of("warm")), check=True)
    began = time.perf_counter()
    undisturbed = asset_of("undisturbed")
    subprocess.run(command(undisturbed), check=True)
    duration = time.perf_counter() - began
    expected = contents(undisturbed)
    print(f"undisturbed: {duration:.1f} s, {len(expected)} files")
    print(f"{'kill':>4} {'after':>8}  {'steps done':<22} {'resumed in':>10}  result")
    moments = (np.arange(kills) + np.random.default_rng(seed).random(kills)) / kills * duration
    same = 0
    for number, after in enumerate(moments):
        asset = asset_of(f"kill-{number}")
        killed = kill_after(command(asset), float(after))
        done = [s for s in STEPS if list((asset / ".usdbrdf" / "stamps").glob(f"*-{s}.json"))]
        began = time.perf_counter()
        status = subprocess.run(command(asset), check=False).returncode
        resumed = time.perf_counter() - began
        result = verdict(expected, contents(asset)) if status == 0 else f"exit {status}"
        same += result == "identical"
        if not killed:
            result += " (had ended before)"
        steps = " ".join(done) or "none"
        print(f"{number:>4} {after:>6.2f} s  {steps:<22} {resumed:>8.1f} s  {result}", flush=True)
        shutil.rmtree(asset)
    return same


def kill_after(command: Sequence[str], seconds: float) -> bool:
    """Run a command and kill it, not its children; False if it ended before."""
    process = subprocess.Popen(command)
    try:
        process.wait(seconds)
        return False
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True


def contents(asset: Path) -> dict[str, str]:
    """SHA-256 of every file below the asset folder."""
    files = sorted(path for path in asset.rglob("*") if path.is_file())
    return {os.fspath(path.relative_to(asset)): sha256_of(path) for path in files}


def verdict(expected: dict[str, str], found: dict[str, str]) -> str:
    names = sorted({*expected, *found})
    wrong = [name for name in names if expected.get(name) != found.get(name)]
    litter = [name for name in found if Path(name).name.startswith(TEMPORARY_PREFIX)]
    if wrong or litter:
        return f"{len(wrong)} files differ, first {(wrong + litter)[0]}"
    return "identical"


if __name__ == "__main__":
    sys.exit(main())
