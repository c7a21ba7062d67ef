"""Rays in cosine-distributed directions, and rays to points picked on bright triangles: made,
traced and added up in one compiled loop each.

The loops run on one thread, mostly in single precision, and let go of Python's lock; each thread
takes points of its own. They take AHEAD points at a time, so that all that a ray needs from its
making to what it brought stays in the nearest cache. One sample's rays of all points follow each
other: within a tile they point in much the same direction, a group's are nearly parallel and traced
together.

Sums are kept in four blocks of samples, (4, P, 4), whose last column fills up a row, so that the
estimator can tell its own error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Bits, Bool, Double, Float, Int, Long
from usdbrdf.transport.environment import Environment, environment_at
from usdbrdf.transport.lights import DENSITY, GROUP, LightGroups, TilePicks, facing, picked, way_to
from usdbrdf.transport.openings import opening_at
from usdbrdf.transport.rays import Hits, closest_hits, closest_hits_of_groups, empty_hits, occlusion
from usdbrdf.transport.surface_texture import (
    AHEAD,
    SurfaceTexture,
    add_looked_at,
    empty_looks,
    fetch_face,
    look_at,
    prefetch,
    unsigned,
)
from usdbrdf.transport.tile_draws import groups_of
from usdbrdf.transport.warps import (
    fractions,
    hashed_uniform,
    in_triangle,
    on_hemisphere,
    tangent_frame,
)

# So many times AHEAD points' sums, and tables of lights, stay in the cache of a core together.
_TOGETHER = 2
# In the loops' own precision: with Python's constants the compiler would go over to doubles.
_PI, _INVERSE_PI, _TINY, _NEARLY = (np.float32(c) for c in (math.pi, 1 / math.pi, 1e-18, 0.9999))


class Met(NamedTuple):
    """What rays meet: Embree's address of the ``scene``, L_d on it, and the light from outside."""

    scene: int
    radiance: SurfaceTexture
    environment: Environment


class PointDraws(NamedTuple):
    """Where P points take their random numbers from: Sobol points (S, 4), two dimensions for each
    technique, or none of them for independent numbers; scrambles (4, P); seed; identities (P,)."""

    sobol: Bits
    scrambles: Bits
    seed: int
    identity: Long


class Receivers(NamedTuple):
    """P points that light arrives at: origins of their rays and normals (P, 3), their random
    numbers, how they pick lights: the ``groups`` and the row (P,) of each point's tile in
    ``picks``; and how light counts by its angle: factors (K, C) at even cosines (none: all alike)
    and each point's ``surface`` (P,), a row of these."""

    origin: Float
    normal: Float
    draws: PointDraws
    groups: LightGroups
    row: Int
    picks: TilePicks
    angle: Float
    surface: Int


class Segments(NamedTuple):
    """Rays to points on lights: the receiving point, the triangle and place that the ray is sent
    to, the weight of what is found there, (N,) each; direction (N, 3), as long as the way there."""

    point: Int
    face: Int
    u: Float
    v: Float
    weight: Float
    direction: Float


class Picked(NamedTuple):
    """Lights of N points, numbers in the groups' order, how much more likely than by power that
    was, and two numbers between 0 and 1, (N,) each."""

    light: Int
    ratio: Float
    u: Float
    v: Float


@loop
def add_light_samples(
    met: Met, receivers: Receivers, start: int, block: Long, sums: Double
) -> None:
    """sums += what rays to the lights bring to P points, where nothing is in between: samples
    ``start`` and on, each into its ``block``."""
    segments, scratch, looks = empty_segments(), empty_picked(), empty_looks()
    blocked, free = np.empty(AHEAD, np.bool_), np.empty(AHEAD, np.int32)
    for first, last, s in turns(groups_of(receivers.draws.identity), len(block)):
        total = sums[block[s]]
        part = light_segments(receivers, start + s, first, last, scratch, segments)
        occlusion(
            met.scene, receivers.origin, segments.point[:part], segments.direction, _NEARLY, blocked
        )
        if receivers.groups.box[2, 0] > 0:
            add_from_outside(met.environment, receivers.groups, segments, part, blocked, total)
        count = 0
        for i in range(part):
            free[count] = i
            count += 1 - blocked[i]
        for j in range(count):
            i = unsigned(free[j])
            look_at(met.radiance, looks, j, segments.face[i], segments.u[i], segments.v[i])
        for j in range(count):
            i = unsigned(free[j])
            add_looked_at(
                met.radiance, looks, j, segments.weight[i], total, unsigned(segments.point[i])
            )


