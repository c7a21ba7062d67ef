"""The specular light that lobes reflect: I_nd of the paper's image model (eq. 2) for roughnesses
that are tried, of known lobes to a camera, and to other surfaces: lamps mirrored in a floor light a
ceiling.

Incident light around each point is traced once and reused for every roughness: the directions,
their weights, and sums for roughnesses, as compiled loops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple, TypeAlias

import numpy as np

from usdbrdf.kernel import kernel, loop, parallel_kernel
from usdbrdf.model.arrays import Bits, Double, Float, Int, Long
from usdbrdf.transport.brdf import (
    BECKMANN,
    F0_OF_PSI,
    MIN_ALPHA,
    PAPER,
    alpha_of_phi,
    beckmann_distribution,
    beckmann_masking,
    clamped,
    half_vector,
    masking,
    reflectance,
    reflected_density,
    sample_half_vector,
    share_of_base,
    stretched,
    width_of_masking,
)
from usdbrdf.transport.environment import Environment, environment_at
from usdbrdf.transport.lights import DENSITY, LightGroups, facing, picked, way_to
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints, points_of_rays
from usdbrdf.transport.openings import opening_at
from usdbrdf.transport.rays import Hits, lift_from_surface
from usdbrdf.transport.sunlight import towards_sun
from usdbrdf.transport.warps import (
    cosine_direction,
    cosine_rays,
    hashed_uniform,
    shifts_of,
    sobol_bits,
    tangent_frame,
    triangle_point,
)

Three: TypeAlias = tuple[float, float, float]
Six: TypeAlias = tuple[float, float, float, float, float, float]
Basis: TypeAlias = Callable[[int, Sequence[float]], tuple[Float, Float]]
# Widths that the lobes' samples are drawn with, for any roughness.
LOBE_ALPHAS = np.array([0.002, 0.01, 0.05, 0.15, 0.4])
# Roughnesses that vector instructions take at once, and rays of points that are traced at once:
# what bounds the memory.
_LANES, _RAYS_AT_ONCE = 8, 1 << 20
_SUN_SEED = 0x50B  # random numbers of its own


class Mixture(NamedTuple):
    """How many of a point's samples each technique draws: per lobe width, towards the lights,
    cosine-distributed, and towards the sun: one where there is a sun, after all others."""

    per_lobe: int = 8
    lights: int = 8
    cosine: int = 4
    sun: int = 0


MIXTURE = Mixture()


class GroupDraws(NamedTuple):
    """Sobol points (N, 2), numbers of the points (R,), those of how many after each other are a
    ``group``, and the seed. With each technique a group's points use one after the other's part of
    the same Sobol points."""

    sobol: Bits
    number: Long
    group: int
    seed: int


class Aimed(NamedTuple):
    """Of R points: normals and directions to the camera (R, 3), lobe widths (R, A), directions
    (R, K, 3), zero where nothing that counts can come from, and the light's triangle that each was
    sent to (R, K), -1 for the others."""

    normal: Float
    to_camera: Float
    alphas: Double
    direction: Float
    chosen: Int


class LobeSamples(NamedTuple):
    """K samples at each of R surface points.

    cos_in     (R, K) float32, n.w (0 where the sample brings nothing)
    sin2_half  (R, K) float32, sin^2 of the angle between n and h
    cos_half   (R, K) float32, w.h, which Fresnel's term follows from
    weighted   (R, K, 3) float32, L cos / (K density of the whole mixture)
    cos_out    (R,) float32, n.wo
    """

    cos_in: Float
    sin2_half: Float
    cos_half: Float
    weighted: Float
    cos_out: Float


@parallel_kernel
def draw_directions(
    first: int, last: int, aimed: Aimed, origin: Float, draws: GroupDraws, mixture: Mixture,
    groups: LightGroups,
) -> None:  # fmt: skip
    """Directions of every technique in turn, and what they are sent to, into ``aimed``. One loop,
    for to hand all this to a function takes as long as what that does for a point."""
    for r in range(first, last):
        n, to_camera, directions = aimed.normal[r], aimed.to_camera[r], aimed.direction[r]
        sobol, seed, group = draws.sobol, draws.seed, draws.group
        number, place = draws.number[r] // group, draws.number[r] % group
        frame, widths, k = tangent_frame(n), aimed.alphas.shape[1], 0
        for a in range(widths):
            flips = _flips(seed, number, a)
            for i in range(mixture.per_lobe):
                u1, u2 = _drawn(sobol, place * mixture.per_lobe + i, flips)
                half = _in_world(frame, n, sample_half_vector(u1, u2, aimed.alphas[r, a]))
                _reflect(half, to_camera, directions[k])
                k += 1
        flips = _flips(seed, number, widths)
        turn = hashed_uniform(seed, number, 15)
        for i in range(mixture.lights):
            j = i * group + place
            pick = (turn + j / (group * mixture.lights)) % 1.0
            aimed.chosen[r, k] = _aim(
                groups, pick, _drawn(sobol, j, flips), origin[r], directions[k]
            )
            k += 1
        flips = _flips(seed, number, widths + 1)
        for i in range(mixture.cosine):
            u1, u2 = _drawn(sobol, place * mixture.cosine + i, flips)
            w = _in_world(frame, n, cosine_direction(u1, u2))
            directions[k, 0], directions[k, 1], directions[k, 2] = w
            k += 1
        for i in range(k):  # neither from below the surface, nor from the back of a light
            x, y, z, face = directions[i, 0], directions[i, 1], directions[i, 2], aimed.chosen[r, i]
            lost = n[0] * x + n[1] * y + n[2] * z <= 0
            if face >= 0 and not lost:
                lost = facing(groups.triangles[groups.of_face[face]], x, y, z) <= 0
            if lost:
                directions[i, 0], directions[i, 1], directions[i, 2] = 0, 0, 0


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
    groups: LightGroups, pick: float, u: tuple[float, float], origin: Float, direction: Float
) -> int:
    """The direction to a point on the lights, and the triangle that this is on."""
    which = picked(groups.cumulative, groups.guide, pick)
    v1, v2 = triangle_point(u[0], u[1])
    x, y, z = way_to(groups.triangles[which], v1, v2, origin[0], origin[1], origin[2])
    length = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    direction[0], direction[1], direction[2] = x / length, y / length, z / length
    return int(groups.face[which])


@parallel_kernel
def weigh(
    first: int,
    last: int,
    aimed: Aimed,
    origin: Float,
    hits: Hits,
    mixture: Mixture,
    groups: LightGroups,
    environment: Environment,
    samples: LobeSamples,
) -> None:
    """Turn incident radiance ``weighted``, in place, into L cos / (sum of all densities). hits:
    first surfaces along the (R, K) directions from ``origin`` (R, 3)."""
    for r in range(first, last):
        n, alphas, weighted, x = aimed.normal[r], aimed.alphas[r], samples.weighted[r], origin[r]
        for k in range(len(weighted)):
            w = aimed.direction[r, k]
            f, distance = int(hits.face[r, k]), float(hits.distance[r, k])
            cosine = n[0] * w[0] + n[1] * w[1] + n[2] * w[2]
            light, of_sun = 0.0, k >= len(weighted) - mixture.sun
            met = f
            if f < 0 and cosine > 0 and groups.box[2, 0] > 0:
                opening, distance = opening_at(groups.box, x[0], x[1], x[2], w[0], w[1], w[2])
                met = groups.first_opening + opening
            if met >= 0 and mixture.lights > 0 and groups.is_light[met >> 3] >> (met & 7) & 1:
                triangle = groups.triangles[groups.of_face[met]]
                sent = facing(triangle, w[0], w[1], w[2])
                if sent > 0:
                    light = triangle[DENSITY] * distance * distance / sent
            # A ray sent to a point on a light counts only if that is what it meets.
            missed = aimed.chosen[r, k] >= 0 and (light <= 0 or aimed.chosen[r, k] != met)
            if cosine <= 0 or missed or (of_sun and f >= 0):
                weighted[k] = 0
                continue
            s2, cos_wh = half_vector(n, w, aimed.to_camera[r])
            density = mixture.cosine * cosine / np.pi + mixture.lights * light
            for a in range(len(alphas)):
                density += mixture.per_lobe * reflected_density(s2, cos_wh, alphas[a])
            samples.cos_in[r, k] = cosine
            samples.sin2_half[r, k] = s2
            samples.cos_half[r, k] = clamped(cos_wh)
            for c in range(3):
                value = weighted[k, c]
                if of_sun:  # which only this sample looks for: its irradiance is L over the density
                    weighted[k, c] = environment.sun_irradiance[c] * cosine
                    continue
                if f < 0:
                    value = environment_at(environment, w[0], w[1], w[2], c)
                weighted[k, c] = value * cosine / density


@parallel_kernel
def integrate(
    first: int, last: int, samples: LobeSamples, phis: Float, kind: int, base: Float, slope: Float
) -> None:
    """base, slope (G, 3, Q) += light times G D F of psi = 0, and of what psi adds, summed over
    samples, means of each group of consecutive points, with the group's roughnesses phis (G, Q)."""
    group = len(samples.cos_out) // len(phis)
    # Allocated here: to do so for each point takes longer than most of what is added there.
    of_lobes = np.empty((4, phis.shape[1]), np.float32)
    of_angles = np.empty((2, samples.cos_in.shape[1]))
    for g in range(first, last):
        for r in range(g * group, (g + 1) * group):
            if samples.cos_out[r] > 0:
                _add_point(
                    samples, r, phis[g], kind, 1.0 / group, base[g], slope[g], of_lobes, of_angles
                )


