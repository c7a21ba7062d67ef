"""Seconds per object of the material fit.

    python benchmarks/fitting.py ASSET [-o FOLDER] [--quick]

ASSET was shaded; its capture's frames are where it names them. Measured are the pass over the
frames that gathers observations, once for all objects, and the fit of each object: its rays, the
grid of roughnesses, the variances and the posterior. CPU seconds of all threads, and the clock's.
What the fit step does besides, the refined maps, is in `scaling.py`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from measure import Spent, figure, lit_asset, parser_of, report, timed

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.material import fit_views as views
from usdbrdf.stage.asset import Asset
from usdbrdf.stage.read import frames_from_stage, open_measured
from usdbrdf.steps import fit, fit_objects
from usdbrdf.texturing.footprints import RINGS

T = TypeVar("T")


def main() -> int:
    options = parser_of(__doc__, "asset", quick="the first six objects only").parse_args()
    report("fitting", measure(options.asset, options.quick), options.output)
    return 0


class NoCheckpoints:
    """Stands for a run of the fit step; does what it is asked without keeping it."""

    def checkpoint(self, _name: str, work: Callable[[], T]) -> T:
        return work()


@dataclass(frozen=True)
class Fitted:
    """One object: time, what was found, and the record that would be published."""

    spent: Spent
    found: dict[str, np.ndarray]
    record: Any


def fitted(asset: Path, most: int | None = None) -> tuple[Spent, dict[str, Fitted]]:
    """Time of the pass over the frames, and each object by its label."""
    lit = lit_asset(asset)
    frames = frames_from_stage(open_measured(Asset.at(asset)))
    options = fit_objects.FitOptions()
    survey, surveying = timed(
        lambda: fit_objects.survey_frames(NoCheckpoints(), lit.atlas, lit.scene, frames, options)
    )
    fit_objects.fit_object(lit.scene, lit.atlas.texels, frames, survey, 0, options)  # compiles
    objects = {}
    for i, obj in enumerate(lit.atlas.scene.objects[:most]):
        found, used = timed(
            lambda i=i: fit_objects.fit_object(
                lit.scene, lit.atlas.texels, frames, survey, i, options
            )
        )
        objects[obj.label] = Fitted(used, found, fit._record(lit.scene, i, found, options, True))
    return surveying, objects


def rays_per_sample() -> int:
    """Of one footprint: points of it, times three independent sets, times the mixture's rays."""
    mixture, lobes = views._MIXTURE, 5
    rays = mixture.per_lobe * lobes + mixture.lights + mixture.cosine
    return 3 * len(RINGS) * rays


def measure(asset: Path, quick: bool) -> dict[str, Any]:
    surveying, objects = fitted(asset, 6 if quick else None)
    # Objects without observations, as lamps, take no time and would flatter the mean.
    used = {label: one for label, one in objects.items() if np.isfinite(one.found["numbers"][0])}
    cpu = [one.spent.cpu for one in used.values()]
    wall = [one.spent.wall for one in used.values()]
    samples = [int(one.found["used"]) for one in used.values()]
    per_sample = rays_per_sample()
    return {
        "asset": {"objects": len(objects), "fitted": len(used)},
        "cores": os.cpu_count(),
        "rays_per_sample": per_sample,
        "samples_per_object": float(np.mean(samples)),
        "survey_s": surveying._asdict(),
        "per_object_s": {
            "cpu": {"mean": float(np.mean(cpu)), "largest": max(cpu)},
            "wall": {"mean": float(np.mean(wall)), "largest": max(wall)},
        },
        "objects": {
            label: {"samples": int(one.found["used"]), **one.spent._asdict()}
            for label, one in used.items()
        },
        "figures": [
            figure("fit per object, mean, CPU", float(np.mean(cpu)), "s", most=2),
            figure("the same by the clock", float(np.mean(wall)), "s"),
            figure("fit per object, largest, CPU", max(cpu), "s"),
            figure("pass over the frames per object, CPU", surveying.cpu / len(used), "s"),
            figure("rays per sample and footprint", per_sample, ""),
        ],
    }


if __name__ == "__main__":
    sys.exit(main())
