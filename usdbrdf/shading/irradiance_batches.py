"""The compiled loops of the irradiance estimator: rays to trace, and what they brought.

They run on one thread, mostly in single precision, and let go of Python's lock, so that each thread
takes points of its own through generating, tracing and adding up while the rays are still in its
cache. P points take samples ``start`` to ``stop``; ray r = (sample - start) * P + point, so that
rays of one sample, which are nearly parallel within a patch, follow each other. Rays to lights are
in ``light_batches``.

Sums are kept in four blocks of samples, (4, P, 3), so that the estimator can tell its own error,
and apart for the two techniques: each then adds up in the order of its samples, however many of
them a batch has.
"""

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
    fetch_face,
    look_at,
    unsigned,
)
from usdbrdf.kernel import loop
from usdbrdf.shading.environment import EnvironmentArrays, environment_at
from usdbrdf.shading.light_batches import PickArrays, PointDraws
from usdbrdf.shading.lights import LightArrays
from usdbrdf.shading.warp_loops import fractions, on_hemisphere
from usdbrdf.shading.warps import hashed_uniform, tangent_frame

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]

# face, u, v, distance of the first surfaces, (R,) each.
HitArrays: TypeAlias = tuple[Int, Float, Float, Float]

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
    of_face, is_light, row, ratio = picks[0][4], picks[0][6], picks[1], picks[4]
    use_lights = len(ratio) > 0
    face, u, v, distance = hits
    count = len(normal)
    weight, looks = np.empty(AHEAD, np.float32), empty_looks()
    for s in range(len(block)):
        total = sums[block[s]]
        for first in range(0, count, AHEAD):
            # In three passes, so that what they wait for from memory is under way before it is
            # read.
            part = min(AHEAD, count - first)
            for i in range(part):
                fetch_face(radiance, max(face[unsigned(s * count + first + i)], 0))
            for i in range(part):
                k, r = unsigned(first + i), unsigned(s * count + first + i)
                f = face[r]
                weight[i] = _PI
                if f < 0:
                    f = 0
                    weight[i] = 0
                    escaped[k] += 1
                    x, y, z = directions[r, 0], directions[r, 1], directions[r, 2]
                    for c in range(3):
                        total[k, c] += np.pi * environment_at(image, z_up, x, y, z, c)
                elif use_lights and is_light[f >> 3] >> (f & 7) & 1:
                    m, n = face_normals[f], normal[k]
                    x, y, z = directions[r, 0], directions[r, 1], directions[r, 2]
                    facing = -(x * m[0] + y * m[1] + z * m[2])
                    cosine = max(x * n[0] + y * n[1] + z * n[2], _TINY)
                    if facing > 0:
                        density = light_density[f] * ratio[row[k], of_face[f]]
                        square = distance[r] * distance[r]
                        weight[i] = cosine / (cosine * _INVERSE_PI + density * square / facing)
                look_at(radiance, looks, i, f, u[r], v[r])
            for i in range(part):
                red, green, blue = colour_looked_at(radiance, looks, i)
                k = unsigned(first + i)
                total[k, 0] += weight[i] * red
                total[k, 1] += weight[i] * green
                total[k, 2] += weight[i] * blue


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
