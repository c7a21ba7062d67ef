"""Rays to points picked on bright triangles: made, traced and added up in one compiled loop, as
``light_by_direction`` does."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Bits, Double, Float, Int, Long, Short
from usdbrdf.transport.embree import occlusion
from usdbrdf.transport.light_groups import GroupArrays, picked
from usdbrdf.transport.patch_draws import groups_of
from usdbrdf.transport.surface_texture import (
    AHEAD,
    PackedArrays,
    add_looked_at,
    empty_looks,
    look_at,
    unsigned,
)
from usdbrdf.transport.warps import fractions, in_triangle

# Where P points take their random numbers from: Sobol points (S, 4), two dimensions for each
# technique, or none of them for independent numbers; scrambles (4, P); seed; identities (P,).
PointDraws: TypeAlias = tuple[Bits, Bits, int, Long]

# How P points pick lights: the groups; the row of each point's patch (P,) in what follows; the
# patches' cumulative chances of groups (Q, G), guides to these, and how much more likely than by
# power the groups are, (Q, G); Q = 0 where there are no lights.
PickArrays: TypeAlias = tuple[GroupArrays, Int, Double, Short, Float]

# Of rays to points on lights: the receiving point, the triangle and place that the ray is sent to,
# the weight of what is found there, (N,) each; direction (N, 3), as long as the way there.
Segments: TypeAlias = tuple[Int, Int, Float, Float, Float, Float]

Turns: TypeAlias = list[tuple[int, int, int]]

# So many times AHEAD points' sums, and tables of lights, stay in the cache of a core together.
_TOGETHER = 2

# In the loops' own precision: with Python's constants the compiler would go over to doubles.
_INVERSE_PI = np.float32(1 / math.pi)

_TINY, _NEARLY = np.float32(1e-18), np.float32(0.9999)


@loop
def add_light_by_picks(
    scene: int,
    radiance: PackedArrays,
    picks: PickArrays,
    origin: Float,
    normal: Float,
    draws: PointDraws,
    start: int,
    block: Long,
    sums: Double,
) -> None:
    """sums += what rays to the lights bring to P points (origin, normal (P, 3)), where nothing is
    in between: samples ``start`` and on, each into its ``block``."""
    segments, room, looks = empty_segments(), empty_room(), empty_looks()
    blocked, seen = np.empty(AHEAD, np.bool_), np.empty(AHEAD, np.int32)
    point, face, u, v, weight, directions = segments
    for first, last, s in turns(groups_of(draws[3]), len(block)):
        total = sums[block[s]]
        part = light_segments(picks, origin, normal, draws, start + s, first, last, room, segments)
        occlusion(scene, origin, point[:part], directions, _NEARLY, blocked)
        count = 0
        for i in range(part):
            seen[count] = i
            count += 1 - blocked[i]
        for j in range(count):
            i = unsigned(seen[j])
            look_at(radiance, looks, j, face[i], u[i], v[i])
        for j in range(count):
            i = unsigned(seen[j])
            add_looked_at(radiance, looks, j, weight[i], total, unsigned(point[i]))


@loop
def turns(group: Long, samples: int) -> Turns:
    """First and last + 1 of up to AHEAD points and their sample, in turn: all samples of a few
    points, then of the next. Of points in the same ``group`` (P,), less than AHEAD, all or none:
    whatever points come before them, they find the same."""
    ends = [0]
    while ends[-1] < len(group):
        end = min(ends[-1] + AHEAD, len(group))
        while end < len(group) and group[end] == group[end - 1]:
            end -= 1
        ends.append(end)
    return [
        (ends[k], ends[k + 1], sample)
        for part in range(0, len(ends) - 1, _TOGETHER)
        for sample in range(samples)
        for k in range(part, min(part + _TOGETHER, len(ends) - 1))
    ]


@loop
def empty_segments() -> Segments:
    """Room for AHEAD rays."""
    u, v, weight = np.empty((3, AHEAD), np.float32)
    point, face = np.empty((2, AHEAD), np.int32)
    return point, face, u, v, weight, np.empty((AHEAD, 3), np.float32)


@loop
def empty_room() -> tuple[Int, Float, Float, Float]:
    """Room for what is picked for AHEAD points: light, ratio, two numbers."""
    ratio, u, v = np.empty((3, AHEAD), np.float32)
    return np.empty(AHEAD, np.int32), ratio, u, v


@loop
def light_segments(
    picks: PickArrays,
    origin: Float,
    normal: Float,
    draws: PointDraws,
    sample: int,
    first: int,
    last: int,
    room: tuple[Int, Float, Float, Float],
    segments: Segments,
) -> int:
    """Rays of one sample from the points ``first`` to ``last`` - 1 to points on the lights, those
    that face their receiver only, into ``segments``, and their number.

    The density counts the points that face the receiver only, in both techniques alike.
    """
    light_face, _, _, _, _, triangles, _ = picks[0]
    sobol, scrambles, _, _ = draws
    point, face, us, vs, weights, directions = segments
    count = last - first
    chosen, ratio, u1, u2 = room[0][:count], room[1][:count], room[2][:count], room[3][:count]
    pick_triangles(picks, first, sobol[sample, 2], scrambles[2, first:last], chosen, ratio, u1)
    fractions(sobol[sample, 3], scrambles[3, first:last], u2)
    in_triangle(u1, u2)
    i = unsigned(0)
    for n in range(count):
        k, c = unsigned(first + n), unsigned(chosen[n])
        t = triangles[c]
        u, v = u1[n], u2[n]
        x = t[0] + u * t[3] + v * t[6] - origin[k, 0]
        y = t[1] + u * t[4] + v * t[7] - origin[k, 1]
        z = t[2] + u * t[5] + v * t[8] - origin[k, 2]
        square = x * x + y * y + z * z
        # Both cosines, times the distance.
        cosine = x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2]
        facing = -(x * t[9] + y * t[10] + z * t[11])
        both = cosine * facing
        point[i], face[i] = k, light_face[c]
        us[i], vs[i] = u, v
        directions[i, 0], directions[i, 1], directions[i, 2] = x, y, z
        weights[i] = both / (both * _INVERSE_PI + t[12] * ratio[n] * square * square)
        i = unsigned(i + ((square > _TINY) & (cosine > 0) & (facing > 0)))
    return i


@loop
def pick_triangles(
    picks: PickArrays,
    first: int,
    point: int,
    scramble: Bits,
    chosen: Int,
    ratio: Float,
    left: Float,
) -> None:
    """The lights ``chosen`` (N,) of points ``first`` and on, numbers in the groups' order,
    and how much more likely than by power that was, ``ratio`` (P,); ``left`` (P,) is what remains
    of the number, uniform again between 0 and 1."""
    (_, cumulative, guide, starts, _, _, _), patch, chances, guides, ratios = picks
    for k in range(len(chosen)):
        q = unsigned(patch[first + k])
        pick = np.uint32(np.uint32(point) ^ scramble[k]) * 2.0**-32
        g = picked(chances[q], guides[q], pick)
        low = chances[q, g - 1] if g > 0 else 0.0
        ratio[k] = ratios[q, g]
        pick = starts[g] + (pick - low) / ratios[q, g]
        which = picked(cumulative, guide, pick)
        low = cumulative[which - 1] if which > 0 else 0.0
        chosen[k] = which
        left[k] = min(max((pick - low) / (cumulative[which] - low), 0.0), 0.99999994)
