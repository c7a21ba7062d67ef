"""All speed benchmarks with one command: one JSON, one Markdown table, plots.

    python benchmarks/run_all.py [--only NAME ...] [-o FOLDER] [--quick]
        [--asset ASSET] [--truth FOLDER] [--fit-asset ASSET]

NAME is shading, fitting, texturing, scaling or peer. ASSET was converted; without it the sample is
converted first, into FOLDER/study. --fit-asset: another one for `fitting`, a larger room say.
FOLDER (default: benchmark-results) gets speed.json, speed.md and the plots. Every figure is a ratio
against a reference of the same run, or CPU seconds beside those of the clock: others may use the
machine too. About 25 minutes on two cores, with --quick about 6.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Before anything that starts threads: those that wait must not burn CPU time, which is measured.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import fitting
import measure
import peer
import scaling
import shading
import texturing

import usdbrdf

SAMPLE = Path(__file__).resolve().parents[1] / "samples/study"
QUICK_FRAMES = 12


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    names = ("shading", "fitting", "texturing", "scaling", "peer")
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("-o", "--output", type=Path, default=Path("benchmark-results"))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--asset", type=Path)
    parser.add_argument("--truth", type=Path, default=SAMPLE / "truth")
    parser.add_argument("--fit-asset", type=Path)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)

    needed = set(options.only) - {"scaling"}
    asset = options.asset or options.output / "study"
    if needed and options.asset is None:
        usdbrdf.convert(SAMPLE, asset)
    quick = options.quick
    programs: dict[str, Callable[[], dict[str, Any]]] = {
        "shading": lambda: shading.measure(asset, quick),
        "fitting": lambda: fitting.measure(options.fit_asset or asset, quick),
        "texturing": lambda: textured(asset, quick),
        "scaling": lambda: scaling.measure(quick),
        "peer": lambda: peer.measure(asset, options.truth, quick),
    }
    results = {}
    for name in names:
        if name in options.only:
            print(f"{name} ...", file=sys.stderr)
            results[name] = programs[name]()
            write(options.output, results)
    return 0


def textured(asset: Path, quick: bool) -> dict[str, Any]:
    found = texturing.measure(asset, QUICK_FRAMES if quick else None)
    return {**found, "figures": texturing.figures(found)}


def write(folder: Path, results: dict[str, Any]) -> None:
    """What there is so far: a benchmark that fails costs none of those before it."""
    machine = {"cores": os.cpu_count(), "processor": platform.machine()}
    document = {"machine": machine, **results}
    (folder / "speed.json").write_text(json.dumps(document, indent=2) + "\n")
    plots = {"shading": shading.plot, "scaling": scaling.plot, "peer": peer.plot}
    parts = [f"# Speed\n\n{os.cpu_count()} cores, {platform.machine()}."]
    for name, found in results.items():
        part = f"## {name}\n\n"
        if "skipped" in found:
            parts.append(f"{part}Skipped: {found['skipped']}.")
            continue
        part += measure.table(found["figures"])
        if name in plots:
            part += f"\n\n![{name}]({plots[name](found, folder).name})"
        parts.append(part)
    text = "\n\n".join(parts) + "\n"
    (folder / "speed.md").write_text(text)
    print(parts[-1])


if __name__ == "__main__":
    sys.exit(main())