@loop
def add_from_outside(
    environment: Environment,
    groups: LightGroups,
    segments: Segments,
    part: int,
    blocked: Bool,
    total: Double,
) -> None:
    """total += what the rays through openings bring, of the first ``part``; they are then as good
    as ``blocked``."""
    for i in range(part):
        if segments.face[i] < groups.first_opening or blocked[i]:
            continue
        blocked[i] = True
        x, y, z = segments.direction[i, 0], segments.direction[i, 1], segments.direction[i, 2]
        scale, k = 1 / math.sqrt(x * x + y * y + z * z), unsigned(segments.point[i])
        for c in range(3):
            far = environment_at(environment, x * scale, y * scale, z * scale, c)
            total[k, c] += segments.weight[i] * far


@loop
def turns(group: Long, samples: int) -> list[tuple[int, int, int]]:
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
    """Memory for AHEAD rays."""
    u, v, weight = np.empty((3, AHEAD), np.float32)
    point, face = np.empty((2, AHEAD), np.int32)
    return Segments(point, face, u, v, weight, np.empty((AHEAD, 3), np.float32))


@loop
def empty_picked() -> Picked:
    """Memory for what is picked for AHEAD points."""
    ratio, u, v = np.empty((3, AHEAD), np.float32)
    return Picked(np.empty(AHEAD, np.int32), ratio, u, v)


@loop
def light_segments(
    receivers: Receivers, sample: int, first: int, last: int, scratch: Picked, segments: Segments
) -> int:
    """Rays of one sample from the points ``first`` to ``last`` - 1 to points on the lights, those
    that face their receiver only, into ``segments``, and their number.

    The density counts the points that face the receiver only, in both techniques alike.
    """
    groups, origin, normal = receivers.groups, receivers.origin, receivers.normal
    sobol, scrambles = receivers.draws.sobol, receivers.draws.scrambles
    count = last - first
    chosen, ratio = scratch.light[:count], scratch.ratio[:count]
    us, vs = scratch.u[:count], scratch.v[:count]
    pick_triangles(
        receivers, first, sobol[sample, 2], scrambles[2, first:last], Picked(chosen, ratio, us, vs)
    )
    fractions(sobol[sample, 3], scrambles[3, first:last], vs)
    in_triangle(us, vs)
    i = unsigned(0)
    for n in range(count):
        k, c = unsigned(first + n), unsigned(chosen[n])
        triangle = groups.triangles[c]
        u, v = us[n], vs[n]
        x, y, z = way_to(triangle, u, v, origin[k, 0], origin[k, 1], origin[k, 2])
        square = x * x + y * y + z * z
        # Both cosines, times the distance.
        received = x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2]
        sent = facing(triangle, x, y, z)
        both = received * sent
        segments.point[i], segments.face[i] = k, groups.face[c]
        segments.u[i], segments.v[i] = u, v
        directions = segments.direction
        directions[i, 0], directions[i, 1], directions[i, 2] = x, y, z
        by_picks = triangle[DENSITY] * ratio[n] * square * square
        segments.weight[i] = both / (both * _INVERSE_PI + by_picks)
        i = unsigned(i + ((square > _TINY) & (received > 0) & (sent > 0)))
    if len(receivers.angle):
        for n in range(i):
            segments.weight[n] *= counted(receivers, segments.point[n], segments.direction, n)
    return i


