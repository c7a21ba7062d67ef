"""The compiled loops of the irradiance estimator: rays to trace, and what they brought.

They run on one thread and let go of Python's lock, so that each thread takes points of its own
through generating, tracing and adding up while the rays are still in its cache. P points take
samples ``start`` to ``stop``; ray r = (sample - start) * P + point, so that rays of one sample,
which are nearly parallel within a patch, follow each other.

Sums are kept in four blocks of samples, (P, 4, 3), so that the estimator can tell its own error,
and apart for the two techniques: each then adds up in the order of its samples, however many of
them a batch has.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.surface_radiance import TextureArrays, texture_place
from usdbrdf.kernel import loop
from usdbrdf.shading.environment import EnvironmentArrays, environment_at
from usdbrdf.shading.irradiance_kernels import Draws
from usdbrdf.shading.lights import LightArrays
from usdbrdf.shading.warp_loops import fractions, in_triangle, on_hemisphere
from usdbrdf.shading.warps import hashed_uniform, tangent_frame

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

# Of the random numbers: two for a direction, three for a point on a light.
DIMENSIONS = 5

# face, u, v, distance of the first surfaces, (R,) each.
HitArrays: TypeAlias = tuple[Int, Float, Float, Float]


@loop
def frames_of(normal: Float) -> Double:
    """Tangent, bitangent and normal of each point, (9, P)."""
    frames = np.empty((9, len(normal)))
    for k in range(len(normal)):
        tx, ty, tz, bx, by, bz = tangent_frame(normal[k])
        frames[0, k], frames[1, k], frames[2, k] = tx, ty, tz
        frames[3, k], frames[4, k], frames[5, k] = bx, by, bz
        frames[6, k], frames[7, k], frames[8, k] = normal[k, 0], normal[k, 1], normal[k, 2]
    return frames


@loop
def shifts_of_points(draws: Draws, own_shift: float) -> Double:
    """What each point adds to the Sobol points, (5, P): its patch's shift and one of its own, of
    at most ``own_shift``."""
    _, shift, patch, seed, identity = draws
    shifts = np.empty((DIMENSIONS, len(patch)))
    for dimension in range(DIMENSIONS):
        for k in range(len(patch)):
            own = hashed_uniform(seed, identity[k], dimension) * own_shift
            shifts[dimension, k] = shift[patch[k], dimension] + own
    return shifts


@loop
def cosine_batch(
    origin: Float, frames: Double, shifts: Double, draws: Draws, start: int, stop: int
) -> tuple[Float, Float]:
    """Origins and cosine-distributed directions (R, 3) of all points."""
    points, _, _, seed, identity = draws
    count = len(origin)
    origins = np.empty((count * (stop - start), 3), np.float32)
    directions = np.empty((count * (stop - start), 3), np.float32)
    x, y, z = np.empty(count), np.empty(count), np.empty(count)
    for sample in range(start, stop):
        first = (sample - start) * count
        origins[first : first + count] = origin
        if len(points) == 0:
            for k in range(count):
                x[k] = hashed_uniform(seed, identity[k], sample * 2)
                y[k] = hashed_uniform(seed, identity[k], sample * 2 + 1)
        else:
            fractions(points[sample, 0], shifts[0], x)
            fractions(points[sample, 1], shifts[1], y)
        on_hemisphere(x, y, z)
        d = directions[first : first + count]
        for k in range(count):
            d[k, 0] = x[k] * frames[0, k] + y[k] * frames[3, k] + z[k] * frames[6, k]
            d[k, 1] = x[k] * frames[1, k] + y[k] * frames[4, k] + z[k] * frames[7, k]
            d[k, 2] = x[k] * frames[2, k] + y[k] * frames[5, k] + z[k] * frames[8, k]
    return origins, directions


@loop
def _colour(
    radiance: TextureArrays, f: int, k: int, fx: float, fy: float
) -> tuple[float, float, float]:
    """``texture_at`` for all three channels, at a ``texture_place`` on face f."""
    pixels, _, _, size = radiance
    width, height = size[f, 0], size[f, 1]
    right = k + (1 if width > 1 else 0)
    down = width if height > 1 else 0
    a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    low, low_right = k + down, right + down
    red = a * pixels[k, 0] + b * pixels[right, 0] + c * pixels[low, 0] + d * pixels[low_right, 0]
    green = a * pixels[k, 1] + b * pixels[right, 1] + c * pixels[low, 1] + d * pixels[low_right, 1]
    blue = a * pixels[k, 2] + b * pixels[right, 2] + c * pixels[low, 2] + d * pixels[low_right, 2]
    return red, green, blue


@loop
def add_cosine_batch(
    radiance: TextureArrays,
    environment: EnvironmentArrays,
    lights: LightArrays,
    use_lights: bool,
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
    face, u, v, distance = hits
    count = len(normal)
    weight, fx, fy = np.empty(count), np.empty(count), np.empty(count)
    place = np.empty(count, np.int64)
    # In two passes, so that more of what they wait for from memory is under way at a time.
    for s in range(len(block)):
        b, first = block[s], s * count
        for k in range(count):
            r, f = first + k, face[first + k]
            weight[k] = 0.0
            x, y, z = directions[r, 0], directions[r, 1], directions[r, 2]
            cosine = x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2]
            if cosine <= 0:
                continue
            if f < 0:
                escaped[k] += 1
                for c in range(3):
                    sums[k, b, c] += np.pi * environment_at(image, z_up, x, y, z, c)
                continue
            weight[k] = np.pi
            if use_lights and light_density[f] > 0:
                m = face_normals[f]
                facing = -(x * m[0] + y * m[1] + z * m[2])
                if facing > 0:
                    square = distance[r] * distance[r]
                    weight[k] = cosine / (cosine / np.pi + light_density[f] * square / facing)
            place[k], fx[k], fy[k] = texture_place(radiance, f, u[r], v[r])
        for k in range(count):
            if weight[k] > 0:
                f = face[first + k]
                red, green, blue = _colour(radiance, f, place[k], fx[k], fy[k])
                sums[k, b, 0] += weight[k] * red
                sums[k, b, 1] += weight[k] * green
                sums[k, b, 2] += weight[k] * blue


@loop
def light_batch(
    radiance: TextureArrays,
    lights: LightArrays,
    guide: Int,
    origin: Float,
    normal: Float,
    shifts: Double,
    points: Double,
    start: int,
    stop: int,
) -> tuple[Int, Float, Float, Float, Float]:
    """Rays to points on the lights, those that face their receiver only: their numbers r, origins,
    directions, distances, and what each brings if nothing is in between, (A, 3).

    The density counts the points that face the receiver only, in both techniques alike.
    guide: ``Lights.cumulative`` at even steps, so that picking is a look-up.
    """
    light_face, cumulative, light_density, corners, face_normals = lights
    count = len(normal)
    total = count * (stop - start)
    number = np.empty(total, np.int32)
    origins = np.empty((total, 3), np.float32)
    directions = np.empty((total, 3), np.float32)
    distances = np.empty(total, np.float32)
    brought = np.empty((total, 3), np.float32)
    pick, u1, u2 = np.empty(count), np.empty(count), np.empty(count)
    used = 0
    for sample in range(start, stop):
        fractions(points[sample, 2], shifts[2], pick)
        fractions(points[sample, 3], shifts[3], u1)
        fractions(points[sample, 4], shifts[4], u2)
        in_triangle(u1, u2)
        for k in range(count):
            f = light_face[_picked(cumulative, guide, pick[k])]
            u, v = u1[k], u2[k]
            w = 1 - u - v
            p = corners[f]
            x = w * p[0, 0] + u * p[1, 0] + v * p[2, 0] - origin[k, 0]
            y = w * p[0, 1] + u * p[1, 1] + v * p[2, 1] - origin[k, 1]
            z = w * p[0, 2] + u * p[1, 2] + v * p[2, 2] - origin[k, 2]
            square = x * x + y * y + z * z
            m = face_normals[f]
            # Both cosines, times the distance.
            cosine = x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2]
            facing = -(x * m[0] + y * m[1] + z * m[2])
            if square < 1e-18 or cosine <= 0 or facing <= 0:
                continue
            both = cosine * facing
            weight = both / (both / np.pi + light_density[f] * square * square)
            distance = math.sqrt(square)
            inverse = 1 / distance
            place, fx, fy = texture_place(radiance, f, u, v)
            red, green, blue = _colour(radiance, f, place, fx, fy)
            number[used] = (sample - start) * count + k
            for c in range(3):
                origins[used, c] = origin[k, c]
            directions[used, 0] = x * inverse
            directions[used, 1] = y * inverse
            directions[used, 2] = z * inverse
            distances[used] = distance * 0.9999
            brought[used, 0] = weight * red
            brought[used, 1] = weight * green
            brought[used, 2] = weight * blue
            used += 1
    return number[:used], origins[:used], directions[:used], distances[:used], brought[:used]


@loop
def _picked(cumulative: Double, guide: Int, pick: float) -> int:
    """The first light whose cumulative probability exceeds ``pick``."""
    last = len(cumulative) - 1
    which: int = guide[min(int(pick * len(guide)), len(guide) - 1)]
    while which > 0 and cumulative[which - 1] > pick:
        which -= 1
    while which < last and cumulative[which] <= pick:
        which += 1
    return which


@loop
def add_light_batch(number: Int, brought: Float, blocked: Bool, block: Long, sums: Double) -> None:
    """sums += what the rays to the lights bring, where nothing is in between."""
    count = len(sums)
    for i in range(len(number)):
        if not blocked[i]:
            b, k = block[number[i] // count], number[i] % count
            sums[k, b, 0] += brought[i, 0]
            sums[k, b, 1] += brought[i, 1]
            sums[k, b, 2] += brought[i, 2]


@loop
def mean_and_error(sums: Double, samples: int) -> tuple[Double, Double]:
    """Mean of ``samples`` in all, and its standard error from the four blocks, (P, 3) each; sums
    (2, P, 4, 3), one for each technique."""
    count = sums.shape[1]
    mean, error = np.empty((count, 3)), np.empty((count, 3))
    block = np.empty(4)
    for k in range(count):
        for c in range(3):
            for b in range(4):
                block[b] = (sums[0, k, b, c] + sums[1, k, b, c]) * (4 / samples)
            centre = (block[0] + block[1] + block[2] + block[3]) / 4
            square = 0.0
            for b in range(4):
                square += (block[b] - centre) ** 2
            mean[k, c], error[k, c] = centre, math.sqrt(square / 12)
    return mean, error
