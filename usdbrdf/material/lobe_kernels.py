"""The compiled loops behind ``lobe_samples``: directions, their weights, and sums for roughnesses.

R surface points have K samples each; the techniques follow each other in K: ``per_lobe`` for each
lobe width in turn, ``num_lights`` points on the lights, the rest cosine-distributed.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf.kernel import kernel, loop, parallel_kernel
from usdbrdf.material.lobe import (
    F0_OF_PSI,
    alpha_of_phi,
    grazing,
    half_vector,
    masking,
    reflected_density,
    sample_half_vector,
)
from usdbrdf.shading.environment import EnvironmentArrays, environment_at
from usdbrdf.shading.light_groups import GroupArrays, picked
from usdbrdf.shading.warps import cosine_direction, hashed_uniform, tangent_frame, triangle_point

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]
Bits = npt.NDArray[np.uint32]

Three: TypeAlias = tuple[float, float, float]
Six: TypeAlias = tuple[float, float, float, float, float, float]
# cos_in, sin2_half, grazing, (R, K) each, and cos_out (R,): see LobeSamples.
SampleArrays: TypeAlias = tuple[Float, Float, Float, Float]


@parallel_kernel
def draw_directions(
    normal: Float,
    to_camera: Float,
    origin: Float,
    draws: tuple[Bits, Long, int],
    counts: tuple[int, int],
    alphas: Double,
    lights: GroupArrays,
    directions: Float,
    chosen: Int,
) -> None:
    """Directions of every technique in turn, with lobe widths ``alphas`` (R, A); ``chosen`` keeps
    the light triangle that a direction was sent to (-1 for the others).

    draws: Sobol points (N, 2), numbers of the groups (G,) of equally many points, and the seed.
    With each technique a group's points use one after the other's part of the same Sobol points.
    """
    sobol, numbers, seed = draws
    per_lobe, num_lights = counts
    widths, group = alphas.shape[1], len(normal) // len(numbers)
    first_cosine = widths * per_lobe + num_lights
    for r in prange(len(normal)):
        number, place = numbers[r // group], r % group
        frame = tangent_frame(normal[r])
        for a in range(widths):
            flips = _flips(seed, number, a)
            for i in range(per_lobe):
                u1, u2 = _drawn(sobol, place * per_lobe + i, flips)
                half = _in_world(frame, normal[r], sample_half_vector(u1, u2, alphas[r, a]))
                _reflect(half, to_camera[r], directions[r, a * per_lobe + i])
        flips = _flips(seed, number, widths)
        turn = hashed_uniform(seed, number, 15)
        for i in range(num_lights):
            k, j = widths * per_lobe + i, i * group + place
            pick = (turn + j / (group * num_lights)) % 1.0
            chosen[r, k] = _aim(lights, pick, _drawn(sobol, j, flips), origin[r], directions[r, k])
        flips = _flips(seed, number, widths + 1)
        for k in range(first_cosine, directions.shape[1]):
            j = place * (directions.shape[1] - first_cosine) + k - first_cosine
            u1, u2 = _drawn(sobol, j, flips)
            w = _in_world(frame, normal[r], cosine_direction(u1, u2))
            directions[r, k, 0], directions[r, k, 1], directions[r, k, 2] = w


@kernel
def _flips(seed: int, number: int, technique: int) -> tuple[np.uint32, np.uint32]:
    """The random bits that a group's Sobol points of a technique are combined with."""
    return (
        np.uint32(hashed_uniform(seed, number, 16 + 2 * technique) * 2.0**32),
        np.uint32(hashed_uniform(seed, number, 17 + 2 * technique) * 2.0**32),
    )


@kernel
def _drawn(sobol: Bits, i: int, flips: tuple[np.uint32, np.uint32]) -> tuple[float, float]:
    """The i-th point in the unit square."""
    return (sobol[i, 0] ^ flips[0]) * 2.0**-32, (sobol[i, 1] ^ flips[1]) * 2.0**-32


@kernel
def _in_world(frame: Six, n: Float, d: Three) -> Three:
    """The direction d about +z, about the normal n instead."""
    tx, ty, tz, bx, by, bz = frame
    return (
        d[0] * tx + d[1] * bx + d[2] * n[0],
        d[0] * ty + d[1] * by + d[2] * n[1],
        d[0] * tz + d[1] * bz + d[2] * n[2],
    )


