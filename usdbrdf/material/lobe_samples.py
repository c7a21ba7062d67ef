"""Incident light around each fitted pixel, traced once and reused for every roughness.

Directions come from a mixture: GGX lobes of five widths about the mirror direction, points on the
lights, and the cosine lobe; all combined by the balance heuristic over the whole mixture. So the
same samples integrate a mirror and a matte lobe, and the grid search is arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf.geometry.rays import RayScene, lift_from_surface
from usdbrdf.geometry.surface_radiance import SurfaceTexture
from usdbrdf.kernel import parallel_kernel
from usdbrdf.material.lobe import (
    F0_OF_PSI,
    alpha_of_phi,
    distribution,
    grazing,
    half_vector,
    masking,
    reflected_density,
    sample_half_vector,
)
from usdbrdf.material.target_frames import SurfacePoints
from usdbrdf.shading.environment import Environment, environment_at
from usdbrdf.shading.lights import Lights
from usdbrdf.shading.warps import (
    cosine_direction,
    patch_shifts,
    sobol_points,
    tangent_frame,
    triangle_point,
)

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]

LOBE_ALPHAS = np.array([0.002, 0.01, 0.05, 0.15, 0.4])


@dataclass(frozen=True, kw_only=True)
class LobeSamples:
    """K samples at each of R surface points.

    cos_in     (R, K) float32, n.w (0 where the sample brings nothing)
    sin2_half  (R, K) float32, sin^2 of the angle between n and h
    grazing    (R, K) float32, (1 - w.h)^5
    weighted   (R, K, 3) float32, L cos / (K density of the whole mixture)
    cos_out    (R,) float32, n.wo
    """

    cos_in: Float
    sin2_half: Float
    grazing: Float
    weighted: Float
    cos_out: Float


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """How many of a point's samples each technique draws."""

    per_lobe: int = 8
    lights: int = 8
    cosine: int = 4

    @property
    def total(self) -> int:
        return self.per_lobe * len(LOBE_ALPHAS) + self.lights + self.cosine


def trace_lobe_samples(
    rays: RayScene,
    points: SurfacePoints,
    radiance: SurfaceTexture,
    lights: Lights,
    environment: Environment,
    mixture: Mixture,
    scene_size: float,
    seed: int,
) -> LobeSamples:
    """Trace the mixture at R surface points; all of ``points`` must lie on the surface."""
    if not len(lights.face):
        mixture = Mixture(
            per_lobe=mixture.per_lobe, lights=0, cosine=mixture.cosine + mixture.lights
        )
    count, total = len(points.face), mixture.total
    origin = lift_from_surface(points.position, points.normal, scene_size)
    sequence = sobol_points(int(np.ceil(np.log2(total))), 2)
    shift = patch_shifts(count, 3, seed)
    directions = np.zeros((count * total, 3), np.float32)
    chosen = np.full((count, total), -1, np.int32)
    _draw(
        points.normal, points.to_camera, origin, sequence, shift, mixture.per_lobe, mixture.lights,
        LOBE_ALPHAS, *lights.arrays, directions.reshape(count, total, 3), chosen,
    )  # fmt: skip
    hits = rays.closest(np.repeat(origin, total, axis=0), directions)
    incident = radiance.at(hits.face, hits.u, hits.v).reshape(count, total, 3)
    cos_in, sin2_half, graze = (np.zeros((count, total), np.float32) for _ in range(3))
    _weigh(
        points.normal, points.to_camera, directions.reshape(count, total, 3), chosen,
        hits.face.reshape(count, total), hits.distance.reshape(count, total), lights.density,
        lights.normals, *environment.arrays, mixture.per_lobe, mixture.lights, LOBE_ALPHAS,
        incident, cos_in, sin2_half, graze,
    )  # fmt: skip
    return LobeSamples(
        cos_in=cos_in,
        sin2_half=sin2_half,
        grazing=graze,
        weighted=incident,
        cos_out=np.einsum("rd,rd->r", points.normal, points.to_camera),
    )


def non_diffuse(samples: LobeSamples, phi: float) -> tuple[Float, Float]:
    """I_nd = base + psi * slope of every point, (R, 3) float32 each, for one roughness."""
    base = np.zeros((len(samples.cos_out), 3), np.float32)
    slope = np.zeros_like(base)
    _integrate(
        samples.cos_in, samples.sin2_half, samples.grazing, samples.weighted, samples.cos_out,
        phi, base, slope,
    )  # fmt: skip
    return base, slope


