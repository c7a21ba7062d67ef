"""The light that arrives at points, by both techniques; its mean and error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Double, Float, Int, Long, Short
from usdbrdf.transport.cosine_sampling import add_light_by_direction
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.light_groups import LightGroups, weighed_groups
from usdbrdf.transport.light_sampling import add_light_by_picks
from usdbrdf.transport.patch_draws import PatchDraws, scrambles_of_points
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import SurfaceTexture

# Cumulative chances of the groups of lights, guides to these and ratios, a row for each patch, as
# in ``light_by_picks.PickArrays``.
Picks: TypeAlias = tuple[Double, Short, Float]

BLOCKS = 4


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
    groups: LightGroups
    environment: Environment
    draws: PatchDraws
    techniques: int

    def picks(self, points: Points) -> Picks:
        """How the points' patches pick lights."""
        if self.techniques == 1:
            return np.zeros((0, 0)), np.zeros((0, 0), np.int16), np.zeros((0, 0), np.float32)
        groups = self.groups
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
        """Trace samples first to last of each point and add them to sums (2, 4, P, 4), one for each
        technique, and escaped (P,)."""
        scrambles = scrambles_of_points(
            points.identity, points.stratum, self.draws.seed, self.draws.shared
        )
        draws = self.draws.sobol, scrambles, self.draws.seed, points.identity
        groups = self.groups.arrays, points.row, *picks
        radiance, scene = self.radiance.arrays, self.rays.address
        start, block = samples[0], _block_of(np.arange(*samples), *samples)
        add_light_by_direction(
            scene, radiance, self.environment.arrays, groups, points.origin, points.normal, draws,
            start, block, sums[0], escaped,
        )  # fmt: skip
        if self.techniques == 2:
            add_light_by_picks(
                scene, radiance, groups, points.origin, points.normal, draws, start, block, sums[1]
            )


def _block_of(sample: Long, first: int, last: int) -> Long:
    """The first round fills all four blocks; each later one the last two (the first two then hold
    what came before)."""
    if first == 0:
        return sample * BLOCKS // last
    return 2 + (sample - first) * 2 // (last - first)


@loop
def mean_and_error(sums: Double, samples: int) -> tuple[Double, Double]:
    """Mean of ``samples`` in all, and its standard error from the four blocks, (P, 3) each; sums
    (2, 4, P, 4), one for each technique, whose last column is not looked at."""
    count = sums.shape[2]
    mean, error = np.empty((count, 3)), np.empty((count, 3))
    block = np.empty(4)
    for k in range(count):
        for c in range(3):
            for b in range(4):
                block[b] = (sums[0, b, k, c] + sums[1, b, k, c]) * (4 / samples)
            centre = (block[0] + block[1] + block[2] + block[3]) / 4
            square = 0.0
            for b in range(4):
                square += (block[b] - centre) ** 2
            mean[k, c], error[k, c] = centre, math.sqrt(square / 12)
    return mean, error