@loop
def _add_point(
    samples: LobeSamples,
    r: int,
    phis: Float,
    kind: int,
    share: float,
    base: Float,
    slope: Float,
    of_lobes: Float,
    of_angles: Double,
) -> None:
    """Those of point ``r``, times ``share``: D and G1 in single precision and for all roughnesses
    side by side, as vector instructions want it; F for all samples. of_lobes (4, Q) and of_angles
    (2, K) are room for what is computed once."""
    cos_in, sin2_half, weighted = samples.cos_in[r], samples.sin2_half[r], samples.weighted[r]
    cos_half, cos_out = samples.cos_half[r], samples.cos_out[r]
    one, count = np.float32(1), len(phis)
    alpha2, y2, scale, dg = of_lobes[0], of_lobes[1], of_lobes[2], of_lobes[3]
    for q in range(count):
        y = np.float32(width_of_masking(phis[q], kind))
        alpha2[q], y2[q] = alpha_of_phi(phis[q]) ** 2, y * y
        if kind == BECKMANN:
            scale[q] = share * beckmann_masking(cos_out, y)
        else:
            scale[q] = share * masking(cos_out, y) * alpha2[q] / np.pi
    of_base, of_rise = of_angles[0], of_angles[1]
    for k in range(len(cos_in)):
        of_base[k], of_rise[k] = reflectance(cos_half[k], kind)
    base_r, base_g, base_b = base[0], base[1], base[2]
    slope_r, slope_g, slope_b = slope[0], slope[1], slope[2]
    for k in range(len(cos_in)):
        x, s2 = cos_in[k], sin2_half[k]
        if x <= 0:
            continue
        x2, rest = x * x, one - x * x
        red, green, blue = weighted[k, 0], weighted[k, 1], weighted[k, 2]
        b, s = of_base[k], F0_OF_PSI * of_rise[k]
        b_r, b_g, b_b = np.float32(b * red), np.float32(b * green), np.float32(b * blue)
        s_r, s_g, s_b = np.float32(s * red), np.float32(s * green), np.float32(s * blue)
        if kind == BECKMANN:
            for q in range(count):
                y = np.sqrt(y2[q])
                dg[q] = scale[q] * beckmann_distribution(s2, y) * beckmann_masking(x, y)
        else:
            for q in range(count):
                below = stretched(s2, one - s2, alpha2[q])
                dg[q] = scale[q] / (below * below * (x + np.sqrt(stretched(x2, rest, y2[q]))))
        for q in range(count):
            base_r[q] += dg[q] * b_r
            base_g[q] += dg[q] * b_g
            base_b[q] += dg[q] * b_b
            slope_r[q] += dg[q] * s_r
            slope_g[q] += dg[q] * s_g
            slope_b[q] += dg[q] * s_b


