"""How the time of each step grows with texels, triangles, frames and objects.

    python benchmarks/scaling.py [-o FOLDER] [--quick]

Captures of `generated_capture.py` are converted, each differing from a small one in one size only.
The growth of a step is the exponent e in time ~ size^e, a line through the logarithms of its CPU
seconds; a step's fixed cost makes it smaller, so that of the largest doubling is what counts:
`last` is the exponent from the last but one size to the last.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import Spent, figure, parser_of, report, saved_plot, timed

import usdbrdf
from usdbrdf.asset.layout import Asset

STEPS = ("ingest", "texture", "shade", "fit")


@dataclass(frozen=True)
class Size:
    """Of a capture and of its conversion."""

    texels: int = 60_000
    triangles: int = 3_000
    frames: int = 10
    objects: int = 10


SMALL = Size()
# The first of each is SMALL itself.
SERIES = {"texels": (1, 4, 16), "triangles": (1, 10, 100), "frames": (1, 4), "objects": (1, 10)}
QUICK = {"texels": (1, 4), "triangles": (1, 10)}
RESOLUTION = ("--width", "320", "--height", "240")


def main() -> int:
    options = parser_of(__doc__).parse_args()
    report("scaling", measure(options.quick), options.output, plot)
    return 0


def measure(quick: bool) -> dict[str, Any]:
    series: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        converted(replace(SMALL, frames=8, texels=10_000), folder)  # compiles
        small = converted(SMALL, folder)
        for name, factors in (QUICK if quick else SERIES).items():
            series[name] = [small] + [
                converted(replace(SMALL, **{name: factor * getattr(SMALL, name)}), folder)
                for factor in factors[1:]
            ]
    growth = {
        name: {step: exponents(runs, name, step) for step in STEPS} for name, runs in series.items()
    }
    return {"series": series, "growth": growth, "figures": figures(growth)}


def converted(size: Size, folder: Path) -> dict[str, Any]:
    """What came of the size that was asked for, and each step's seconds."""
    capture = folder / f"capture-{size.triangles}-{size.frames}-{size.objects}"
    if not capture.exists():
        sizes = (f"--{name}={getattr(size, name)}" for name in ("triangles", "frames", "objects"))
        program = Path(__file__).with_name("generated_capture.py")
        command = [sys.executable, str(program), str(capture), *sizes, *RESOLUTION]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    output = folder / f"asset-{size.texels}-{capture.name}"
    # 8 x 6 x 3 m and what stands in it: about 250 m^2.
    texel = math.sqrt(250 / size.texels)
    seconds: dict[str, Spent] = {}
    with usdbrdf.working_on(output) as asset:
        works = {
            "ingest": lambda: usdbrdf.ingest(capture, asset, usdbrdf.IngestOptions()),
            "texture": lambda: usdbrdf.texture(asset, usdbrdf.TextureOptions(texel_size=texel)),
            "shade": lambda: usdbrdf.shade(asset, usdbrdf.ShadeOptions()),
            "fit": lambda: usdbrdf.fit(asset, usdbrdf.FitOptions()),
        }
        for step in STEPS:
            _, seconds[step] = timed(works[step])
        sizes_found = found(asset)
    return {**sizes_found, "seconds": {step: time._asdict() for step, time in seconds.items()}}


def found(asset: Asset) -> dict[str, int]:
    from usdbrdf.asset.maps import AssetMaps
    from usdbrdf.asset.readers.compose import open_measured
    from usdbrdf.asset.readers.scene import frames_from_stage

    stage = open_measured(asset)
    atlas = AssetMaps(stage)
    return {
        "texels": len(atlas.texels),
        "triangles": len(atlas.scene.triangles),
        "frames": len(frames_from_stage(stage)),
        "objects": len(atlas.scene.objects),
    }


def exponents(runs: list[dict[str, Any]], name: str, step: str) -> dict[str, float]:
    sizes = np.log([run[name] for run in runs])
    times = np.log([run["seconds"][step]["cpu"] for run in runs])
    return {
        "all": float(np.polyfit(sizes, times, 1)[0]),
        "last": float((times[-1] - times[-2]) / (sizes[-1] - sizes[-2])),
    }


def figures(growth: dict[str, Any]) -> list[dict[str, Any]]:
    # Clocks are noisy: linear is taken to be up to 1.1.
    most = {"texels": 1.1, "frames": 1.1, "triangles": 1.0, "objects": 1.1}
    return [
        figure(f"growth of {step} with {name}, last", of[step]["last"], "", most=most[name])
        for name, of in growth.items()
        for step in STEPS
    ]


def plot(results: dict[str, Any], folder: Path) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    series = results["series"]
    drawing, all_axes = pyplot.subplots(
        1, len(series), figsize=(3.2 * len(series), 3.2), sharey=True, layout="constrained",
        squeeze=False,
    )  # fmt: skip
    for axes, (name, runs) in zip(all_axes[0], series.items(), strict=True):
        sizes = [run[name] for run in runs]
        for step in STEPS:
            axes.loglog(sizes, [run["seconds"][step]["cpu"] for run in runs], "o-", label=step)
        axes.set(xlabel=name)
    all_axes[0, 0].set(ylabel="CPU seconds")
    all_axes[0, 0].legend()
    return saved_plot(drawing, folder / "scaling.png")


if __name__ == "__main__":
    sys.exit(main())
