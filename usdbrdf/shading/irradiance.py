"""Irradiance S(x) = integral of L cos over the hemisphere, W/m^2, by Monte-Carlo ray tracing.

L_d is the light: a ray that hits the surface brings the lit diffuse radiance found there (paper
eq. 10). Two estimators:

``cosine``  the paper's: independent cosine-distributed directions.
``mis``     as many cosine-distributed directions as points picked on the bright triangles, combined
            by the balance heuristic (E. Veach and L. Guibas, "Optimally combining sampling
            techniques for Monte Carlo rendering", 1995). Sobol points, shifted once per patch of
            8 x 8 texels: neighbouring texels trace nearly parallel rays, which Embree likes.

Both are unbiased for the piecewise bilinear L_d that they are given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf.geometry.rays import RayScene, lift_from_surface
from usdbrdf.geometry.surface_radiance import SurfaceTexture, texture_at
from usdbrdf.geometry.texels import Texels
from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.shading.environment import Environment, environment_at
from usdbrdf.shading.lights import Lights
from usdbrdf.shading.warps import (
    cosine_direction,
    hashed_uniform,
    patch_shifts,
    sobol_points,
    tangent_frame,
    triangle_point,
)

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]

_BLOCKS = 4
_FIRST_ROUND = 64
# Rays per call of Embree: long enough to feed all threads, short enough to stay in memory.
_BATCH = 1 << 19


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How S is estimated.

    estimator       "mis" or "cosine"
    standard_error  "mis" doubles a patch's rays until its relative standard error is below this
    max_rays        per texel; "cosine" traces exactly this many
    seed            of the random shifts
    """

    estimator: Literal["mis", "cosine"] = "mis"
    standard_error: float = 0.02
    max_rays: int = 1024
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Irradiance:
    """S and what is known about it, per texel.

    mean (T, 3) float32, W/m^2; standard_error (T, 3) float32, absolute, from four sub-sequences
    (an upper estimate for Sobol points); rays (T,) int32; escaped (T,) float32, the share of the
    cosine-weighted hemisphere that sees no surface
    """

    mean: Float
    standard_error: Float
    rays: Int
    escaped: Float


