"""The compiled loops for rays to lights: points picked on bright triangles, and what the rays that
reach them brought. As in ``irradiance_batches``, samples ``start`` to ``stop`` of P points."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.packed_texture import (
    AHEAD,
    PackedArrays,
    colour_looked_at,
    empty_looks,
    look_at,
    unsigned,
)
from usdbrdf.kernel import loop
from usdbrdf.shading.light_groups import GroupArrays, picked
from usdbrdf.shading.warp_loops import fractions, in_triangle

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Short = npt.NDArray[np.int16]
Long = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]
Bits = npt.NDArray[np.uint32]

# Where P points take their random numbers from: Sobol points (S, 4), two dimensions for each
# technique, or none of them for independent numbers; scrambles (4, P); seed; identities (P,).
PointDraws: TypeAlias = tuple[Bits, Bits, int, Long]
# How P points pick lights: the groups; the row of each point's patch (P,) in what follows; the
# patches' cumulative chances of groups (Q, G), guides to these, and how much more likely than by
# power the groups are, (Q, G); Q = 0 where there are no lights.
PickArrays: TypeAlias = tuple[GroupArrays, Int, Double, Short, Float]
# Where each sample's rays end, (S,); point, face, u, v, weight of the points on lights that rays
# were sent to, (A,) each.
LightHits: TypeAlias = tuple[Long, Int, Int, Float, Float, Float]

# In the loops' own precision: with Python's constants the compiler would go over to doubles.
_ONE, _INVERSE_PI = (np.float32(c) for c in (1, 1 / math.pi))
_TINY, _NEARLY = np.float32(1e-18), np.float32(0.9999)


@loop
def light_batch(
    picks: PickArrays,
    origin: Float,
    normal: Float,
    draws: PointDraws,
    points: tuple[int, int],
    start: int,
    stop: int,
) -> tuple[Float, Float, Float, LightHits]:
    """Rays from the ``points`` first to last - 1 to points on the lights, those that face their
    receiver only: origins, directions and distances (A, 3), and what they would hit, with the
    weight that it has.

    The density counts the points that face the receiver only, in both techniques alike.
    """
    light_face, _, _, _, _, triangles, _ = picks[0]
    sobol, scrambles, _, _ = draws
    first, last = points
    count = last - first
    # What faces away is overwritten by the next: one place more than there can be.
    total = count * (stop - start) + 1
    point, face = np.empty(total, np.int32), np.empty(total, np.int32)
    origins, directions = np.empty((total, 3), np.float32), np.empty((total, 3), np.float32)
    distances, weights = np.empty(total, np.float32), np.empty(total, np.float32)
    us, vs = np.empty(total, np.float32), np.empty(total, np.float32)
    chosen, ratio = np.empty(count, np.int32), np.empty(count, np.float32)
    u1, u2 = np.empty(count, np.float32), np.empty(count, np.float32)
    ends = np.empty(stop - start, np.int64)
    i = unsigned(0)
    for sample in range(start, stop):
        pick_triangles(picks, first, sobol[sample, 2], scrambles[2, first:last], chosen, ratio, u1)
        fractions(sobol[sample, 3], scrambles[3, first:last], u2)
        in_triangle(u1, u2)
        for n in range(count):
            k, c = unsigned(first + n), unsigned(chosen[n])
            t = triangles[c]
            u, v = u1[n], u2[n]
            ox, oy, oz = origin[k, 0], origin[k, 1], origin[k, 2]
            x = t[0] + u * t[3] + v * t[6] - ox
            y = t[1] + u * t[4] + v * t[7] - oy
            z = t[2] + u * t[5] + v * t[8] - oz
            square = x * x + y * y + z * z
            # Both cosines, times the distance.
            cosine = x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2]
            facing = -(x * t[9] + y * t[10] + z * t[11])
            both = cosine * facing
            distance = np.float32(math.sqrt(square))
            inverse = _ONE / distance
            point[i], face[i] = k, light_face[c]
            us[i], vs[i] = u, v
            origins[i, 0], origins[i, 1], origins[i, 2] = ox, oy, oz
            directions[i, 0], directions[i, 1] = x * inverse, y * inverse
            directions[i, 2] = z * inverse
            distances[i] = distance * _NEARLY
            weights[i] = both / (both * _INVERSE_PI + t[12] * ratio[n] * square * square)
            i = unsigned(i + ((square > _TINY) & (cosine > 0) & (facing > 0)))
        ends[sample - start] = i
    hits = (ends, point[:i], face[:i], us[:i], vs[:i], weights[:i])
    return origins[:i], directions[:i], distances[:i], hits


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


@loop
def add_light_batch(
    radiance: PackedArrays, hits: LightHits, blocked: Bool, block: Long, sums: Double
) -> None:
    """sums += what the rays to the lights bring, where nothing is in between."""
    ends, point, face, u, v, weight = hits
    seen, looks = np.empty(len(face), np.int32), empty_looks()
    begin = 0
    for s in range(len(block)):
        total, end, count = sums[block[s]], ends[s], 0
        for i in range(begin, end):
            seen[count] = i
            count += 1 - blocked[i]
        begin = end
        for first in range(0, count, AHEAD):
            part = min(AHEAD, count - first)
            for j in range(part):
                i = unsigned(seen[unsigned(first + j)])
                look_at(radiance, looks, j, face[i], u[i], v[i])
            for j in range(part):
                red, green, blue = colour_looked_at(radiance, looks, j)
                i = unsigned(seen[unsigned(first + j)])
                k = unsigned(point[i])
                total[k, 0] += weight[i] * red
                total[k, 1] += weight[i] * green
                total[k, 2] += weight[i] * blue