def trace_lobe_samples(
    lit: LitScene,
    points: SurfacePoints,
    mixture: Mixture,
    seed: int,
    stream: Long | None = None,
    alphas: Double | None = None,
    group: int = 1,
) -> LobeSamples:
    """Trace the mixture at R surface points; all of ``points`` must lie on the surface.

    stream (R,)    each point's number, of which its random numbers follow; default: its place
    group          points of so many numbers after each other divide each technique's Sobol points
                   among them, so that their mean has a smaller error
    alphas (R, A)  the lobes' widths; default: LOBE_ALPHAS at every point, for any roughness
    """
    groups, sun = lit.lights.groups, lit.environment.sun
    if not len(groups.face):
        mixture = Mixture(mixture.per_lobe, 0, mixture.cosine + mixture.lights)
    mixture = mixture._replace(sun=int(sun.shines))
    count = len(points.face)
    if alphas is None:
        alphas = np.tile(LOBE_ALPHAS, (count, 1))  # a view would be another type to compile for
    total = mixture.per_lobe * alphas.shape[1] + mixture.lights + mixture.cosine + mixture.sun
    origin = lift_from_surface(points.position, points.normal, lit.diagonal_m)
    draws = GroupDraws(
        sobol_bits(int(np.ceil(np.log2(group * max(mixture))))),
        np.arange(count) if stream is None else stream,
        group,
        seed,
    )
    directions = np.zeros((count * total, 3), np.float32)
    aimed = Aimed(
        points.normal, points.to_camera, alphas, directions.reshape(count, total, 3),
        np.full((count, total), -1, np.int32),
    )  # fmt: skip
    draw_directions(count, aimed, origin, draws, mixture, groups)
    if mixture.sun:
        aimed.direction[:, -1] = towards_sun(sun, shifts_of(draws.number, 2, seed ^ _SUN_SEED))
    hits = lit.light_rays.closest(np.repeat(origin, total, axis=0), directions)
    cos_in, sin2_half, cos_half = np.zeros((3, count, total), np.float32)
    arriving = lit.radiance.at(hits.face, hits.u, hits.v).reshape(count, total, 3)
    cos_out = np.einsum("rd,rd->r", points.normal, points.to_camera)
    samples = LobeSamples(cos_in, sin2_half, cos_half, arriving, cos_out)
    hits = Hits._make(values.reshape(count, total) for values in hits)
    weigh(count, aimed, origin, hits, mixture, groups, lit.environment, samples)
    return samples


