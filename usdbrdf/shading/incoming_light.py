"""The light that arrives at points: both techniques' rays, made, traced and added up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.rays import RayScene
from usdbrdf.geometry.surface_radiance import SurfaceTexture
from usdbrdf.shading.environment import Environment
from usdbrdf.shading.irradiance_batches import add_cosine_batch, cosine_batch, frames_of
from usdbrdf.shading.light_batches import add_light_batch, light_batch
from usdbrdf.shading.light_groups import weighed_groups
from usdbrdf.shading.lights import Lights
from usdbrdf.shading.patch_draws import PatchDraws, scrambles_of_points

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Short = npt.NDArray[np.int16]
Long = npt.NDArray[np.int64]

# Cumulative chances of the groups of lights, guides to these and ratios, a row for each patch, as
# in ``light_batches.PickArrays``.
Picks: TypeAlias = tuple[Double, Short, Float]

BLOCKS = 4
# Points whose patches' tables of lights stay in the cache of a core together, and rays that are
# made, traced and added up at a time: enough to make the calls cheap, few enough for the cache.
_LIGHT_POINTS, _BATCH = 1 << 10, 1 << 14


class Points(NamedTuple):
    """Points of whole patches: origins of their rays and normals (P, 3), patches, random numbers'
    identities and strata, least S to hold errors against, and the row of their patch in what is
    kept for each, (P,)."""

    origin: Float
    normal: Float
    patch: Int
    identity: Long
    stratum: Int
    floor: Double
    row: Int

    def of(self, which: Any) -> Points:
        return Points(*(values[which] for values in self))


def whole_patches(patch: Int, points: int) -> list[slice]:
    """Ranges of about so many ``points`` that cut no patch."""
    starts = np.flatnonzero(np.diff(patch, prepend=-1))
    wanted = np.searchsorted(starts, np.arange(0, int(starts[-1]) + 1, points))
    firsts = [int(first) for first in np.unique(starts[wanted])]
    return [slice(first, last) for first, last in pairwise([*firsts, len(patch)])]


@dataclass(frozen=True, kw_only=True)
class IncomingLight:
    """All that brings light, and the one or two ``techniques`` that look for it."""

    rays: RayScene
    radiance: SurfaceTexture
    lights: Lights
    environment: Environment
    draws: PatchDraws
    techniques: int

    def picks(self, points: Points) -> Picks:
        """How the points' patches pick lights."""
        if self.techniques == 1:
            return np.zeros((0, 0)), np.zeros((0, 0), np.int16), np.zeros((0, 0), np.float32)
        groups = self.lights.groups
        return weighed_groups(
            groups.start, groups.bounds, points.origin, points.normal,
            np.searchsorted(points.row, np.arange(points.row[-1] + 2)),
        )  # fmt: skip

    def add(
        self,
        points: Points,
        picks: Picks,
        samples: tuple[int, int],
        sums: Double,
        escaped: Double,
    ) -> None:
        """Trace samples first to last of each point and add them to sums (2, 4, P, 3), one for each
        technique, and escaped (P,)."""
        frames = frames_of(points.normal)
        scrambles = scrambles_of_points(
            points.patch, points.stratum, points.identity, self.draws.seed, self.draws.shared
        )
        draws = self.draws.sobol, scrambles, self.draws.seed, points.identity
        groups = self.lights.groups.arrays, points.row, *picks
        radiance = self.radiance.arrays
        for start, stop, block in _batches(samples, len(points.origin)):
            origins, directions = cosine_batch(points.origin, frames, draws, start, stop)
            hits = self.rays.closest(origins, directions)
            add_cosine_batch(
                radiance, self.environment.arrays, self.lights.arrays, groups, points.normal,
                directions, (hits.face, hits.u, hits.v, hits.distance), block, sums[0], escaped,
            )  # fmt: skip
        if self.techniques == 1:
            return
        for part in whole_patches(points.patch, _LIGHT_POINTS):
            for start, stop, block in _batches(samples, part.stop - part.start):
                *segments, lit = light_batch(
                    groups, points.origin, points.normal, draws, (part.start, part.stop),
                    start, stop,
                )  # fmt: skip
                blocked = self.rays.occluded(*segments)
                add_light_batch(radiance, lit, blocked, block, sums[1])


def _batches(samples: tuple[int, int], points: int) -> Iterator[tuple[int, int, Long]]:
    """First and last sample of batches of about _BATCH rays, and their samples' blocks."""
    first, last = samples
    step = max(1, _BATCH // points)
    for start in range(first, last, step):
        stop = min(start + step, last)
        yield start, stop, _block_of(np.arange(start, stop), first, last)


def _block_of(sample: Long, first: int, last: int) -> Long:
    """The first round fills all four blocks; each later one the last two (the first two then hold
    what came before)."""
    if first == 0:
        return sample * BLOCKS // last
    return 2 + (sample - first) * 2 // (last - first)