@loop
def pick_triangles(
    receivers: Receivers, first: int, point: int, scramble: Bits, chosen: Picked
) -> None:
    """The lights of points ``first`` and on, by the scrambled Sobol number ``point``; ``u`` is what
    remains of the number, uniform again between 0 and 1."""
    groups, tiles = receivers.groups, receivers.picks
    for k in range(len(chosen.light)):
        q = unsigned(receivers.row[first + k])
        pick = np.uint32(np.uint32(point) ^ scramble[k]) * 2.0**-32
        g = picked(tiles.cumulative[q], tiles.guide[q], pick)
        low = tiles.cumulative[q, g - 1] if g > 0 else 0.0
        chosen.ratio[k] = tiles.ratio[q, g]
        pick = groups.start[g] + (pick - low) / tiles.ratio[q, g]
        which = picked(groups.cumulative, groups.guide, pick)
        low = groups.cumulative[which - 1] if which > 0 else 0.0
        chosen.light[k] = which
        left = (pick - low) / (groups.cumulative[which] - low)
        chosen.u[k] = min(max(left, 0.0), 0.99999994)


@loop
def frames_of(normal: Float) -> Float:
    """Tangent, bitangent and normal of each point, (9, P)."""
    frames = np.empty((9, len(normal)), np.float32)
    for k in range(len(normal)):
        tx, ty, tz, bx, by, bz = tangent_frame(normal[k])
        frames[0, k], frames[1, k], frames[2, k] = tx, ty, tz
        frames[3, k], frames[4, k], frames[5, k] = bx, by, bz
        frames[6, k], frames[7, k], frames[8, k] = normal[k, 0], normal[k, 1], normal[k, 2]
    return frames


@loop
def cosine_directions(
    frames: Float, draws: PointDraws, sample: int, first: int, out: Float, scratch: Float
) -> None:
    """Cosine-distributed directions about the normals of points ``first`` and on, into ``out``
    (N, 3); scratch (3, N) for what is computed on the way."""
    count = len(out)
    x, y, z = scratch[0, :count], scratch[1, :count], scratch[2, :count]
    if len(draws.sobol) == 0:
        for k in range(count):
            x[k] = hashed_uniform(draws.seed, draws.identity[first + k], sample * 2)
            y[k] = hashed_uniform(draws.seed, draws.identity[first + k], sample * 2 + 1)
    else:
        fractions(draws.sobol[sample, 0], draws.scrambles[0, first : first + count], x)
        fractions(draws.sobol[sample, 1], draws.scrambles[1, first : first + count], y)
    on_hemisphere(x, y, z)
    f = frames[:, first : first + count]
    for k in range(count):
        out[k, 0] = x[k] * f[0, k] + y[k] * f[3, k] + z[k] * f[6, k]
        out[k, 1] = x[k] * f[1, k] + y[k] * f[4, k] + z[k] * f[7, k]
        out[k, 2] = x[k] * f[2, k] + y[k] * f[5, k] + z[k] * f[8, k]


