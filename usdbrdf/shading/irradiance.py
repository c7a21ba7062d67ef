"""Irradiance S(x) = integral of L cos over the hemisphere, W/m^2, by Monte-Carlo ray tracing.

L_d is the light: a ray that hits the surface brings the lit diffuse radiance found there (paper
eq. 10). Two estimators:

``cosine``  the paper's: independent cosine-distributed directions.
``mis``     as many cosine-distributed directions as points picked on the bright triangles, combined
            by the balance heuristic (E. Veach and L. Guibas, "Optimally combining sampling
            techniques for Monte Carlo rendering", 1995). Which triangles are picked is up to each
            patch of 8 x 8 texels (``light_groups``). Sobol points with random bits of the patch and
            the texel: neighbouring texels trace nearly parallel rays, which Embree likes.

Both are unbiased for the piecewise bilinear L_d that they are given, but for the stopping rule of
``mis``: points that happen to agree stop early. Tests bound this by 1e-3 of S.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.rays import RayScene, lift_from_surface
from usdbrdf.geometry.surface_radiance import SurfaceTexture
from usdbrdf.geometry.texels import Texels
from usdbrdf.shading.environment import Environment
from usdbrdf.shading.irradiance_batches import (
    PickArrays,
    add_cosine_batch,
    add_light_batch,
    cosine_batch,
    frames_of,
    light_batch,
    mean_and_error,
    scrambles_of_points,
)
from usdbrdf.shading.light_groups import weighed_groups
from usdbrdf.shading.lights import Lights
from usdbrdf.shading.warps import sobol_bits

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]
Bits = npt.NDArray[np.uint32]

_BLOCKS = 4
_FIRST_ROUND = 64
# Points that a thread takes at a time, and rays that it makes, traces and adds up at a time: enough
# to make the calls cheap, few enough to stay in the cache of its core.
_POINTS, _BATCH = 1 << 10, 1 << 14


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How S is estimated.

    estimator       "mis" or "cosine"
    standard_error  "mis" doubles a patch's rays until its relative standard error is below this
    max_rays        per texel; "cosine" traces exactly this many
    seed            of the random bits
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
    what lights they pick, part of their random bits, and their stopping. scene_size: metres, for
    the lift off the surface. dark: (N,) W/m^2; where S is below it, the standard error is held
    against it instead of S.
    """
    # A point's number within its patch of at most 64: so no two points of the scene share their
    # random numbers, and a point draws the same ones whatever tile it comes in.
    identity = 64 * patch.astype(np.int64) + np.arange(len(patch)) - np.searchsorted(patch, patch)
    floor = np.zeros(len(patch)) if dark is None else dark.astype(np.float64)
    light = _Light(rays, radiance, lights, environment, sampling)

    def traced(part: slice) -> Irradiance:
        origin = lift_from_surface(position[part], normal[part], scene_size)
        points = _Points(origin, normal[part], patch[part], identity[part], floor[part])
        return _irradiance_of(points, light, sampling)

    with ThreadPoolExecutor(max_workers=os.cpu_count() or 1) as pool:
        found = list(pool.map(traced, _whole_patches(patch)))
    names = [field.name for field in fields(Irradiance)]
    return Irradiance(**{n: np.concatenate([getattr(part, n) for part in found]) for n in names})


def _whole_patches(patch: Int) -> list[slice]:
    """Ranges of about _POINTS points that cut no patch."""
    starts = np.flatnonzero(np.diff(patch, prepend=-1))
    wanted = np.searchsorted(starts, np.arange(0, int(starts[-1]) + 1, _POINTS))
    firsts = [int(first) for first in np.unique(starts[wanted])]
    return [slice(first, last) for first, last in pairwise([*firsts, len(patch)])]


class _Points(NamedTuple):
    """Points of whole patches: origins of their rays and normals (P, 3), patches, random numbers'
    identities and least S to hold errors against, (P,)."""

    origin: Float
    normal: Float
    patch: Int
    identity: Long
    floor: Double

    def of(self, which: Any) -> _Points:
        return _Points(*(values[which] for values in self))


def _irradiance_of(points: _Points, light: _Light, sampling: Sampling) -> Irradiance:
    """Rounds of samples, each as many as all before, until every patch has enough."""
    count = len(points.origin)
    mean, error = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    share, done = np.zeros(count, np.float32), np.zeros(count, np.int32)
    sums, escaped = np.zeros((2, _BLOCKS, count, 3)), np.zeros(count)
    active: Any = slice(None)
    rounds = _rounds(sampling, light.techniques)
    for first, last in rounds:
        if first:
            sums[:, 0] += sums[:, 1]
            sums[:, 1] = sums[:, 2] + sums[:, 3]
            sums[:, 2:] = 0
        light.add(points, first, last, sums, escaped)
        found, scatter = mean_and_error(sums, last)
        mean[active], error[active], share[active] = found, scatter, escaped / last
        done[active] = light.techniques * last
        if last == rounds[-1][1]:
            break
        noisy = np.flatnonzero(
            _noisy(points.patch, found, scatter, sampling.standard_error, points.floor)
        )
        if not len(noisy):
            break
        if len(noisy) < len(escaped):
            active = np.arange(count)[active][noisy]
            points, sums, escaped = points.of(noisy), sums[:, :, noisy], escaped[noisy]
    return Irradiance(mean=mean, standard_error=error, rays=done, escaped=share)