@kernel
def _reflect(half: Three, wo: Float, direction: Float) -> None:
    along = 2 * (half[0] * wo[0] + half[1] * wo[1] + half[2] * wo[2])
    for c in range(3):
        direction[c] = along * half[c] - wo[c]


@kernel
def _aim(
    lights: GroupArrays, pick: float, u: tuple[float, float], origin: Float, direction: Float
) -> int:
    """The direction to a point on the lights, and the triangle that this is on."""
    face, cumulative, guide, _, _, triangles, _ = lights
    which = picked(cumulative, guide, pick)
    v1, v2 = triangle_point(u[0], u[1])
    p = triangles[which]
    x = p[0] + v1 * p[3] + v2 * p[6] - origin[0]
    y = p[1] + v1 * p[4] + v2 * p[7] - origin[1]
    z = p[2] + v1 * p[5] + v2 * p[8] - origin[2]
    length = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    direction[0], direction[1], direction[2] = x / length, y / length, z / length
    return int(face[which])


@parallel_kernel
def weigh(
    normal: Float,
    to_camera: Float,
    directions: Float,
    chosen: Int,
    hits: tuple[Int, Float],
    counts: tuple[int, int],
    alphas: Double,
    lights: GroupArrays,
    environment: EnvironmentArrays,
    incident: Float,
    samples: SampleArrays,
) -> None:
    """Turn incident radiance (R, K, 3), in place, into L cos / (sum of all densities)."""
    face, distance = hits
    per_lobe, num_lights = counts
    _, _, _, _, light_of_face, triangles, is_light = lights
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
            if f >= 0 and num_lights > 0 and is_light[f >> 3] >> (f & 7) & 1:
                t = triangles[light_of_face[f]]
                facing = -(w[0] * t[9] + w[1] * t[10] + w[2] * t[11])
                if facing > 0:
                    light = t[12] * distance[r, k] * distance[r, k] / facing
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
    """base, slope (G, 3, Q) += light times G D x, 0.08 G D (1 - x), summed over samples, means of
    each group of consecutive points, with the group's roughnesses phis (G, Q)."""
    cos_in, sin2_half, graze, cos_out = samples
    group = len(cos_out) // len(phis)
    for g in prange(len(phis)):
        for r in range(g * group, (g + 1) * group):
            if cos_out[r] > 0:
                _add_point(
                    (cos_in[r], sin2_half[r], graze[r]), weighted[r], cos_out[r], phis[g],
                    1.0 / group, base[g], slope[g],
                )  # fmt: skip


@loop
def _add_point(
    samples: tuple[Float, Float, Float],
    weighted: Float,
    cos_out: float,
    phis: Float,
    share: float,
    base: Float,
    slope: Float,
) -> None:
    """``distribution`` and ``masking`` of lobe.py, in single precision and for all roughnesses side
    by side, as vector instructions want it."""
    cos_in, sin2_half, graze = samples
    one, count = np.float32(1), len(phis)
    alpha2, y2, scale = np.empty_like(phis), np.empty_like(phis), np.empty_like(phis)
    for q in range(count):
        alpha2[q] = alpha_of_phi(phis[q]) ** 2
        y2[q] = (0.5 * phis[q] + 0.5) ** 4
        scale[q] = share * masking(cos_out, phis[q]) * alpha2[q] / np.pi
    dg = np.empty_like(phis)
    for k in range(len(cos_in)):
        x, s2 = cos_in[k], sin2_half[k]
        if x <= 0:
            continue
        x2, c2 = x * x, one - s2
        for q in range(count):
            below = s2 + alpha2[q] * c2
            dg[q] = scale[q] / (below * below * (x + np.sqrt(x2 + y2[q] * (one - x2))))
        for c in range(3):
            of_base = graze[k] * weighted[k, c]
            of_slope = np.float32(F0_OF_PSI) * (weighted[k, c] - of_base)
            for q in range(count):
                base[c, q] += dg[q] * of_base
            for q in range(count):
                slope[c, q] += dg[q] * of_slope
