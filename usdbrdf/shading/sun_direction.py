"""Where the sun stands: in the direction whose shadows are found in the texture.

For a direction, texels that see the sun get its light by the cosine law and the others none. With
the right one, and the right strength, what is left of the contrasts on each segment is least."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import product

import numpy as np

from usdbrdf import calibration
from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Bool, Double, Long
from usdbrdf.shading.outside_light import Asked
from usdbrdf.transport.environment import SUN_HALF_ANGLE, Sun
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.rays import lift_from_surface
from usdbrdf.transport.sunlight import sunlit
from usdbrdf.transport.warps import axes_across

# Directions of the first search; how many of them are followed; how much finer each of the next
# searches is, of which there are so many; candidates for the sun's irradiance, in units of the
# median S.
_DIRECTIONS, _FOLLOWED, _FINER, _REFINED = 3000, 16, 2.5, 6
_STRENGTHS = np.geomspace(0.25, 128, 10)
_NEAR = 0.3  # radians in which the sun is looked for again
# Around a direction: steps in radians, of each so many moves at most; what its strength may be, in
# units of what was thought of it; half angles of its disc; and the deviation, in texels, by which
# pixels blur the edges of shadows.
_STEPS, _MOST_MOVES = np.radians([0.6, 0.3, 0.15, 0.07]), 6
_OTHERWISE = np.geomspace(0.4, 5.0, 16)
_HALF_ANGLES = SUN_HALF_ANGLE * 1.5 ** np.arange(6)
_BLUR = 0.7
# Standard errors by which one direction, or width, of many must explain more than what was thought.
_SURE = 4.0
_OUTLIER = calibration.number("outside.outlier")


def find_sun(
    surface: TexturedScene, asked: Asked, irradiance: Double, z_up: bool, near: Sun | None = None
) -> Sun:
    """The direction above the horizon whose shadows are in the texture, ``near`` one if that is
    given; irradiance (N, 3) without it."""
    texels, some = surface.texels, np.arange(0, len(asked.texel), 2)
    asked, irradiance = asked.of(some), irradiance[some]
    normal = texels.normal[asked.texel].astype(np.float64)
    origin = lift_from_surface(
        texels.position[asked.texel], texels.normal[asked.texel], surface.diagonal_m
    )
    level = np.median(irradiance.mean(axis=1))
    reflected, without = np.log(asked.reflected.max(axis=1)), irradiance.mean(axis=1)
    first = np.searchsorted(asked.segment, np.arange(asked.segment.max() + 2))
    strengths = level * _STRENGTHS

    def cost(directions: Double) -> Double:
        """(M,) of the best strength in each direction."""
        cosine = np.maximum(directions @ normal.T, 0)
        rays = np.repeat(directions.astype(np.float32), len(origin), axis=0)
        rays[cosine.ravel() == 0] = 0  # what looks away need not be traced
        free = surface.light_rays.closest(origin, rays).face < 0
        share = cosine * free.reshape(cosine.shape)
        return _costs(reflected, without, share, asked.clipped, first, strengths)

    def costs(directions: Double) -> Double:
        parts = np.array_split(directions, max(1, len(directions) // 32))
        with ThreadPoolExecutor(2) as pool:
            return np.concatenate(list(pool.map(cost, parts)))

    tried = _spread(2 * _DIRECTIONS)
    up = 2 if z_up else 1
    tried = tried[tried[:, up] > 0]
    if near:
        tried = tried[tried @ near.direction > np.cos(_NEAR)]
    # The way down is rough: a shadow's edge counts when it passes a texel.
    reach = 1.5 * float(np.sqrt(2 * np.pi / _DIRECTIONS))
    kept = tried[np.argsort(costs(tried), kind="stable")[:_FOLLOWED]]
    for _ in range(_REFINED):
        around = np.stack([_around(direction, reach) for direction in kept])
        cost_around = costs(around.reshape(-1, 3)).reshape(len(kept), -1)
        cost_around[around[..., up] <= 0] = np.inf
        best = cost_around.argmin(axis=1)
        order = np.argsort(cost_around.min(axis=1), kind="stable")
        kept = around[np.arange(len(kept)), best][order][: max(1, len(kept) // 2)]
        reach /= _FINER
    return Sun(kept[0], np.full(3, level))


def with_disc(surface: TexturedScene, asked: Asked, irradiance: Double, sun: Sun, seed: int) -> Sun:
    """The ``sun``, about where and as strong as it is thought to be, where the half-shadows show
    it: its direction, to a fraction of its disc, and the width of that. irradiance (N, 3) without
    it."""
    some = np.arange(0, len(asked.texel), 2)
    asked, irradiance = asked.of(some), irradiance[some]
    reflected, without = np.log(asked.reflected.max(axis=1)), irradiance.mean(axis=1)
    first = np.searchsorted(asked.segment, np.arange(asked.segment.max() + 2))
    strengths = float(sun.irradiance.mean()) * _OTHERWISE

    def costs(sun: Sun) -> Double:
        """(N,) of each texel, with the best strength."""
        share = _blurred_sunlight(surface, asked.texel, sun, seed)
        return _costs_of_texels(reflected, without, share, asked.clipped, first, strengths)

    def best_of(suns: list[Sun]) -> tuple[Double, Sun]:
        with ThreadPoolExecutor(2) as pool:
            found = list(pool.map(costs, suns))
        best = min(range(len(suns)), key=lambda k: float(found[k].mean()))
        return found[best], suns[best]

    at_first = now = costs(sun), sun
    for step in _STEPS:
        for _ in range(_MOST_MOVES):
            beside = _beside(now[1].direction, step)
            moved = best_of([sun._replace(direction=direction) for direction in beside])
            if moved[0].mean() >= now[0].mean():
                break
            now = moved
    now = now if _is_better(now[0], at_first[0]) else at_first
    wider = best_of([now[1]._replace(half_angle=float(angle)) for angle in _HALF_ANGLES])
    return wider[1] if _is_better(wider[0], now[0]) else now[1]


def _is_better(costs: Double, before: Double) -> bool:
    """Is the mean of ``costs`` (N,) less, by more than these scatter?"""
    gain = before - costs
    return bool(gain.mean() > _SURE * gain.std() / np.sqrt(len(gain)))


def _beside(direction: Double, step: float) -> Double:
    """(8, 3) unit directions around one."""
    right, up = axes_across(direction)
    beside = [direction + step * (x * right + y * up) for x, y in product((-1, 0, 1), repeat=2)]
    return np.stack([d / np.linalg.norm(d) for i, d in enumerate(beside) if i != 4])


def _blurred_sunlight(surface: TexturedScene, index: Long, sun: Sun, seed: int) -> Double:
    """(N,) ``sunlit`` of texels ``index`` as pixels show it."""
    total, weights = np.zeros(len(index)), np.zeros(len(index))
    for right, down in product((-1, 0, 1), repeat=2):
        beside, there = surface.texels.beside_on_surface(index, right, down)
        weight = there * np.exp(-0.5 * (right**2 + down**2) / _BLUR**2)
        total += weight * sunlit(surface, beside, sun, seed)
        weights += weight
    return np.asarray(total / np.maximum(weights, 1e-12))


def _spread(count: int) -> Double:
    """(count, 3) unit directions, evenly over the sphere: a Fibonacci lattice."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + np.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1)


