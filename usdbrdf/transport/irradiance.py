"""Irradiance S(x) = integral of L cos over the hemisphere, W/m^2, by Monte-Carlo ray tracing.

L_d is the light: a ray that hits the surface brings the lit diffuse radiance found there (paper
eq. 10). Two estimators:

``cosine``  the paper's: independent cosine-distributed directions.
``mis``     as many cosine-distributed directions as points picked on the bright triangles, combined
            by the balance heuristic (E. Veach and L. Guibas, "Optimally combining sampling
            techniques for Monte Carlo rendering", 1995). Which triangles are picked is up to each
            patch of 8 x 8 texels (``light_groups``). Sobol points with random bits of the scene,
            of neighbours and of the texel or group (``patch_draws``): groups of neighbouring texels
            trace nearly parallel rays, which Embree does at six tenths of the cost.

Both are unbiased for the piecewise bilinear L_d that they are given, but for the stopping rule of
``mis``: points that happen to agree stop early. Tests bound this by 1e-3 of S.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np

from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.model.texels import Texels
from usdbrdf.options import Sampling
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.incoming_light import (
    BLOCKS,
    IncomingLight,
    Points,
    mean_and_error,
    whole_patches,
)
from usdbrdf.transport.lights import Lights
from usdbrdf.transport.patch_draws import (
    STRATA_BY_PLACE,
    TEXELS,
    independent_draws,
    interleaved,
    patch_draws,
    places_in_patch,
)
from usdbrdf.transport.rays import RayScene, lift_from_surface
from usdbrdf.transport.surface_texture import SurfaceTexture

_FIRST_ROUND = 64

# Points that a thread takes at a time: near points' nearly parallel rays follow each other.
_POINTS = 1 << 12


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
    """Texels in the order of 8 x 8 blocks of their atlas, near blocks near: order (T,), and the
    patch of each texel in that order, (T,) int32 ascending from 0. Within a patch those that share
    directions follow each other."""
    owner = texels.object_index()
    local = texels.pixel - texels.first_pixel[owner]
    width = texels.resolution[owner, 0]
    x, y = local % width, local // width
    block = interleaved(x // 8, y // 8)
    order = np.lexsort((places_in_patch(x % 8, y % 8), block, owner))
    key = np.stack([owner, block], axis=-1)[order]
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

    position, normal (N, 3) float32, world; patch (N,) int32 ascending, at most 64 points each:
    points of one patch share what lights they pick, part of their random bits, and their stopping;
    patches that follow each other share random bits as well, ``independent_patches`` do not.
    scene_size: metres, for the lift off the surface. dark: (N,) W/m^2; where S is below it, the
    standard error is held against it instead of S.
    """
    # A point's number within its patch of at most 64: so no two points of the scene share their
    # random numbers, and a point draws the same ones whatever tile it comes in.
    first = np.flatnonzero(np.diff(patch, prepend=-1))
    size = np.diff(first, append=len(patch))
    number = np.arange(len(patch)) - np.repeat(first, size)
    identity = TEXELS * patch.astype(np.int64) + number
    stratum = STRATA_BY_PLACE[TEXELS * number // np.repeat(size, size)]
    floor = np.zeros(len(patch)) if dark is None else dark.astype(np.float64)
    techniques = 1 if sampling.estimator == "cosine" or not len(lights.face) else 2
    rounds = _rounds(sampling, techniques)
    light = IncomingLight(
        rays=rays,
        radiance=radiance,
        groups=lights.groups,  # made here, once, not by each thread
        environment=environment,
        draws=independent_draws(sampling.seed)
        if sampling.estimator == "cosine"
        else patch_draws(sampling.seed, rounds[0][1], rounds[-1][1]),
        techniques=techniques,
    )

    def traced(part: slice) -> Irradiance:
        origin = lift_from_surface(position[part], normal[part], scene_size)
        points = Points(
            origin, normal[part], patch[part], identity[part], stratum[part], floor[part],
            _numbers(patch[part]),
        )  # fmt: skip
        return _irradiance_of(points, light, rounds, sampling.standard_error)

    threads = os.cpu_count() or 1
    count = min(_POINTS, max(1, len(patch) // (4 * threads)))
    with ThreadPoolExecutor(max_workers=threads) as pool:
        found = list(pool.map(traced, whole_patches(patch, count)))
    names = [field.name for field in fields(Irradiance)]
    return Irradiance(**{n: np.concatenate([getattr(part, n) for part in found]) for n in names})


def _irradiance_of(
    points: Points, light: IncomingLight, rounds: list[tuple[int, int]], standard_error: float
) -> Irradiance:
    """Rounds of samples, each as many as all before, until every patch has enough."""
    count = len(points.origin)
    mean, error = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    share, done = np.zeros(count, np.float32), np.zeros(count, np.int32)
    sums, escaped = np.zeros((2, BLOCKS, count, 4)), np.zeros(count)
    active: Any = slice(None)
    picks = light.picks(points)
    for first, last in rounds:
        if first:
            sums[:, 0] += sums[:, 1]
            sums[:, 1] = sums[:, 2] + sums[:, 3]
            sums[:, 2:] = 0
        light.add(points, picks, (first, last), sums, escaped)
        found, scatter = mean_and_error(sums, last)
        mean[active], error[active], share[active] = found, scatter, escaped / last
        done[active] = light.techniques * last
        if last == rounds[-1][1]:
            break
        noisy = np.flatnonzero(_noisy(points.patch, found, scatter, standard_error, points.floor))
        if not len(noisy):
            break
        if len(noisy) < len(escaped):
            active = np.arange(count)[active][noisy]
            points, escaped = points.of(noisy), escaped[noisy]
            # In one piece, as the compiled loops know them.
            sums = np.take(sums, noisy, axis=2)
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


def _numbers(patch: Int) -> Int:
    """Which of the patches here, counted from 0, (P,)."""
    return np.cumsum(np.diff(patch, prepend=patch[0]) != 0, dtype=np.int32)
