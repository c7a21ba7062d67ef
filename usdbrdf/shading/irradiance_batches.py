"""The compiled loops of the irradiance estimator: rays to trace, and what they brought.

They run on one thread, mostly in single precision, and let go of Python's lock, so that each thread
takes points of its own through generating, tracing and adding up while the rays are still in its
cache. P points take samples ``start`` to ``stop``; ray r = (sample - start) * P + point, so that
rays of one sample, which are nearly parallel within a patch, follow each other.

Sums are kept in four blocks of samples, (4, P, 3), so that the estimator can tell its own error,
and apart for the two techniques: each then adds up in the order of its samples, however many of
them a batch has.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.packed_texture import PackedArrays, packed_colour, packed_place
from usdbrdf.kernel import loop
from usdbrdf.shading.environment import EnvironmentArrays, environment_at
from usdbrdf.shading.light_groups import GroupArrays, picked
from usdbrdf.shading.lights import LightArrays
from usdbrdf.shading.warp_loops import fractions, in_triangle, on_hemisphere
from usdbrdf.shading.warps import hashed_uniform, tangent_frame

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]
Bits = npt.NDArray[np.uint32]

# Where P points take their random numbers from: Sobol points (S, 2), or none of them for
# independent numbers; scrambles (4, P); seed; identities (P,).
PointDraws: TypeAlias = tuple[Bits, Bits, int, Long]
# How P points pick lights: the groups; each point's patch (P,), from 0; the patches' cumulative
# chances of groups (Q, G), guides to these, and how much more likely than by power the groups are,
# (Q, G); Q = 0 where there are no lights.
PickArrays: TypeAlias = tuple[GroupArrays, Int, Double, Int, Float]
# face, u, v, distance of the first surfaces, (R,) each.
HitArrays: TypeAlias = tuple[Int, Float, Float, Float]
# Number r, face, u, v, weight of the points on lights that rays were sent to, (A,) each.
LightHits: TypeAlias = tuple[Int, Int, Float, Float, Float]

# In the loops' own precision: with Python's constants the compiler would go over to doubles.
_ONE, _PI, _INVERSE_PI = (np.float32(c) for c in (1, math.pi, 1 / math.pi))
_TINY, _NEARLY = np.float32(1e-18), np.float32(0.9999)


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
def scrambles_of_points(patch: Int, identity: Long, seed: int, own_bits: Bits) -> Bits:
    """What each point's Sobol points are combined with by exclusive or, (4, P), two for each
    technique: its patch's random bits and, where ``own_bits`` (2,) has ones, its own."""
    scrambles = np.empty((4, len(patch)), np.uint32)
    for d in range(4):
        mask = own_bits[d % 2]
        for k in range(len(patch)):
            # Other draws than a point's own ones, whose numbers are counted from 0 as well.
            shared = np.uint32(hashed_uniform(seed, patch[k], 16 + d) * 2.0**32)
            own = np.uint32(hashed_uniform(seed, identity[k], d) * 2.0**32)
            scrambles[d, k] = shared ^ (own & mask)
    return scrambles