def _around(direction: Double, reach: float) -> Double:
    """(M, 3) unit directions on a grid within ``reach`` radians of one."""
    steps = np.linspace(-reach, reach, 9)
    x, y = (grid.ravel()[:, None] for grid in np.meshgrid(steps, steps))
    right, up = axes_across(direction)
    near = direction + x * right + y * up
    return np.asarray(near / np.linalg.norm(near, axis=1, keepdims=True))


@loop
def _costs(
    reflected: Double, without: Double, share: Double, clipped: Bool, first: Long, strengths: Double
) -> Double:
    """(M,) for each row of ``share`` (M, N) the least cost of all strengths: mean distance of the
    logarithms from their segment's median, none counting more than as an outlier."""
    count, points = share.shape
    best = np.empty(count)
    rest = np.empty(points)
    # What a segment costs without the sun, of which its texels see nothing in many directions.
    dark, cost_in_dark = reflected - np.log(without), np.empty(points)
    for k in range(len(first) - 1):
        low, high = first[k], first[k + 1]
        _cost_of_each(dark[low:high], clipped[low:high], cost_in_dark[low:high])
    cost = np.empty(points)
    for m in range(count):
        best[m] = np.inf
        for strength in strengths:
            total = 0.0
            for k in range(len(first) - 1):
                low, high = first[k], first[k + 1]
                sees = False
                for i in range(low, high):
                    rest[i] = dark[i]
                    if share[m, i] > 0:
                        sees = True
                        rest[i] = reflected[i] - np.log(without[i] + strength * share[m, i])
                if sees:
                    _cost_of_each(rest[low:high], clipped[low:high], cost[low:high])
                for i in range(low, high):
                    total += cost[i] if sees else cost_in_dark[i]
                if total / points >= best[m]:  # it only grows
                    break
            best[m] = min(best[m], total / points)
    return best


@loop
def _costs_of_texels(
    reflected: Double, without: Double, share: Double, clipped: Bool, first: Long, strengths: Double
) -> Double:
    """(N,) as of ``_costs``, what each texel adds with the best strength."""
    best, least = np.empty(len(share)), np.inf
    rest, cost = np.empty(len(share)), np.empty(len(share))
    for strength in strengths:
        rest[:] = reflected - np.log(without + strength * share)
        for k in range(len(first) - 1):
            low, high = first[k], first[k + 1]
            _cost_of_each(rest[low:high], clipped[low:high], cost[low:high])
        if cost.mean() < least:
            least, best[:] = cost.mean(), cost
    return best


@loop
def _cost_of_each(rest: Double, clipped: Bool, cost: Double) -> None:
    """Fill in the cost (n,) of each texel of a segment."""
    middle = np.median(rest)
    for i in range(len(rest)):
        off = rest[i] - middle
        cost[i] = 0.0 if clipped[i] and off < 0 else min(abs(off), _OUTLIER)