def patches_of_texels(texels: Texels) -> tuple[npt.NDArray[np.int64], Int]:
    """Texels in the order of 8 x 8 blocks of their atlas: order (T,), and the patch of each
    texel in that order, (T,) int32 ascending from 0."""
    owner = texels.object_index()
    local = texels.pixel - texels.first_pixel[owner]
    width = texels.resolution[owner, 0]
    x, y = local % width, local // width
    order = np.lexsort((x % 8, y % 8, x // 8, y // 8, owner))
    key = np.stack([owner, y // 8, x // 8], axis=-1)[order]
    patch = np.concatenate([[0], np.cumsum((np.diff(key, axis=0) != 0).any(axis=1))])
    return order, patch.astype(np.int32)


def irradiance_at(
    rays: RayScene,
    radiance: SurfaceTexture,
    lights: Lights,
    environment: Environment,
    position: Float,
    normal: Float,
    patch: Int,
    sampling: Sampling,
    scene_size: float,
) -> Irradiance:
    """S at N surface points.

    position, normal (N, 3) float32, world; patch (N,) int32 ascending: points of one patch share
    their random shift and their stopping. scene_size: metres, for the lift off the surface.
    """
    count = len(position)
    origin = lift_from_surface(position, normal, scene_size)
    sums = np.zeros((count, _BLOCKS, 3))
    escaped = np.zeros(count)
    done = np.zeros(count, np.int64)
    active = np.arange(count)
    pairs = 1 if sampling.estimator == "cosine" or not len(lights.face) else 2
    techniques = _Techniques(rays, radiance, lights, environment, sampling, pairs)
    if sampling.estimator == "cosine":
        rounds = [(0, sampling.max_rays)]
    else:
        ends = [0, _FIRST_ROUND // pairs]
        while 2 * ends[-1] * pairs <= sampling.max_rays:
            ends.append(2 * ends[-1])
        rounds = list(zip(ends[:-1], ends[1:], strict=True))
    for first, last in rounds:
        if first:
            sums[active, 0] = sums[active, 0] + sums[active, 1]
            sums[active, 1] = sums[active, 2] + sums[active, 3]
            sums[active, 2:] = 0
        block_sums = sums[active]
        block_escaped = escaped[active]
        techniques.run(
            origin[active], normal[active], patch[active], active, first, last,
            block_sums, block_escaped,
        )  # fmt: skip
        sums[active], escaped[active], done[active] = block_sums, block_escaped, last
        error = _standard_error(sums[active], last)
        active = active[_noisy(patch[active], sums[active], error, last, sampling.standard_error)]
        if not len(active):
            break
    mean = sums.sum(axis=1) / done[:, None]
    return Irradiance(
        mean=mean.astype(np.float32),
        standard_error=_standard_error(sums, done[:, None]).astype(np.float32),
        rays=(done * pairs).astype(np.int32),
        escaped=(escaped / done).astype(np.float32),
    )


def _standard_error(sums: Double, samples: Any) -> Double:
    """Standard error (N, 3) of the mean of four blocks' sums (N, 4, 3) of ``samples`` in all."""
    means = sums * (_BLOCKS / np.asarray(samples, np.float64)[..., None])
    return np.asarray(means.std(axis=1, ddof=1) / np.sqrt(_BLOCKS))


def _noisy(patch: Int, sums: Double, error: Double, samples: int, target: float) -> Any:
    """(N,) bool: does the point's patch still miss the target relative standard error?"""
    index = patch - patch[0]
    points = np.maximum(np.bincount(index), 1)
    mean = np.bincount(index, sums.sum(axis=(1, 2)) / (3 * samples)) / points
    square = np.bincount(index, (error**2).mean(axis=1)) / points
    return (np.sqrt(square) > target * np.maximum(mean, 1e-12))[index]


class _Techniques:
    """The two ray generators and their sums, with what they share for all points."""

    def __init__(
        self,
        rays: RayScene,
        radiance: SurfaceTexture,
        lights: Lights,
        environment: Environment,
        sampling: Sampling,
        pairs: int,
    ) -> None:
        self.rays = rays
        self.radiance = radiance
        self.lights = lights
        self.environment = environment
        self.sampling = sampling
        self.use_lights = pairs == 2
        random = sampling.estimator == "cosine"
        log2_count = 0 if random else int(np.ceil(np.log2(max(sampling.max_rays, 2))))
        self.points = np.zeros((0, 5)) if random else sobol_points(log2_count, 5)

    def run(
        self,
        origin: Float,
        normal: Float,
        patch: Int,
        identity: npt.NDArray[np.int64],
        first: int,
        last: int,
        sums: Double,
        escaped: Double,
    ) -> None:
        """Trace samples first..last of each point and add them to sums (N, 4, 3) and escaped (N,)."""
        low, high = int(patch.min()), int(patch.max())
        # The shift belongs to the patch's number, so a tile draws the shifts of its own patches.
        shift = np.concatenate([
            patch_shifts(1, 5, self.sampling.seed * 0x10000 + number)
            for number in range(low, high + 1)
        ])  # fmt: skip
        local = patch - low
        step = max(1, _BATCH // len(origin))
        for start in range(first, last, step):
            stop = min(start + step, last)
            block = _block_of(np.arange(start, stop), first, last)
            many = np.tile(origin, (stop - start, 1))
            shared = (normal, local, identity, self.points, shift, self.sampling.seed, start)
            directions = _cosine_rays(*shared, stop)
            hits = self.rays.closest(many, directions)
            _add_cosine(
                *self.radiance.arrays, self.lights.density, self.lights.normals,
                *self.environment.arrays, self.use_lights, directions, normal,
                hits.face, hits.u, hits.v, hits.distance, block, sums, escaped,
            )  # fmt: skip
            if self.use_lights:
                directions, distances, brought = _light_rays(
                    origin, *shared, stop, *self.lights.arrays, *self.radiance.arrays
                )
                blocked = self.rays.occluded(many, directions, distances)
                _add_light(brought, blocked, block, sums)


def _block_of(sample: npt.NDArray[np.int64], first: int, last: int) -> npt.NDArray[np.int64]:
    """The first round fills all four blocks; each later one the last two (the first two then hold
    what came before)."""
    if first == 0:
        return sample * _BLOCKS // last
    return 2 + (sample - first) * 2 // (last - first)


@kernel
def _unit_square(points, shift, seed, identity, patch, sample, dimension):  # type: ignore[no-untyped-def]
    """A shifted Sobol coordinate, or, without points, an independent random number."""
    if len(points) == 0:
        return hashed_uniform(seed, identity, sample * 2 + dimension)
    x = points[sample, dimension] + shift[patch, dimension]
    return x - np.floor(x)


@parallel_kernel
def _cosine_rays(normal, patch, identity, points, shift, seed, start, stop):  # type: ignore[no-untyped-def]
    count = len(normal)
    directions = np.zeros((count * (stop - start), 3), np.float32)
    for k in prange(count):
        tx, ty, tz, bx, by, bz = tangent_frame(normal[k])
        n = normal[k]
        for sample in range(start, stop):
            u1 = _unit_square(points, shift, seed, identity[k], patch[k], sample, 0)
            u2 = _unit_square(points, shift, seed, identity[k], patch[k], sample, 1)
            x, y, z = cosine_direction(u1, u2)
            r = (sample - start) * count + k
            directions[r, 0] = x * tx + y * bx + z * n[0]
            directions[r, 1] = x * ty + y * by + z * n[1]
            directions[r, 2] = x * tz + y * bz + z * n[2]
    return directions


@parallel_kernel
def _add_cosine(  # type: ignore[no-untyped-def]
    pixels, corner_pixel, first_pixel, size, light_density, face_normals,
    environment, z_up, use_lights, directions, normal,
    face, u, v, distance, block, sums, escaped,
):  # fmt: skip
    """sums += L cos / (p_cosine + p_light) for the cosine-distributed rays."""
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
                    light = environment_at(environment, z_up, d[0], d[1], d[2], c)
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
def _light_rays(  # type: ignore[no-untyped-def]
    origin, normal, patch, identity, points, shift, seed, start, stop,
    light_face, cumulative, light_density, corners, face_normals,
    pixels, corner_pixel, first_pixel, size,
):  # fmt: skip
    """Rays to points on the lights, and what each brings if nothing is in between.

    The density counts the points that face the receiver only, in both techniques alike.
    """
    count = len(normal)
    total = count * (stop - start)
    directions = np.zeros((total, 3), np.float32)
    distances = np.zeros(total, np.float32)
    brought = np.zeros((total, 3), np.float32)
    for k in prange(count):
        for sample in range(start, stop):
            r = (sample - start) * count + k
            directions[r, 2] = 1
            pick = _unit_square(points, shift, seed, identity[k], patch[k], sample, 2)
            u1 = _unit_square(points, shift, seed, identity[k], patch[k], sample, 3)
            u2 = _unit_square(points, shift, seed, identity[k], patch[k], sample, 4)
            which = min(np.searchsorted(cumulative, pick, side="right"), len(light_face) - 1)
            f = light_face[which]
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
def _add_light(brought, blocked, block, sums):  # type: ignore[no-untyped-def]
    count = len(sums)
    for k in prange(count):
        for s in range(len(block)):
            r = s * count + k
            if not blocked[r]:
                for c in range(3):
                    sums[k, block[s], c] += brought[r, c]