@loop
def cosine_batch(
    origin: Float, frames: Float, draws: PointDraws, start: int, stop: int
) -> tuple[Float, Float]:
    """Origins and cosine-distributed directions (R, 3) of all points."""
    sobol, scrambles, seed, identity = draws
    count = len(origin)
    origins = np.empty((count * (stop - start), 3), np.float32)
    directions = np.empty((count * (stop - start), 3), np.float32)
    x, y, z = (
        np.empty(count, np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
    )
    for sample in range(start, stop):
        first = (sample - start) * count
        origins[first : first + count] = origin
        if len(sobol) == 0:
            for k in range(count):
                x[k] = hashed_uniform(seed, identity[k], sample * 2)
                y[k] = hashed_uniform(seed, identity[k], sample * 2 + 1)
        else:
            fractions(sobol[sample, 0], scrambles[0], x)
            fractions(sobol[sample, 1], scrambles[1], y)
        on_hemisphere(x, y, z)
        d = directions[first : first + count]
        for k in range(count):
            d[k, 0] = x[k] * frames[0, k] + y[k] * frames[3, k] + z[k] * frames[6, k]
            d[k, 1] = x[k] * frames[1, k] + y[k] * frames[4, k] + z[k] * frames[7, k]
            d[k, 2] = x[k] * frames[2, k] + y[k] * frames[5, k] + z[k] * frames[8, k]
    return origins, directions


@loop
def add_cosine_batch(
    radiance: PackedArrays,
    environment: EnvironmentArrays,
    lights: LightArrays,
    picks: PickArrays,
    normal: Float,
    directions: Float,
    hits: HitArrays,
    block: Long,
    sums: Double,
    escaped: Double,
) -> None:
    """sums += L cos / (p_cosine + p_light) for the cosine-distributed rays, each into its sample's
    block; escaped (P,) += 1 for each ray that met nothing."""
    image, z_up = environment
    _, _, light_density, _, face_normals = lights
    of_face, patch, ratio = picks[0][4], picks[1], picks[4]
    use_lights = len(ratio) > 0
    face, u, v, distance = hits
    count = len(normal)
    weight = np.empty(count, np.float32)
    fx, fy = np.empty(count, np.float32), np.empty(count, np.float32)
    place, width = np.empty(count, np.uint32), np.empty(count, np.uint32)
    # In two passes, so that more of what they wait for from memory is under way at a time.
    for s in range(len(block)):
        first, total = s * count, sums[block[s]]
        for k in range(count):
            r, f = first + k, face[first + k]
            weight[k] = _PI
            if f < 0:
                f = 0
                weight[k] = 0
                escaped[k] += 1
                x, y, z = directions[r, 0], directions[r, 1], directions[r, 2]
                for c in range(3):
                    total[k, c] += np.pi * environment_at(image, z_up, x, y, z, c)
            elif use_lights and light_density[f] > 0:
                m, n = face_normals[f], normal[k]
                x, y, z = directions[r, 0], directions[r, 1], directions[r, 2]
                facing = -(x * m[0] + y * m[1] + z * m[2])
                cosine = max(x * n[0] + y * n[1] + z * n[2], _TINY)
                if facing > 0:
                    density = light_density[f] * ratio[patch[k], of_face[f]]
                    square = distance[r] * distance[r]
                    weight[k] = cosine / (cosine * _INVERSE_PI + density * square / facing)
            place[k], width[k], fx[k], fy[k] = packed_place(radiance, f, u[r], v[r])
        for k in range(count):
            red, green, blue = packed_colour(radiance, place[k], width[k], fx[k], fy[k])
            total[k, 0] += weight[k] * red
            total[k, 1] += weight[k] * green
            total[k, 2] += weight[k] * blue


@loop
def light_batch(
    picks: PickArrays,
    origin: Float,
    normal: Float,
    draws: PointDraws,
    start: int,
    stop: int,
) -> tuple[Float, Float, Float, LightHits]:
    """Rays to points on the lights, those that face their receiver only: origins, directions and
    distances (A, 3), and what they would hit, with the weight that it has.

    The density counts the points that face the receiver only, in both techniques alike.
    """
    light_face, _, _, _, _, triangles = picks[0]
    sobol, scrambles, _, _ = draws
    count = len(normal)
    # What faces away is overwritten by the next: one place more than there can be.
    total = count * (stop - start) + 1
    number, face = np.empty(total, np.int32), np.empty(total, np.int32)
    origins, directions = np.empty((total, 3), np.float32), np.empty((total, 3), np.float32)
    distances, weights = np.empty(total, np.float32), np.empty(total, np.float32)
    us, vs = np.empty(total, np.float32), np.empty(total, np.float32)
    chosen, ratio = np.empty(count, np.int32), np.empty(count, np.float32)
    u1, u2 = np.empty(count, np.float32), np.empty(count, np.float32)
    i = 0
    for sample in range(start, stop):
        pick_triangles(picks, sobol[sample, 0], scrambles[2], chosen, ratio, u1)
        fractions(sobol[sample, 1], scrambles[3], u2)
        in_triangle(u1, u2)
        first = (sample - start) * count
        for k in range(count):
            t = triangles[chosen[k]]
            u, v = u1[k], u2[k]
            x = t[0] + u * t[3] + v * t[6] - origin[k, 0]
            y = t[1] + u * t[4] + v * t[7] - origin[k, 1]
            z = t[2] + u * t[5] + v * t[8] - origin[k, 2]
            square = x * x + y * y + z * z
            # Both cosines, times the distance.
            cosine = x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2]
            facing = -(x * t[9] + y * t[10] + z * t[11])
            both = cosine * facing
            distance = np.float32(math.sqrt(square))
            inverse = _ONE / distance
            number[i], face[i] = first + k, light_face[chosen[k]]
            us[i], vs[i] = u, v
            origins[i, 0], origins[i, 1], origins[i, 2] = origin[k, 0], origin[k, 1], origin[k, 2]
            directions[i, 0], directions[i, 1] = x * inverse, y * inverse
            directions[i, 2] = z * inverse
            distances[i] = distance * _NEARLY
            weights[i] = both / (both * _INVERSE_PI + t[12] * ratio[k] * square * square)
            i += 1 if square > _TINY and cosine > 0 and facing > 0 else 0
    hits = (number[:i], face[:i], us[:i], vs[:i], weights[:i])
    return origins[:i], directions[:i], distances[:i], hits


@loop
def pick_triangles(
    picks: PickArrays, point: int, scramble: Bits, chosen: Int, ratio: Float, left: Float
) -> None:
    """Each point's light ``chosen`` (P,), a number in the groups' order, by its scrambled number,
    and how much more likely than by power that was, ``ratio`` (P,); ``left`` (P,) is what remains
    of the number, uniform again between 0 and 1."""
    (_, cumulative, guide, starts, _, _), patch, chances, guides, ratios = picks
    for k in range(len(chosen)):
        q = patch[k]
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
    number, face, u, v, weight = hits
    count = sums.shape[1]
    for i in range(len(number)):
        if not blocked[i]:
            place, width, fx, fy = packed_place(radiance, face[i], u[i], v[i])
            red, green, blue = packed_colour(radiance, place, width, fx, fy)
            b, k = block[number[i] // count], number[i] % count
            sums[b, k, 0] += weight[i] * red
            sums[b, k, 1] += weight[i] * green
            sums[b, k, 2] += weight[i] * blue


@loop
def mean_and_error(sums: Double, samples: int) -> tuple[Double, Double]:
    """Mean of ``samples`` in all, and its standard error from the four blocks, (P, 3) each; sums
    (2, 4, P, 3), one for each technique."""
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
