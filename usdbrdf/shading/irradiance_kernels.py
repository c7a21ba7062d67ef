"""The compiled loops of the irradiance estimator: rays to trace, and what they brought.

N points take samples ``start`` to ``stop``; ray r = (sample - start) * N + point. The sums are
kept in four blocks of samples, (N, 4, 3), so that the estimator can tell its own error.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf.geometry.surface_radiance import TextureArrays, texture_at
from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.shading.environment import EnvironmentArrays, environment_at
from usdbrdf.shading.lights import LightArrays
from usdbrdf.shading.warps import (
    cosine_direction,
    hashed_uniform,
    tangent_frame,
    triangle_point,
)

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

OWN_SHIFT = 1 / 8

# Where N points take their random numbers from: Sobol points (S, 5), or none of them for
# independent numbers; a shift per patch (P, 5); each point's patch (N,); seed; identity (N,).
Draws: TypeAlias = tuple[Double, Double, Int, int, Long]

# face, u, v, distance of the first surfaces, (R,) each.
HitArrays: TypeAlias = tuple[Int, Float, Float, Float]


@kernel
def _uniform(draws: Draws, point: int, sample: int, dimension: int) -> float:
    """A shifted Sobol coordinate, or, without points, an independent random number."""
    points, shift, patch, seed, identity = draws
    if len(points) == 0:
        return hashed_uniform(seed, identity[point], sample * 2 + dimension)
    # The point's own part of the shift is small: rays of a patch stay nearly parallel, while the
    # errors of its points differ and do not show as a block.
    own = hashed_uniform(seed, identity[point], dimension) * OWN_SHIFT
    x = points[sample, dimension] + shift[patch[point], dimension] + own
    fraction: float = x - np.floor(x)
    return fraction


@parallel_kernel
def cosine_rays(normal: Float, draws: Draws, start: int, stop: int) -> Float:
    """Cosine-distributed directions (R, 3) about the normals (N, 3)."""
    count = len(normal)
    directions = np.zeros((count * (stop - start), 3), np.float32)
    for k in prange(count):
        tx, ty, tz, bx, by, bz = tangent_frame(normal[k])
        n = normal[k]
        for sample in range(start, stop):
            u1 = _uniform(draws, k, sample, 0)
            u2 = _uniform(draws, k, sample, 1)
            x, y, z = cosine_direction(u1, u2)
            r = (sample - start) * count + k
            directions[r, 0] = x * tx + y * bx + z * n[0]
            directions[r, 1] = x * ty + y * by + z * n[1]
            directions[r, 2] = x * tz + y * bz + z * n[2]
    return directions


@parallel_kernel
def add_cosine_rays(
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
    block; escaped (N,) += 1 for each ray that met nothing."""
    pixels, corner_pixel, first_pixel, size = radiance
    image, z_up = environment
    _, _, light_density, _, face_normals = lights
    face, u, v, distance = hits
    count = len(normal)
    for k in prange(count):
        for s in range(len(block)):
            r = s * count + k
            d = directions[r]
            f = face[r]
            cosine = d[0] * normal[k, 0] + d[1] * normal[k, 1] + d[2] * normal[k, 2]
            if cosine <= 0:
                continue
            if f < 0:
                escaped[k] += 1
                for c in range(3):
                    light = environment_at(image, z_up, d[0], d[1], d[2], c)
                    sums[k, block[s], c] += np.pi * light
                continue
            density = cosine / np.pi
            if use_lights and light_density[f] > 0:
                m = face_normals[f]
                facing = -(d[0] * m[0] + d[1] * m[1] + d[2] * m[2])
                if facing > 0:
                    density += light_density[f] * distance[r] * distance[r] / facing
            for c in range(3):
                light = texture_at(pixels, corner_pixel, first_pixel, size, f, u[r], v[r], c)
                sums[k, block[s], c] += light * cosine / density


@parallel_kernel
def light_rays(
    radiance: TextureArrays,
    lights: LightArrays,
    origin: Float,
    normal: Float,
    draws: Draws,
    start: int,
    stop: int,
) -> tuple[Float, Float, Float]:
    """Rays to points on the lights: directions (R, 3), distances (R,), and what each brings if
    nothing is in between, (R, 3).

    The density counts the points that face the receiver only, in both techniques alike.
    """
    pixels, corner_pixel, first_pixel, size = radiance
    light_face, cumulative, light_density, corners, face_normals = lights
    count = len(normal)
    total = count * (stop - start)
    directions = np.zeros((total, 3), np.float32)
    distances = np.zeros(total, np.float32)
    brought = np.zeros((total, 3), np.float32)
    for k in prange(count):
        for sample in range(start, stop):
            r = (sample - start) * count + k
            directions[r, 2] = 1
            pick = _uniform(draws, k, sample, 2)
            u1 = _uniform(draws, k, sample, 3)
            u2 = _uniform(draws, k, sample, 4)
            which = np.searchsorted(cumulative, pick, side="right")
            f = light_face[min(int(which), len(light_face) - 1)]
            u, v = triangle_point(u1, u2)
            p = corners[f]
            x = (1 - u - v) * p[0, 0] + u * p[1, 0] + v * p[2, 0] - origin[k, 0]
            y = (1 - u - v) * p[0, 1] + u * p[1, 1] + v * p[2, 1] - origin[k, 1]
            z = (1 - u - v) * p[0, 2] + u * p[1, 2] + v * p[2, 2] - origin[k, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            if distance < 1e-9:
                continue
            x, y, z = x / distance, y / distance, z / distance
            cosine = x * normal[k, 0] + y * normal[k, 1] + z * normal[k, 2]
            m = face_normals[f]
            facing = -(x * m[0] + y * m[1] + z * m[2])
            if cosine <= 0 or facing <= 0:
                continue
            density = cosine / np.pi + light_density[f] * distance * distance / facing
            directions[r, 0], directions[r, 1], directions[r, 2] = x, y, z
            distances[r] = distance * 0.9999
            for c in range(3):
                light = texture_at(pixels, corner_pixel, first_pixel, size, f, u, v, c)
                brought[r, c] = light * cosine / density
    return directions, distances, brought


@parallel_kernel
def add_light_rays(brought: Float, blocked: Bool, block: Long, sums: Double) -> None:
    """sums += what the rays to the lights bring, where nothing is in between."""
    count = len(sums)
    for k in prange(count):
        for s in range(len(block)):
            r = s * count + k
            if not blocked[r]:
                for c in range(3):
                    sums[k, block[s], c] += brought[r, c]