def _rounds(sampling: Sampling, techniques: int) -> list[tuple[int, int]]:
    """First and last sample of each round."""
    if sampling.estimator == "cosine":
        return [(0, sampling.max_rays)]
    ends = [0, max(1, min(_FIRST_ROUND, sampling.max_rays) // techniques)]
    while 2 * ends[-1] * techniques <= sampling.max_rays:
        ends.append(2 * ends[-1])
    return list(pairwise(ends))


def _noisy(patch: Int, mean: Double, error: Double, target: float, dark: Double) -> Any:
    """(P,) bool: does the point's patch still miss the target relative standard error? mean, error
    (P, 3)."""
    index = patch - patch[0]
    points = np.maximum(np.bincount(index), 1)
    level = np.bincount(index, mean.sum(axis=1) / 3) / points
    square = np.bincount(index, (error**2).sum(axis=1) / 3) / points
    floor = np.maximum(np.bincount(index, dark) / points, 1e-12)
    return (np.sqrt(square) > target * np.maximum(level, floor))[index]


class _Light:
    """All that brings light, and the two techniques that look for it."""

    def __init__(
        self,
        rays: RayScene,
        radiance: SurfaceTexture,
        lights: Lights,
        environment: Environment,
        sampling: Sampling,
    ) -> None:
        independent = sampling.estimator == "cosine"
        self.rays = rays
        self.radiance = radiance.packed
        self.environment = environment.arrays
        self.lights = lights.arrays
        self.seed = sampling.seed
        self.techniques = 1 if independent or not len(lights.face) else 2
        self.groups = lights.groups
        log2_count = int(np.ceil(np.log2(max(sampling.max_rays, 2))))
        self.sobol = sobol_bits(0 if independent else log2_count)[independent:]
        first_round = _rounds(sampling, self.techniques)[0][1]
        self.own_bits = _own_bits(first_round)

    def add(self, points: _Points, first: int, last: int, sums: Double, escaped: Double) -> None:
        """Trace samples first..last of each point and add them to sums (2, 4, P, 3), one for each
        technique, and escaped (P,)."""
        frames = frames_of(points.normal)
        scrambles = scrambles_of_points(points.patch, points.identity, self.seed, self.own_bits)
        draws = self.sobol, scrambles, self.seed, points.identity
        picks = self._picks(points)
        step = max(1, _BATCH // len(points.origin))
        for start in range(first, last, step):
            stop = min(start + step, last)
            block = _block_of(np.arange(start, stop), first, last)
            origins, directions = cosine_batch(points.origin, frames, draws, start, stop)
            hits = self.rays.closest(origins, directions)
            add_cosine_batch(
                self.radiance, self.environment, self.lights, picks, points.normal,
                directions, (hits.face, hits.u, hits.v, hits.distance), block, sums[0], escaped,
            )  # fmt: skip
            if self.techniques == 2:
                *segments, lit = light_batch(
                    picks, points.origin, points.normal, draws, start, stop
                )
                blocked = self.rays.occluded(*segments)
                add_light_batch(self.radiance, lit, blocked, block, sums[1])

    def _picks(self, points: _Points) -> PickArrays:
        starts = np.flatnonzero(np.diff(points.patch, prepend=-1))
        number = np.repeat(
            np.arange(len(starts), dtype=np.int32), np.diff(starts, append=len(points.patch))
        )
        if self.techniques == 1:
            none = np.zeros((0, 0))
            return self.groups.arrays, number, none, none.astype(np.int32), none.astype(np.float32)
        first_point = np.append(starts, len(points.patch))
        weighed = weighed_groups(
            self.groups.start, self.groups.bounds, points.origin, points.normal, first_point
        )
        return self.groups.arrays, number, *weighed


def _own_bits(samples: int) -> Bits:
    """Which bits of its scrambles a point has for itself, (2,).

    In every run of 2^m Sobol points each cell of a grid of 2^m cells holds one. Where in the cells
    is a point's own; which cell comes when is its patch's, so that the patch's rays of one sample
    stay nearly parallel and yet its points' errors are independent.
    """
    shared = (samples & -samples).bit_length() - 1
    high = (shared + 1) // 2
    return np.array([(1 << 32 - high) - 1, (1 << 32 - (shared - high)) - 1], np.uint32)


def _block_of(sample: Long, first: int, last: int) -> Long:
    """The first round fills all four blocks; each later one the last two (the first two then hold
    what came before)."""
    if first == 0:
        return sample * _BLOCKS // last
    return 2 + (sample - first) * 2 // (last - first)
