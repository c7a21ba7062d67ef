"""The compiled loops behind ``lobe_samples``: directions, their weights, and sums for a roughness.

R surface points have K samples each; the techniques follow each other in K: ``per_lobe`` times all
lobe widths, ``num_lights`` points on the lights, the rest cosine-distributed.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numba import prange

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
from usdbrdf.shading.environment import EnvironmentArrays, environment_at
from usdbrdf.shading.lights import LightArrays
from usdbrdf.shading.warps import cosine_direction, tangent_frame, triangle_point

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]

# cos_in, sin2_half, grazing, (R, K) each, and cos_out (R,): see LobeSamples.
SampleArrays: TypeAlias = tuple[Float, Float, Float, Float]


@parallel_kernel
def draw_directions(
    normal: Float,
    to_camera: Float,
    origin: Float,
    draws: tuple[Double, Double],
    counts: tuple[int, int],
    alphas: Double,
    lights: LightArrays,
    directions: Float,
    chosen: Int,
) -> None:
    """Directions of every technique in turn, with lobe widths ``alphas`` (R, A); ``chosen`` keeps
    the light triangle that a direction was sent to (-1 for the others)."""
    sequence, shift = draws
    per_lobe, num_lights = counts
    light_face, cumulative, _, corners, _ = lights
    lobes = alphas.shape[1] * per_lobe
    for r in prange(len(normal)):
        n = normal[r]
        wo = to_camera[r]
        tx, ty, tz, bx, by, bz = tangent_frame(n)
        for k in range(directions.shape[1]):
            u1 = (sequence[k, 0] + shift[r, 0]) % 1.0
            u2 = (sequence[k, 1] + shift[r, 1]) % 1.0
            if k < lobes:
                # The techniques take turns, so each sees an evenly spread part of the sequence.
                hx, hy, hz = sample_half_vector(u1, u2, alphas[r, k % alphas.shape[1]])
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
def weigh(
    normal: Float,
    to_camera: Float,
    directions: Float,
    chosen: Int,
    hits: tuple[Int, Float],
    counts: tuple[int, int],
    alphas: Double,
    lights: LightArrays,
    environment: EnvironmentArrays,
    incident: Float,
    samples: SampleArrays,
) -> None:
    """Turn incident radiance (R, K, 3), in place, into L cos / (sum of all densities)."""
    face, distance = hits
    per_lobe, num_lights = counts
    _, _, light_density, _, face_normals = lights
    image, z_up = environment
    cos_in, sin2_half, graze, _ = samples
    num_cosine = directions.shape[1] - per_lobe * alphas.shape[1] - num_lights
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
            for a in range(alphas.shape[1]):
                density += per_lobe * reflected_density(s2, cos_wh, alphas[r, a])
            cos_in[r, k] = cosine
            sin2_half[r, k] = s2
            graze[r, k] = grazing(cos_wh)
            for c in range(3):
                value = incident[r, k, c]
                if f < 0:
                    value = environment_at(image, z_up, w[0], w[1], w[2], c)
                incident[r, k, c] = value * cosine / density


@parallel_kernel
def integrate(
    samples: SampleArrays, weighted: Float, phis: Float, base: Float, slope: Float
) -> None:
    """base, slope (R, 3) += sums over the samples of light times G D x, 0.08 G D (1 - x), each
    point with its own roughness of ``phis`` (R,)."""
    cos_in, sin2_half, graze, cos_out = samples
    for r in prange(len(cos_out)):
        if cos_out[r] <= 0:
            continue
        phi = phis[r]
        alpha = alpha_of_phi(phi)
        out = masking(cos_out[r], phi)
        for k in range(cos_in.shape[1]):
            if cos_in[r, k] <= 0:
                continue
            dg = distribution(sin2_half[r, k], alpha) * masking(cos_in[r, k], phi) * out
            x = graze[r, k]
            for c in range(3):
                base[r, c] += dg * x * weighted[r, k, c]
                slope[r, c] += F0_OF_PSI * dg * (1.0 - x) * weighted[r, k, c]
