"""Irradiance S(x) = integral of L cos over the hemisphere, W/m^2, by Monte-Carlo ray tracing.

L_d is the light: a ray that hits the surface brings the lit diffuse radiance found there (paper
eq. 10). Two estimators:

``cosine``  the paper's: independent cosine-distributed directions.
``mis``     as many cosine-distributed directions as points picked on the bright triangles, combined
            by the balance heuristic (E. Veach and L. Guibas, "Optimally combining sampling
            techniques for Monte Carlo rendering", 1995). Sobol points, shifted once per patch of
            8 x 8 texels: neighbouring texels trace nearly parallel rays, which Embree likes.

Both are unbiased for the piecewise bilinear L_d that they are given, but for the stopping rule of
``mis``: points that happen to agree stop early. Tests bound this by 1e-3 of S.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.rays import RayScene, lift_from_surface
from usdbrdf.geometry.surface_radiance import SurfaceTexture
from usdbrdf.geometry.texels import Texels
from usdbrdf.shading.environment import Environment
from usdbrdf.shading.irradiance_kernels import (
    Draws,
    add_cosine_rays,
    add_light_rays,
    cosine_rays,
    light_rays,
)
from usdbrdf.shading.lights import Lights
from usdbrdf.shading.warps import patch_shifts, sobol_points

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]

_BLOCKS = 4
_FIRST_ROUND = 64
# Rays per call of Embree: long enough to feed all threads, short enough to stay in memory.
_BATCH = 1 << 19


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How S is estimated.

    estimator       "mis" or "cosine"
    standard_error  "mis" doubles a patch's rays until its relative standard error is below this
    max_rays        per texel; "cosine" traces exactly this many
    seed            of the random shifts
    """

    estimator: Literal["mis", "cosine"] = "mis"
    standard_error: float = 0.03
    max_rays: int = 2048
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Irradiance:
    """S and what is known about it, per texel.

    mean (T, 3) float32, W/m^2; standard_error (T, 3) float32, absolute, from four sub-sequences
    (an upper estimate for Sobol points); rays (T,) int32; escaped (T,) float32, the share of the
    cosine-weighted hemisphere that sees no surface
    """

    mean: Float
    standard_error: Float
    rays: Int
    escaped: Float


