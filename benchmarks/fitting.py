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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from measure import Lit, Spent, figure, lit_asset, parser_of, report, timed

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import frames_from_stage
from usdbrdf.files.frames import FrameReader
from usdbrdf.material import fit_objects
from usdbrdf.material.fit_objects import ObjectFit
from usdbrdf.material.fit_views import MIXTURE
from usdbrdf.model.capture import Frames
from usdbrdf.options import FitOptions
from usdbrdf.tasks import fit
from usdbrdf.texturing.footprints import RINGS
from usdbrdf.transport.lobe_radiance import LOBE_ALPHAS, Mixture

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
    found: ObjectFit
    record: Any


class Effort(NamedTuple):
    """How much goes into the fits: rays, and every how many-th of the frames and of the texels that
    were chosen among those followed. Default: what the fit step does."""

    mixture: Mixture = MIXTURE
    of_frames: int = 1
    of_texels: int = 1


DEFAULT = Effort()


def fitted(
    lit: Lit, asset: Path, most: int | None = None, effort: Effort = DEFAULT, seed: int = 0
) -> tuple[Spent, dict[str, Fitted]]:
    """Time of the pass over the frames, and each object by its label."""
    frames = some_frames(frames_from_stage(open_measured(Asset.at(asset))), effort.of_frames)
    options = FitOptions(seed=seed)
    usable = lit.atlas.coverage.measured & ~lit.atlas.emissive
    reader = FrameReader(frames, most_bytes=0)
    given = NoCheckpoints(), lit.scene, usable, reader, options
    survey, surveying = timed(lambda: fit_objects.survey_frames(*given))
    chosen = np.unique(survey.observations.texel)[:: effort.of_texels]
    kept = np.flatnonzero(np.isin(survey.observations.texel, chosen))
    survey = replace(survey, observations=survey.observations.take(kept))

    def fit_one(i: int) -> ObjectFit:
        mixture = effort.mixture
        lightings = [fit_objects.Lighting(lit.scene, survey)]
        return fit_objects.fit_object(
            lit.scene.lobe, lightings, reader, i, options, mixture=mixture
        )

    fit_one(0)  # compiles
    objects = {}
    for i, obj in enumerate(lit.atlas.scene.objects[:most]):
        found, used = timed(lambda i=i: fit_one(i))
        objects[obj.label] = Fitted(used, found, fit._record(obj, found.rounded(), options, True))
    return surveying, objects


def some_frames(frames: Frames, step: int) -> Frames:
    """Every ``step``-th of them."""
    names = ("image_paths", "world_from_camera", "intrinsics", "resolution", "exposure_time",
             "saturation_radiance", "noise_floor_radiance")  # fmt: skip
    return replace(frames, **{name: getattr(frames, name)[::step] for name in names})


def rays_per_sample(mixture: Mixture = MIXTURE) -> int:
    """Of one fit of a flat object: points of a footprint, times three independent sets, times the
    mixture's rays."""
    rays = mixture.per_lobe * len(LOBE_ALPHAS) + mixture.lights + mixture.cosine
    return 3 * len(RINGS) * rays


def measure(asset: Path, quick: bool) -> dict[str, Any]:
    surveying, objects = fitted(lit_asset(asset), asset, 6 if quick else None)
    # Objects without observations, as lamps, take no time and would flatter the mean.
    used = {label: one for label, one in objects.items() if np.isfinite(one.found.phi)}
    cpu = [one.spent.cpu for one in used.values()]
    wall = [one.spent.wall for one in used.values()]
    samples = [one.found.num_samples for one in used.values()]
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
            label: {"samples": one.found.num_samples, **one.spent._asdict()}
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
