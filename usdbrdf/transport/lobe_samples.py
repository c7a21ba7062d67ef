"""Incident light around each point, traced once and reused for every roughness: the directions,
their weights, and sums for roughnesses, as compiled loops."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import numpy as np
from numba import prange

from usdbrdf.kernel import kernel, loop, parallel_kernel
from usdbrdf.model.arrays import Bits, Double, Float, Int, Long
from usdbrdf.transport.brdf import (
    F0_OF_PSI,
    alpha_of_phi,
    grazing,
    half_vector,
    masking,
    reflected_density,
    sample_half_vector,
)
from usdbrdf.transport.environment import Environment, EnvironmentArrays, environment_at
from usdbrdf.transport.light_groups import GroupArrays, picked
from usdbrdf.transport.lights import Lights
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints
from usdbrdf.transport.rays import RayScene, lift_from_surface
from usdbrdf.transport.surface_texture import SurfaceTexture
from usdbrdf.transport.warps import (
    cosine_direction,
    hashed_uniform,
    sobol_bits,
    tangent_frame,
    triangle_point,
)

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


Basis = Callable[[Sequence[float]], tuple[Float, Float]]

LOBE_ALPHAS = np.array([0.002, 0.01, 0.05, 0.15, 0.4])

_LANES = 8


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

    @property
    def arrays(self) -> SampleArrays:
        """What the kernels take, besides ``weighted``."""
        return self.cos_in, self.sin2_half, self.grazing, self.cos_out


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """How many of a point's samples each technique draws: per lobe width, towards the lights, and
    cosine-distributed."""

    per_lobe: int = 8
    lights: int = 8
    cosine: int = 4


def trace_lobe_samples(
    rays: RayScene,
    points: SurfacePoints,
    radiance: SurfaceTexture,
    lights: Lights,
    environment: Environment,
    mixture: Mixture,
    scene_size: float,
    seed: int,
    stream: Long | None = None,
    alphas: Double | None = None,
    group: int = 1,
) -> LobeSamples:
    """Trace the mixture at R surface points; all of ``points`` must lie on the surface.

    group          this many consecutive points divide each technique's Sobol points among them, so
                   that their mean has a smaller error
    stream (G,)    groups of the same number share their random numbers; default: none do
    alphas (R, A)  the lobes' widths; default: LOBE_ALPHAS at every point, for any roughness
    """
    if not len(lights.face):
        mixture = Mixture(
            per_lobe=mixture.per_lobe, lights=0, cosine=mixture.cosine + mixture.lights
        )
    count = len(points.face)
    if alphas is None:
        alphas = np.broadcast_to(LOBE_ALPHAS, (count, len(LOBE_ALPHAS)))
    total = mixture.per_lobe * alphas.shape[1] + mixture.lights + mixture.cosine
    origin = lift_from_surface(points.position, points.normal, scene_size)
    counts = mixture.per_lobe, mixture.lights
    sobol = sobol_bits(int(np.ceil(np.log2(group * max(*counts, mixture.cosine)))))
    numbers = np.arange(count // group) if stream is None else stream
    directions = np.zeros((count * total, 3), np.float32)
    chosen = np.full((count, total), -1, np.int32)
    draw_directions(
        points.normal, points.to_camera, origin, (sobol, numbers, seed), counts, alphas,
        lights.groups.arrays, directions.reshape(count, total, 3), chosen,
    )  # fmt: skip
    hits = rays.closest(np.repeat(origin, total, axis=0), directions)
    samples = LobeSamples(
        cos_in=np.zeros((count, total), np.float32),
        sin2_half=np.zeros((count, total), np.float32),
        grazing=np.zeros((count, total), np.float32),
        weighted=radiance.at(hits.face, hits.u, hits.v).reshape(count, total, 3),
        cos_out=np.einsum("rd,rd->r", points.normal, points.to_camera),
    )
    weigh(
        points.normal, points.to_camera, directions.reshape(count, total, 3), chosen,
        (hits.face.reshape(count, total), hits.distance.reshape(count, total)), counts,
        alphas, lights.groups.arrays, environment.arrays, samples.weighted, samples.arrays,
    )  # fmt: skip
    return samples


def lobe_basis(
    lit: LitScene,
    points: SurfacePoints,
    num_groups: int,
    seed: int,
    mixture: Mixture = Mixture(),
    stream: Long | None = None,
) -> Basis:
    """Roughnesses (Q,) -> (base, slope) of I_nd = base + psi * slope, (num_groups, 3, Q) each: the
    mean over equally many consecutive ``points`` per group. Rays are traced once, when they
    are first needed."""

    @cache
    def samples() -> LobeSamples:
        return trace_lobe_samples(
            lit.rays, points, lit.radiance, lit.lights, lit.environment, mixture, lit.size, seed,
            stream, group=len(points.face) // max(num_groups, 1),
        )  # fmt: skip

    def basis(phis: Sequence[float]) -> tuple[Float, Float]:
        # As many as vector instructions take at once.
        padded = np.zeros(-(-len(phis) // _LANES) * _LANES, np.float32)
        padded[: len(phis)] = phis
        base, slope = non_diffuse(samples(), np.tile(padded, (num_groups, 1)))
        return base[..., : len(phis)], slope[..., : len(phis)]

    return basis


def non_diffuse(samples: LobeSamples, phis: Float) -> tuple[Float, Float]:
    """I_nd = base + psi * slope, (G, 3, Q) float32 each, means over each of G groups of consecutive
    points, for its roughnesses phis (G, Q)."""
    base = np.zeros((len(phis), 3, phis.shape[1]), np.float32)
    slope = np.zeros_like(base)
    integrate(samples.arrays, samples.weighted, phis, base, slope)
    return base, slope