@loop
def add_cosine_samples(
    met: Met, receivers: Receivers, start: int, block: Long, sums: Double, escaped: Double
) -> None:
    """sums += L cos / (p_cosine + p_light) for samples ``start`` and on of P points, each into its
    ``block``; escaped (P,) += 1 for each ray that met nothing."""
    draws, radiance = receivers.draws, met.radiance
    frames, scratch = frames_of(receivers.normal), np.empty((3, AHEAD), np.float32)
    group, directions = groups_of(draws.identity), np.empty((AHEAD, 3), np.float32)
    hits, weight, looks = empty_hits(AHEAD), np.empty(AHEAD, np.float32), empty_looks()
    lamps, light = np.empty((2, AHEAD), np.int32)
    is_light, use_lights = receivers.groups.is_light, len(receivers.picks.ratio) > 0
    for first, last, s in turns(group, len(block)):
        total = sums[block[s]]
        part = last - first
        d, origin = directions[:part], receivers.origin[first:last]
        cosine_directions(frames, draws, start + s, first, d, scratch)
        if len(draws.sobol):
            closest_hits_of_groups(met.scene, origin, d, group[first:last], hits)
        else:
            closest_hits(met.scene, origin, d, hits)
        # In passes, so that what they wait for from memory is under way before it is read.
        count = 0
        for i in range(part):
            f = hits.face[i]
            fetch_face(radiance, max(f, 0))
            weight[i], lamps[count] = _PI, i
            if f >= 0:
                count += is_light[f >> 3] >> (f & 7) & 1
            else:
                weight[i], k = 0, unsigned(first + i)
                escaped[k] += 1
                share = math.pi
                if use_lights and receivers.groups.box[2, 0] > 0:
                    share = weight_of_opening(receivers, k, d, i)
                if len(receivers.angle):
                    share *= counted(receivers, k, d, i)
                for c in range(3):
                    far = environment_at(met.environment, d[i, 0], d[i, 1], d[i, 2], c)
                    total[k, c] += far * share
        if use_lights:
            weigh_lamps(receivers, first, d, hits, lamps[:count], light, weight)
        if len(receivers.angle):
            for i in range(part):
                k = unsigned(first + i)
                weight[i] *= counted(receivers, k, d, i)
        for i in range(part):
            look_at(radiance, looks, i, max(hits.face[i], 0), hits.u[i], hits.v[i])
        for i in range(part):
            add_looked_at(radiance, looks, i, weight[i], total, unsigned(first + i))


@loop
def weight_of_opening(receivers: Receivers, k: int, directions: Float, i: int) -> float:
    """Of the ray from point k in direction i that leaves the scene, and might have been sent to
    where it does."""
    groups, x, normal = receivers.groups, receivers.origin[k], receivers.normal[k]
    dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
    opening, distance = opening_at(groups.box, x[0], x[1], x[2], dx, dy, dz)
    light = groups.of_face[groups.first_opening + opening]
    if light < 0:
        return math.pi
    triangle = groups.triangles[light]
    sent, cosine = facing(triangle, dx, dy, dz), dx * normal[0] + dy * normal[1] + dz * normal[2]
    if sent <= 0 or cosine <= 0:
        return math.pi
    density = triangle[DENSITY] * receivers.picks.ratio[receivers.row[k], np.int32(triangle[GROUP])]
    return float(cosine / (cosine / math.pi + density * distance * distance / sent))


@loop
def counted(receivers: Receivers, k: int, directions: Float, i: int) -> float:
    """How light from direction i, of any length, counts at point k by its angle there."""
    x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
    normal, factors = receivers.normal[k], receivers.angle[receivers.surface[k]]
    cosine = (x * normal[0] + y * normal[1] + z * normal[2]) / math.sqrt(x * x + y * y + z * z)
    place = min(max(cosine, 0.0), 1.0) * (len(factors) - 1)
    left = min(int(place), len(factors) - 2)
    share: float = factors[left] + (factors[left + 1] - factors[left]) * (place - left)
    return share


@loop
def weigh_lamps(
    receivers: Receivers,
    first: int,
    directions: Float,
    hits: Hits,
    which: Int,
    light: Int,
    weight: Float,
) -> None:
    """The weights of the rays ``which`` (N,), of those of points ``first`` and on, that met lights
    and might have been picked as well; ``light`` is overwritten."""
    groups, normal, ratio = receivers.groups, receivers.normal, receivers.picks.ratio
    for i in which:
        prefetch(groups.of_face, unsigned(hits.face[i]))
    for j in range(len(which)):
        light[j] = groups.of_face[unsigned(hits.face[which[j]])]
        prefetch(groups.triangles, unsigned(light[j]))
    for j in range(len(which)):
        i = unsigned(which[j])
        triangle, k = groups.triangles[unsigned(light[j])], unsigned(first + i)
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        sent = facing(triangle, x, y, z)
        cosine = max(x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2], _TINY)
        if sent > 0:
            density = triangle[DENSITY] * ratio[receivers.row[k], np.int32(triangle[GROUP])]
            square = hits.distance[i] * hits.distance[i]
            weight[i] = cosine / (cosine * _INVERSE_PI + density * square / sent)