def lobe_basis(
    lit: LitScene,
    points: SurfacePoints,
    num_groups: int,
    seed: int,
    mixture: Mixture = MIXTURE,
    stream: Long | None = None,
) -> Basis:
    """Kind of lobe, roughnesses (Q,) -> (base, slope) of I_nd = base + psi * slope,
    (num_groups, 3, Q) each: the mean over equally many consecutive ``points`` per group. Rays are
    traced once, when they are first needed. stream (num_groups,): groups of the same number share
    their random numbers; default: none do."""

    @cache
    def samples() -> LobeSamples:
        group = len(points.face) // max(num_groups, 1)
        number = np.arange(num_groups) if stream is None else stream
        each = (group * number[:, None] + np.arange(group)).ravel()
        return trace_lobe_samples(lit, points, mixture, seed, each, group=group)

    def basis(kind: int, phis: Sequence[float]) -> tuple[Float, Float]:
        # As many as vector instructions take at once.
        padded = np.zeros(-(-len(phis) // _LANES) * _LANES, np.float32)
        padded[: len(phis)] = phis
        base, slope = non_diffuse(samples(), np.tile(padded, (num_groups, 1)), kind)
        return base[..., : len(phis)], slope[..., : len(phis)]

    return basis


def non_diffuse(samples: LobeSamples, phis: Float, kind: int = PAPER) -> tuple[Float, Float]:
    """I_nd = base + psi * slope, (G, 3, Q) float32 each, means over each of G groups of consecutive
    points, for its roughnesses phis (G, Q), with lobes of a kind."""
    base = np.zeros((len(phis), 3, phis.shape[1]), np.float32)
    slope = np.zeros_like(base)
    integrate(len(phis), samples, phis, kind, base, slope)
    return base, slope


def lobe_radiance(
    lit: LitScene,
    points: SurfacePoints,
    phi: Float,
    psi: Float,
    rays: int,
    seed: int,
    stream: Long | None = None,
    group: int = 1,
) -> Float:
    """I_nd (R, 3) at surface points with lobes phi (R,) and psi (R,), or (R, 3) where channels
    differ, from ``rays`` rays each.

    A psi above 1 is a metal's. Of the rays, 5/8 follow the point's own lobe and the rest go to the
    lights, both weighted by the balance heuristic. All ``points`` must lie on the surface. Every
    point draws its own random numbers, from ``seed`` and its number in ``stream`` (R,), else its
    place in the array; points of ``group`` numbers after each other, as those of a pixel, divide
    what one point would draw, so that their mean has a smaller error.
    """
    mixture = Mixture(per_lobe=rays - 3 * rays // 8, lights=3 * rays // 8, cosine=0)
    alphas = np.maximum(phi, MIN_ALPHA).astype(np.float64)[:, None]
    psi = psi if psi.ndim == 2 else psi[:, None]
    result = np.zeros((len(phi), 3), np.float32)
    stream = np.arange(len(phi)) if stream is None else stream
    kinds = lit.kinds_of_lobe(points.face, np.asarray((psi > 1).any(axis=1)))
    if (kinds != lit.lobe).any():
        for kind in np.unique(kinds):
            which = np.flatnonzero(kinds == kind)
            one = replace(lit, lobe=int(kind), beckmann=None)
            result[which] = lobe_radiance(
                one, points.take(which), phi[which], psi[which], rays, seed, stream[which], group
            )
        return result
    step = max(1, _RAYS_AT_ONCE // rays)
    for start in range(0, len(phi), step):
        part = np.arange(start, min(start + step, len(phi)))
        numbers = stream[part]
        samples = trace_lobe_samples(
            lit, points.take(part), mixture, seed, numbers, alphas[part], group
        )
        base, slope = non_diffuse(samples, phi[part, None].astype(np.float32), lit.lobe)
        share = share_of_base(F0_OF_PSI * psi[part], lit.lobe)
        result[part] = share * base[..., 0] + psi[part] * slope[..., 0]
    return result


def specular_irradiance(
    lit: LitScene,
    position: Float,
    normal: Float,
    identity: Long,
    phi: Float,
    psi: Float,
    *,
    rays: int,
    rays_of_lobe: int,
    seed: int,
) -> Float:
    """S_nd (N, 3), W/m^2, at N surface points with normals (N, 3), world; unbiased.

    phi, psi      (num_objects,) the lobe of each object, psi (num_objects, 3) where channels
                  differ; what emits reflects nothing
    identity      (N,) numbers of the points, of which their random numbers follow
    rays          cosine-distributed rays per point, and ``rays_of_lobe`` from where each ends
    """
    count = len(position)
    origin = np.tile(lift_from_surface(position, normal, lit.diagonal_m), (rays, 1))
    directions = cosine_rays(normal, identity, seed, rays)
    points = points_of_rays(lit, origin, directions)
    reflects = np.flatnonzero((points.face >= 0) & ~lit.emits(points))
    owner = lit.scene.face_object[points.face[reflects]]
    arriving = np.zeros((len(directions), 3), np.float32)
    number = (rays * identity + np.arange(rays)[:, None]).ravel()[reflects]
    arriving[reflects] = lobe_radiance(
        lit, points.take(reflects), phi[owner], psi[owner], rays_of_lobe, seed, number
    )
    mean: Float = arriving.reshape(rays, count, 3).mean(axis=0)
    return np.float32(np.pi) * mean
