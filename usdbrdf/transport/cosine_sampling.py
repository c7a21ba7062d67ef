"""Rays in cosine-distributed directions: made, traced and added up in one compiled loop.

The loops here and in ``light_by_picks`` run on one thread, mostly in single precision, and let go
of Python's lock; each thread takes points of its own. They take AHEAD points at a time, so that all
that a ray needs from its making to what it brought stays in the nearest cache. One sample's rays of
all points follow each other: within a patch they point in much the same direction, a group's are
nearly parallel and traced together.

Sums are kept in four blocks of samples, (4, P, 4), whose last column fills up a row, so that the
estimator can tell its own error.
"""

from __future__ import annotations

import math

import numpy as np

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.transport.embree import closest_hits, closest_hits_of_groups, prefetch
from usdbrdf.transport.environment import EnvironmentArrays, environment_at
from usdbrdf.transport.light_sampling import PickArrays, PointDraws, turns
from usdbrdf.transport.patch_draws import groups_of
from usdbrdf.transport.surface_texture import (
    AHEAD,
    PackedArrays,
    add_looked_at,
    empty_looks,
    fetch_face,
    look_at,
    unsigned,
)
from usdbrdf.transport.warps import fractions, hashed_uniform, on_hemisphere, tangent_frame

# In the loops' own precision: with Python's constants the compiler would go over to doubles.
_PI, _INVERSE_PI, _TINY = (np.float32(c) for c in (math.pi, 1 / math.pi, 1e-18))


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
    frames: Float, draws: PointDraws, sample: int, first: int, out: Float, room: Float
) -> None:
    """Cosine-distributed directions about the normals of points ``first`` and on, into ``out``
    (N, 3); room (3, N) for what is computed on the way."""
    sobol, scrambles, seed, identity = draws
    count = len(out)
    x, y, z = room[0, :count], room[1, :count], room[2, :count]
    if len(sobol) == 0:
        for k in range(count):
            x[k] = hashed_uniform(seed, identity[first + k], sample * 2)
            y[k] = hashed_uniform(seed, identity[first + k], sample * 2 + 1)
    else:
        fractions(sobol[sample, 0], scrambles[0, first : first + count], x)
        fractions(sobol[sample, 1], scrambles[1, first : first + count], y)
    on_hemisphere(x, y, z)
    f = frames[:, first : first + count]
    for k in range(count):
        out[k, 0] = x[k] * f[0, k] + y[k] * f[3, k] + z[k] * f[6, k]
        out[k, 1] = x[k] * f[1, k] + y[k] * f[4, k] + z[k] * f[7, k]
        out[k, 2] = x[k] * f[2, k] + y[k] * f[5, k] + z[k] * f[8, k]


@loop
def add_light_by_direction(
    scene: int,
    radiance: PackedArrays,
    environment: EnvironmentArrays,
    picks: PickArrays,
    origin: Float,
    normal: Float,
    draws: PointDraws,
    start: int,
    block: Long,
    sums: Double,
    escaped: Double,
) -> None:
    """sums += L cos / (p_cosine + p_light) for samples ``start`` and on of P points (origin,
    normal (P, 3)), each into its ``block``; escaped (P,) += 1 for each ray that met nothing."""
    frames, room, group = frames_of(normal), np.empty((3, AHEAD), np.float32), groups_of(draws[3])
    directions, face = np.empty((AHEAD, 3), np.float32), np.empty(AHEAD, np.int32)
    u, v, distance = np.empty((3, AHEAD), np.float32)
    weight, looks = np.empty(AHEAD, np.float32), empty_looks()
    lamps, light = np.empty((2, AHEAD), np.int32)
    image, z_up = environment
    is_light, use_lights = picks[0][6], len(picks[4]) > 0
    for first, last, s in turns(group, len(block)):
        total = sums[block[s]]
        part = last - first
        d = directions[:part]
        cosine_directions(frames, draws, start + s, first, d, room)
        if len(draws[0]):
            closest_hits_of_groups(
                scene, origin[first:last], d, group[first:last], face, u, v, distance
            )
        else:
            closest_hits(scene, origin[first:last], d, face, u, v, distance)
        # In passes, so that what they wait for from memory is under way before it is read.
        count = 0
        for i in range(part):
            f = face[i]
            fetch_face(radiance, max(f, 0))
            weight[i], lamps[count] = _PI, i
            if f >= 0:
                count += is_light[f >> 3] >> (f & 7) & 1
            else:
                weight[i], k = 0, unsigned(first + i)
                escaped[k] += 1
                for c in range(3):
                    total[k, c] += np.pi * environment_at(image, z_up, d[i, 0], d[i, 1], d[i, 2], c)
        if use_lights:
            weigh_lamps(picks, normal, first, d, (face, distance), lamps[:count], light, weight)
        for i in range(part):
            look_at(radiance, looks, i, max(face[i], 0), u[i], v[i])
        for i in range(part):
            add_looked_at(radiance, looks, i, weight[i], total, unsigned(first + i))


@loop
def weigh_lamps(
    picks: PickArrays,
    normal: Float,
    first: int,
    directions: Float,
    hits: tuple[Int, Float],
    which: Int,
    light: Int,
    weight: Float,
) -> None:
    """The weights of the rays ``which`` (N,), of those of points ``first`` and on, that met lights
    and might have been picked as well. hits: face and distance of each ray."""
    light_of_face, triangles, row, ratio = picks[0][4], picks[0][5], picks[1], picks[4]
    face, distance = hits
    for i in which:
        prefetch(light_of_face, unsigned(face[i]))
    for j in range(len(which)):
        light[j] = light_of_face[unsigned(face[which[j]])]
        prefetch(triangles, unsigned(light[j]))
    for j in range(len(which)):
        i = unsigned(which[j])
        t, k = triangles[unsigned(light[j])], unsigned(first + i)
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        facing = -(x * t[9] + y * t[10] + z * t[11])
        cosine = max(x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2], _TINY)
        if facing > 0:
            density = t[12] * ratio[row[k], np.int32(t[13])]
            square = distance[i] * distance[i]
            weight[i] = cosine / (cosine * _INVERSE_PI + density * square / facing)