def patches_of_texels(texels: Texels) -> tuple[Long, Int]:
    """Texels in the order of 8 x 8 blocks of their atlas: order (T,), and the patch of each
    texel in that order, (T,) int32 ascending from 0."""
    owner = texels.object_index()
    local = texels.pixel - texels.first_pixel[owner]
    width = texels.resolution[owner, 0]
    x, y = local % width, local // width
    order = np.lexsort((x % 8, y % 8, x // 8, y // 8, owner))
    key = np.stack([owner, y // 8, x // 8], axis=-1)[order]
    patch = np.concatenate([[0], np.cumsum((np.diff(key, axis=0) != 0).any(axis=1))])
    return order, patch.astype(np.int32)


def irradiance_at(
    rays: RayScene,
    radiance: SurfaceTexture,
    lights: Lights,
    environment: Environment,
    position: Float,
    normal: Float,
    patch: Int,
    sampling: Sampling,
    scene_size: float,
    dark: Float | None = None,
) -> Irradiance:
    """S at N surface points.

    position, normal (N, 3) float32, world; patch (N,) int32 ascending: points of one patch share
    their random shift and their stopping. scene_size: metres, for the lift off the surface.
    dark: (N,) W/m^2; where S is below it, the standard error is held against it instead of S.
    """
    count = len(position)
    origin = lift_from_surface(position, normal, scene_size)
    sums = np.zeros((count, _BLOCKS, 3))
    escaped = np.zeros(count)
    done = np.zeros(count, np.int64)
    active = np.arange(count)
    floor = np.zeros(count) if dark is None else dark.astype(np.float64)
    # A point's number within its patch of at most 64: so no two points of the scene share their
    # random numbers, and a point draws the same ones whatever tile it comes in.
    identity = 64 * patch.astype(np.int64) + active - np.searchsorted(patch, patch)
    pairs = 1 if sampling.estimator == "cosine" or not len(lights.face) else 2
    techniques = _Techniques(rays, radiance, lights, environment, sampling, pairs)
    if sampling.estimator == "cosine":
        rounds = [(0, sampling.max_rays)]
    else:
        ends = [0, max(1, min(_FIRST_ROUND, sampling.max_rays) // pairs)]
        while 2 * ends[-1] * pairs <= sampling.max_rays:
            ends.append(2 * ends[-1])
        rounds = list(pairwise(ends))
    for first, last in rounds:
        if first:
            sums[active, 0] = sums[active, 0] + sums[active, 1]
            sums[active, 1] = sums[active, 2] + sums[active, 3]
            sums[active, 2:] = 0
        block_sums = sums[active]
        block_escaped = escaped[active]
        techniques.run(
            origin[active], normal[active], patch[active], identity[active], first, last,
            block_sums, block_escaped,
        )  # fmt: skip
        sums[active], escaped[active], done[active] = block_sums, block_escaped, last
        error = _standard_error(sums[active], last)
        error_target = sampling.standard_error
        active = active[
            _noisy(patch[active], sums[active], error, last, error_target, floor[active])
        ]
        if not len(active):
            break
    mean = sums.sum(axis=1) / done[:, None]
    return Irradiance(
        mean=mean.astype(np.float32),
        standard_error=_standard_error(sums, done[:, None]).astype(np.float32),
        rays=(done * pairs).astype(np.int32),
        escaped=(escaped / done).astype(np.float32),
    )


def _standard_error(sums: Double, samples: Any) -> Double:
    """Standard error (N, 3) of the mean of four blocks' sums (N, 4, 3) of ``samples`` in all."""
    means = sums * (_BLOCKS / np.asarray(samples, np.float64)[..., None])
    return np.asarray(means.std(axis=1, ddof=1) / np.sqrt(_BLOCKS))


def _noisy(
    patch: Int, sums: Double, error: Double, samples: int, target: float, dark: Double
) -> Any:
    """(N,) bool: does the point's patch still miss the target relative standard error?"""
    index = patch - patch[0]
    points = np.maximum(np.bincount(index), 1)
    mean = np.bincount(index, sums.sum(axis=(1, 2)) / (3 * samples)) / points
    square = np.bincount(index, (error**2).mean(axis=1)) / points
    floor = np.maximum(np.bincount(index, dark) / points, 1e-12)
    return (np.sqrt(square) > target * np.maximum(mean, floor))[index]


class _Techniques:
    """The two ray generators and their sums, with what they share for all points."""

    def __init__(
        self,
        rays: RayScene,
        radiance: SurfaceTexture,
        lights: Lights,
        environment: Environment,
        sampling: Sampling,
        pairs: int,
    ) -> None:
        self.rays = rays
        self.radiance = radiance
        self.lights = lights
        self.environment = environment
        self.sampling = sampling
        self.use_lights = pairs == 2
        random = sampling.estimator == "cosine"
        log2_count = 0 if random else int(np.ceil(np.log2(max(sampling.max_rays, 2))))
        self.points = np.zeros((0, 5)) if random else sobol_points(log2_count, 5)

    def run(
        self,
        origin: Float,
        normal: Float,
        patch: Int,
        identity: Long,
        first: int,
        last: int,
        sums: Double,
        escaped: Double,
    ) -> None:
        """Trace samples first..last of each point and add them to sums (N, 4, 3), escaped (N,)."""
        step = max(1, _BATCH // len(origin))
        draws = self._draws(patch, identity)
        for start in range(first, last, step):
            stop = min(start + step, last)
            block = _block_of(np.arange(start, stop), first, last)
            many = np.tile(origin, (stop - start, 1))
            directions = cosine_rays(normal, draws, start, stop)
            hits = self.rays.closest(many, directions)
            add_cosine_rays(
                self.radiance.arrays,
                self.environment.arrays,
                self.lights.arrays,
                self.use_lights,
                normal,
                directions,
                (hits.face, hits.u, hits.v, hits.distance),
                block,
                sums,
                escaped,
            )
            if self.use_lights:
                directions, distances, brought = light_rays(
                    self.radiance.arrays, self.lights.arrays, origin, normal, draws, start, stop
                )
                blocked = self.rays.occluded(many, directions, distances)
                add_light_rays(brought, blocked, block, sums)

    def _draws(self, patch: Int, identity: Long) -> Draws:
        """The random numbers of the points, which depend on their patches' numbers only: a tile
        draws what the whole would."""
        low, high = int(patch.min()), int(patch.max())
        seed = self.sampling.seed
        shifts = patch_shifts(high - low + 1, 5, seed, low)
        return self.points, shifts, patch - low, seed, identity


def _block_of(sample: Long, first: int, last: int) -> Long:
    """The first round fills all four blocks; each later one the last two (the first two then hold
    what came before)."""
    if first == 0:
        return sample * _BLOCKS // last
    return 2 + (sample - first) * 2 // (last - first)
