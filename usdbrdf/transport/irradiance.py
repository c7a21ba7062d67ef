"""Irradiance S(x) = integral of L cos over the hemisphere, W/m^2, by Monte-Carlo ray tracing.

L_d is the light: a ray that hits the surface brings the lit diffuse radiance found there (paper
eq. 10). Two estimators:

``cosine``  the paper's: independent cosine-distributed directions.
``mis``     as many cosine-distributed directions as points picked on the bright triangles, combined
            by the balance heuristic (E. Veach and L. Guibas, "Optimally combining sampling
            techniques for Monte Carlo rendering", 1995). Which triangles are picked is up to each
            tile of 8 x 8 texels (``lights``). Sobol points with random bits of the scene,
            of neighbours and of the texel or group (``tile_draws``): groups of neighbouring texels
            trace nearly parallel rays, which Embree does at six tenths of the cost.

Both are unbiased for the piecewise bilinear L_d that they are given, but for the stopping rule of
``mis``: points that happen to agree stop early. Tests bound this by 1e-3 of S.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from usdbrdf.kernel import loop, num_threads
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.model.texels import Texels
from usdbrdf.options import Sampling
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lights import LightGroups, Lights, TilePicks, weighed_groups
from usdbrdf.transport.rays import RayScene, lift_from_surface
from usdbrdf.transport.sampling_loops import (
    Met,
    PointDraws,
    Receivers,
    add_cosine_samples,
    add_light_samples,
)
from usdbrdf.transport.surface_texture import SurfaceTexture
from usdbrdf.transport.tile_draws import (
    STRATA_BY_PLACE,
    TEXELS,
    TileDraws,
    independent_draws,
    interleaved,
    places_in_tile,
    scrambles_of_points,
    tile_draws,
)
from usdbrdf.transport.tile_draws import independent_tiles as independent_tiles

# Samples of the first round, and blocks that sums are kept in.
_FIRST_ROUND, _BLOCKS = 64, 4
ALL_ALIKE = np.zeros((0, 0), np.float32)
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


def tiles_of_texels(texels: Texels) -> tuple[Long, Int]:
    """Texels in the order of 8 x 8 blocks of their atlas, near blocks near: order (T,), and the
    tile of each texel in that order, (T,) int32 ascending from 0. Within a tile those that share
    directions follow each other."""
    owner = texels.object_index()
    local = texels.pixel - texels.first_pixel[owner]
    width = texels.resolution[owner, 0]
    x, y = local % width, local // width
    block = interleaved(x // 8, y // 8)
    order = np.lexsort((places_in_tile(x % 8, y % 8), block, owner))
    key = np.stack([owner, block], axis=-1)[order]
    tile = np.concatenate([[0], np.cumsum((np.diff(key, axis=0) != 0).any(axis=1))])
    return order, tile.astype(np.int32)


def whole_tiles(tile: Int, points: int) -> list[slice]:
    """Ranges of about so many ``points`` that cut no tile."""
    starts = np.flatnonzero(np.diff(tile, prepend=-1))
    wanted = np.searchsorted(starts, np.arange(0, int(starts[-1]) + 1, points))
    firsts = [int(first) for first in np.unique(starts[wanted])]
    return [slice(first, last) for first, last in pairwise([*firsts, len(tile)])]


class _Points(NamedTuple):
    """Points of whole tiles: origins of their rays and normals (P, 3), tiles, random numbers'
    identities and strata, least S to hold errors against, the row of their tile in what is kept
    for each, and of their surface in how light counts by its angle, (P,)."""

    origin: Float
    normal: Float
    tile: Int
    identity: Long
    stratum: Int
    floor: Double
    row: Int
    surface: Int

    def of(self, which: Any) -> _Points:
        return _Points._make(values[which] for values in self)


class _Light(NamedTuple):
    """All that brings light, the one or two ``techniques`` that look for it, and by ``angle`` how
    it counts on each surface."""

    met: Met
    groups: LightGroups
    draws: TileDraws
    techniques: int
    angle: Float


class ByAngle(NamedTuple):
    """How light counts: factors (K, C) of K surfaces at even cosines from 0 to 1, linear between;
    surface (N,) of each point."""

    factor: Float
    surface: Int


def irradiance_at(
    rays: RayScene,
    radiance: SurfaceTexture,
    lights: Lights,
    environment: Environment,
    position: Float,
    normal: Float,
    tile: Int,
    sampling: Sampling,
    diagonal_m: float,
    dark: Float | None = None,
    by_angle: ByAngle | None = None,
) -> Irradiance:
    """S at N surface points.

    position, normal (N, 3) float32, world; tile (N,) int32 ascending, at most 64 points each:
    points of one tile share what lights they pick, part of their random bits, and their stopping;
    tiles that follow each other share random bits as well, ``independent_tiles`` do not.
    diagonal_m: the scene's, for the lift off the surface. dark: (N,) W/m^2; where S is below it,
    the standard error is held against it instead of S. by_angle: light counts by its angle from
    the normal; None: all alike.
    """
    # A point's number within its tile of at most 64: so no two points of the scene share their
    # random numbers, and a point draws the same ones whatever comes with it.
    first = np.flatnonzero(np.diff(tile, prepend=-1))
    size = np.diff(first, append=len(tile))
    number = np.arange(len(tile)) - np.repeat(first, size)
    identity = TEXELS * tile.astype(np.int64) + number
    stratum = STRATA_BY_PLACE[TEXELS * number // np.repeat(size, size)]
    floor = np.zeros(len(tile)) if dark is None else dark.astype(np.float64)
    angle, surface = by_angle or ByAngle(ALL_ALIKE, np.zeros(len(tile), np.int32))
    techniques = 1 if sampling.estimator == "cosine" or not len(lights.face) else 2
    rounds = _rounds(sampling, techniques)
    if sampling.estimator == "cosine":
        draws = independent_draws(sampling.seed)
    else:
        draws = tile_draws(sampling.seed, rounds[0][1], rounds[-1][1])
    # The groups are made here, once, not by each thread.
    light = _Light(
        Met(rays.address, radiance, environment), lights.groups, draws, techniques, angle
    )

    def traced(part: slice) -> Irradiance:
        origin = lift_from_surface(position[part], normal[part], diagonal_m)
        # Which of the tiles here, counted from 0.
        row = np.cumsum(np.diff(tile[part], prepend=tile[part][0]) != 0, dtype=np.int32)
        points = _Points(
            origin, normal[part], tile[part], identity[part], stratum[part], floor[part], row,
            surface[part],
        )  # fmt: skip
        return _irradiance_of(points, light, rounds, sampling.standard_error)

    threads = num_threads()
    count = min(_POINTS, max(1, len(tile) // (4 * threads)))
    with ThreadPoolExecutor(max_workers=threads) as pool:
        found = list(pool.map(traced, whole_tiles(tile, count)))
    names = vars(found[0])
    return Irradiance(**{n: np.concatenate([vars(part)[n] for part in found]) for n in names})


def _irradiance_of(
    points: _Points, light: _Light, rounds: list[tuple[int, int]], standard_error: float
) -> Irradiance:
    """Rounds of samples, each as many as all before, until every tile has enough."""
    count = len(points.origin)
    mean, error = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    share, done = np.zeros(count, np.float32), np.zeros(count, np.int32)
    sums, escaped = np.zeros((2, _BLOCKS, count, 4)), np.zeros(count)
    active: Any = slice(None)
    if light.techniques == 2:
        first_point = np.searchsorted(points.row, np.arange(points.row[-1] + 2))
        picks = weighed_groups(light.groups, points.origin, points.normal, first_point)
    else:
        nothing = np.zeros((0, 0), np.float32)
        picks = TilePicks(nothing.astype(np.float64), nothing.astype(np.int16), nothing)
    for first, last in rounds:
        # The first round fills all four blocks; each later one the last two, and the first two
        # hold what came before.
        sample = np.arange(first, last)
        if first:
            sums[:, 0] += sums[:, 1]
            sums[:, 1] = sums[:, 2] + sums[:, 3]
            sums[:, 2:] = 0
            block = 2 + (sample - first) * 2 // (last - first)
        else:
            block = sample * _BLOCKS // last
        receivers = _receivers(points, light, picks)
        add_cosine_samples(light.met, receivers, first, block, sums[0], escaped)
        if light.techniques == 2:
            add_light_samples(light.met, receivers, first, block, sums[1])
        found, scatter = mean_and_error(sums, last)
        mean[active], error[active], share[active] = found, scatter, escaped / last
        done[active] = light.techniques * last
        if last == rounds[-1][1]:
            break
        noisy = np.flatnonzero(_noisy(points.tile, found, scatter, standard_error, points.floor))
        if not len(noisy):
            break
        if len(noisy) < len(escaped):
            active = np.arange(count)[active][noisy]
            points, escaped = points.of(noisy), escaped[noisy]
            # In one piece, as the compiled loops know them.
            sums = np.take(sums, noisy, axis=2)
    return Irradiance(mean=mean, standard_error=error, rays=done, escaped=share)


def _receivers(points: _Points, light: _Light, picks: TilePicks) -> Receivers:
    sobol, seed, shared = light.draws.sobol, light.draws.seed, light.draws.shared
    scrambles = scrambles_of_points(points.identity, points.stratum, seed, shared)
    draws = PointDraws(sobol, scrambles, seed, points.identity)
    return Receivers(
        points.origin, points.normal, draws, light.groups, points.row, picks, light.angle,
        points.surface,
    )  # fmt: skip


def _rounds(sampling: Sampling, techniques: int) -> list[tuple[int, int]]:
    """First and last sample of each round."""
    if sampling.estimator == "cosine":
        return [(0, sampling.max_rays)]
    ends = [0, max(1, min(_FIRST_ROUND, sampling.max_rays) // techniques)]
    while 2 * ends[-1] * techniques <= sampling.max_rays:
        ends.append(2 * ends[-1])
    return list(pairwise(ends))


def _noisy(tile: Int, mean: Double, error: Double, target: float, dark: Double) -> Any:
    """(P,) bool: does the point's tile still miss the target relative standard error? mean, error
    (P, 3)."""
    index = tile - tile[0]
    points = np.maximum(np.bincount(index), 1)
    level = np.bincount(index, mean.sum(axis=1) / 3) / points
    square = np.bincount(index, (error**2).sum(axis=1) / 3) / points
    floor = np.maximum(np.bincount(index, dark) / points, 1e-30)
    return (np.sqrt(square) > target * np.maximum(level, floor))[index]


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
