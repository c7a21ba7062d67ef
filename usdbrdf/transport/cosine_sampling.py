"""Rays in cosine-distributed directions: made, traced and added up in one compiled loop, as
``light_sampling`` does."""

from __future__ import annotations

import math

import numpy as np

from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.transport.environment import environment_at
from usdbrdf.transport.light_sampling import Met, PointDraws, Receivers, turns
from usdbrdf.transport.lights import DENSITY, GROUP, facing
from usdbrdf.transport.rays import Hits, closest_hits, closest_hits_of_groups, empty_hits
from usdbrdf.transport.surface_texture import (
    AHEAD,
    add_looked_at,
    empty_looks,
    fetch_face,
    look_at,
    prefetch,
    unsigned,
)
from usdbrdf.transport.tile_draws import groups_of
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
                for c in range(3):
                    far = environment_at(met.environment, d[i, 0], d[i, 1], d[i, 2], c)
                    total[k, c] += np.pi * far
        if use_lights:
            weigh_lamps(receivers, first, d, hits, lamps[:count], light, weight)
        for i in range(part):
            look_at(radiance, looks, i, max(hits.face[i], 0), hits.u[i], hits.v[i])
        for i in range(part):
            add_looked_at(radiance, looks, i, weight[i], total, unsigned(first + i))


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