@parallel_kernel
def _draw(  # type: ignore[no-untyped-def]
    normal, to_camera, origin, sequence, shift, per_lobe, num_lights, alphas,
    light_face, cumulative, light_density, corners, face_normals, directions, chosen,
):  # fmt: skip
    """Directions of every technique in turn; ``chosen`` keeps the light triangle that a direction
    was sent to (-1 for the others)."""
    lobes = len(alphas) * per_lobe
    for r in prange(len(normal)):
        n = normal[r]
        wo = to_camera[r]
        tx, ty, tz, bx, by, bz = tangent_frame(n)
        for k in range(directions.shape[1]):
            u1 = (sequence[k, 0] + shift[r, 0]) % 1.0
            u2 = (sequence[k, 1] + shift[r, 1]) % 1.0
            if k < lobes:
                # The techniques take turns, so each sees an evenly spread part of the sequence.
                hx, hy, hz = sample_half_vector(u1, u2, alphas[k % len(alphas)])
                x = hx * tx + hy * bx + hz * n[0]
                y = hx * ty + hy * by + hz * n[1]
                z = hx * tz + hy * bz + hz * n[2]
                along = 2 * (x * wo[0] + y * wo[1] + z * wo[2])
                x, y, z = along * x - wo[0], along * y - wo[1], along * z - wo[2]
            elif k < lobes + num_lights:
                pick = ((k - lobes + shift[r, 2]) / num_lights) % 1.0
                which = min(np.searchsorted(cumulative, pick, side="right"), len(light_face) - 1)
                f = light_face[which]
                u, v = triangle_point(u1, u2)
                p = corners[f]
                x = (1 - u - v) * p[0, 0] + u * p[1, 0] + v * p[2, 0] - origin[r, 0]
                y = (1 - u - v) * p[0, 1] + u * p[1, 1] + v * p[2, 1] - origin[r, 1]
                z = (1 - u - v) * p[0, 2] + u * p[1, 2] + v * p[2, 2] - origin[r, 2]
                length = max(np.sqrt(x * x + y * y + z * z), 1e-9)
                x, y, z = x / length, y / length, z / length
                chosen[r, k] = f
            else:
                dx, dy, dz = cosine_direction(u1, u2)
                x = dx * tx + dy * bx + dz * n[0]
                y = dx * ty + dy * by + dz * n[1]
                z = dx * tz + dy * bz + dz * n[2]
            directions[r, k, 0] = x
            directions[r, k, 1] = y
            directions[r, k, 2] = z


@parallel_kernel
def _weigh(  # type: ignore[no-untyped-def]
    normal, to_camera, directions, chosen, face, distance, light_density, face_normals,
    environment, z_up, per_lobe, num_lights, alphas, incident, cos_in, sin2_half, graze,
):  # fmt: skip
    """Turn incident radiance (R, K, 3), in place, into L cos / (sum of all techniques' densities)."""
    num_cosine = directions.shape[1] - per_lobe * len(alphas) - num_lights
    for r in prange(len(normal)):
        n = normal[r]
        for k in range(directions.shape[1]):
            w = directions[r, k]
            f = face[r, k]
            cosine = n[0] * w[0] + n[1] * w[1] + n[2] * w[2]
            light = 0.0
            if f >= 0 and num_lights > 0 and light_density[f] > 0:
                m = face_normals[f]
                facing = -(w[0] * m[0] + w[1] * m[1] + w[2] * m[2])
                if facing > 0:
                    light = light_density[f] * distance[r, k] * distance[r, k] / facing
            # A ray sent to a point on a light counts only if that is what it meets.
            missed = chosen[r, k] >= 0 and (light <= 0 or chosen[r, k] != f)
            if cosine <= 0 or missed:
                incident[r, k] = 0
                continue
            s2, cos_wh = half_vector(n, w, to_camera[r])
            density = num_cosine * cosine / np.pi + num_lights * light
            for a in alphas:
                density += per_lobe * reflected_density(s2, cos_wh, a)
            cos_in[r, k] = cosine
            sin2_half[r, k] = s2
            graze[r, k] = grazing(cos_wh)
            for c in range(3):
                value = incident[r, k, c]
                if f < 0:
                    value = environment_at(environment, z_up, w[0], w[1], w[2], c)
                incident[r, k, c] = value * cosine / density


@parallel_kernel
def _integrate(  # type: ignore[no-untyped-def]
    cos_in, sin2_half, graze, weighted, cos_out, phi, base, slope
):
    alpha = alpha_of_phi(phi)
    for r in prange(len(cos_out)):
        if cos_out[r] <= 0:
            continue
        out = masking(cos_out[r], phi)
        for k in range(cos_in.shape[1]):
            if cos_in[r, k] <= 0:
                continue
            dg = distribution(sin2_half[r, k], alpha) * masking(cos_in[r, k], phi) * out
            x = graze[r, k]
            for c in range(3):
                base[r, c] += dg * x * weighted[r, k, c]
                slope[r, c] += F0_OF_PSI * dg * (1.0 - x) * weighted[r, k, c]
