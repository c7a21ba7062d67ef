"""The light from outside that no frame shows, inferred from the light that it casts.

What texels reflect is their albedo times S, and S is the light of what was seen, that of patches of
the sky, and the sun. On one side of one object the albedo varies about one value, so that the
contrasts there tell of the light: the sun's direction is the one whose shadows are found in the
texture, and its irradiance and the patches' radiance follow by least squares on the logarithms,
with outliers weighed as under Student's t. What clips is a lower bound. Where nothing that was seen
lights the scan, contrasts leave the level open: then it is the one at which the mean albedo is what
is usual, and nothing reflects more than it receives.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap
from usdbrdf.options import Sampling
from usdbrdf.shading.surroundings import HEIGHT, WIDTH, Surroundings, surroundings_from_frames
from usdbrdf.transport.environment import (
    NO_SUN,
    Environment,
    Sun,
    directions_of_pixels,
    pixels_of_directions,
)
from usdbrdf.transport.irradiance import independent_tiles, irradiance_at
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.rays import lift_from_surface
from usdbrdf.transport.sunlight import sunlit
from usdbrdf.transport.warps import cosine_rays

# Texels that are asked, at most and at least on one side of one object (a segment), segments, and
# the rays by which each of them meets the sky.
_PER_SEGMENT, _LEAST_OF_SEGMENT, _SEGMENTS, _RAYS = 240, 30, 80, 1024
_SAMPLING = Sampling(standard_error=0.01, max_rays=1024)
# Lower and upper elevation of a band of patches, degrees, and their number.
_BANDS = (
    (-90, -30, 4), (-30, 0, 12), (0, 8, 24), (8, 16, 24), (16, 28, 24), (28, 42, 16), (42, 65, 8),
    (65, 90, 1),
)  # fmt: skip
_LEAST_SHARE = calibration.number("outside.least_share")
_LEAST_OPEN = calibration.number("outside.least_open")
# Directions of the first search for the sun; how many of them are followed; how much finer each of
# the next searches is, of which there are so many; candidates for its irradiance, in units of the
# median S.
_DIRECTIONS, _FOLLOWED, _FINER, _REFINED = 3000, 16, 2.5, 6
_STRENGTHS = np.geomspace(0.25, 128, 10)
_OUTLIER = 1.5
_NEAR = 0.3  # radians in which the sun is looked for again
_BESIDE = 0.4  # radians within which the sky is alike
_SEED = 0x51C4
_DARK = 1e-4  # of what is reflected: less than that is no light to compare with


class Asked(NamedTuple):
    """N texels that are asked: their numbers, segments counted from 0 and objects, what they
    reflect (pi L_d, W/m^2; where ``clipped`` the largest channel reflects no less), (N, 3), and S
    of what was seen."""

    index: Long
    segment: Int
    object: Int
    reflected: Double
    clipped: Bool
    irradiance: Double

    def of(self, which: Array) -> Asked:
        return Asked._make(values[which] for values in self)


@dataclass(frozen=True, kw_only=True)
class Outside:
    """The light from outside, and how it is known.

    environment   what rays that leave the scan meet
    confidence    (H, W) float32: 1 where frames show it, or a file tells; 0.5 where it clips in all
                  of them, 0 where it is inferred
    open_share    of the light's directions that leave the scan; NaN if a file tells the light
    sky_error     relative standard error of what is inferred; NaN where nothing is
    sun_error     relative standard error of the sun's irradiance; NaN without a sun, or a file's
    """

    environment: Environment
    confidence: Float
    open_share: float = float("nan")
    sky_error: float = float("nan")
    sun_error: float = float("nan")

    @classmethod
    def given(cls, environment: Environment) -> Outside:
        """By a file, which is believed."""
        return cls(
            environment=environment, confidence=np.ones(environment.image.shape[:2], np.float32)
        )

    def arrays(self) -> dict[str, Array]:
        """All of it."""
        image, z_up, sun = self.environment.image, self.environment.z_up, self.environment.sun
        disc = [*sun.direction, *sun.irradiance, sun.half_angle]
        numbers = [z_up, self.open_share, self.sky_error, self.sun_error, *disc]
        return {"image": image, "confidence": self.confidence, "numbers": np.array(numbers)}

    @classmethod
    def restored(cls, arrays: Mapping[str, Array]) -> Outside:
        """What ``arrays`` once returned."""
        z_up, open_share, sky, sun_error, *disc = arrays["numbers"].tolist()
        sun = Sun(np.array(disc[:3]), np.array(disc[3:6]), disc[6])
        return cls(
            environment=Environment(arrays["image"], bool(z_up)).under(sun),
            confidence=arrays["confidence"],
            open_share=open_share,
            sky_error=sky,
            sun_error=sun_error,
        )


def estimated_outside(
    run: TaskRun,
    surface: TexturedScene,
    frames: Frames,
    lit: Float,
    coverage: CoverageMap,
    z_up: bool,
    seed: int,
) -> Outside | None:
    """What the frames show of the surroundings, and what they tell of the rest."""

    def compute() -> dict[str, Array]:
        seen = surroundings_from_frames(surface.rays, frames, z_up)
        found = light_from_outside(surface, lit, coverage, seen, z_up, seed)
        return found.arrays() if found else {"nothing": np.zeros(0)}

    arrays = run.checkpoint("outside", compute)
    return None if "nothing" in arrays else Outside.restored(arrays)


def light_from_outside(
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    seen: Surroundings,
    z_up: bool,
    seed: int,
) -> Outside | None:
    """What lights the scan ``lit`` (T, 3), L_d, from outside; None where hardly a direction of its
    light leaves it. seen: what the frames show of it."""
    asked = _asked(surface, lit, coverage, seen, z_up, seed)
    if asked is None:
        return None
    measured, clipped = seen.coverage.measured, seen.coverage.clipped
    # What long exposures alone show may be no brighter than the rest.
    limit = seen.radiance.max(axis=1) * clipped
    patches = _patches(limit > limit.max() / 2, z_up)
    share, open_share = _shares(surface, asked, np.where(measured, -1, patches), z_up, seed)
    if open_share < _LEAST_OPEN:
        return None
    used = np.flatnonzero(share.mean(axis=1) > _LEAST_SHARE * np.pi)
    say(f"shade: {100 * open_share:.0f} % of the light's directions leave the scan")
    sky = _sky(asked, seen, patches, share, used, z_up)
    level = solved(asked, sky)
    # Patches that had to stand for the sun brighten what it shines on: once it is found, its place
    # is looked for again.
    sun = _find_sun(surface, asked, asked.irradiance + sky.irradiance(sky.mean), z_up)
    for _ in range(2):
        with_sun = _with_sun(surface, asked, sky, sun, seed)
        found = solved(*with_sun)
        light = asked.irradiance + sky.irradiance(found.log_radiance[:-1])
        sun = _find_sun(surface, asked, light, z_up, sun)
    error = _jackknife(*with_sun, found)
    sun_error = float(error[-1].max())
    strength = float(np.exp(found.log_radiance[-1]).mean() / np.median(light.mean(axis=1)))
    shines = sun_error < _MOST_SUN_ERROR and strength > _LEAST_SUN
    if shines:
        sun = sun._replace(irradiance=np.exp(found.log_radiance[-1]))
    else:
        sun, found, error = NO_SUN, level, _jackknife(asked, sky, level)
    radiance = _picture(seen, patches, used, np.exp(found.log_radiance[: len(used)]))
    weight = share[used].mean(axis=1)
    of_sky = error[: len(used)].max(axis=1)
    return Outside(
        environment=Environment(radiance, z_up).under(sun),
        confidence=seen.coverage.stored().reshape(HEIGHT, WIDTH),
        open_share=open_share,
        sky_error=float(np.average(of_sky, weights=weight)) if len(used) else float("nan"),
        sun_error=sun_error if shines else float("nan"),
    )


def _asked(
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    seen: Surroundings,
    z_up: bool,
    seed: int,
) -> Asked | None:
    """Texels of the largest segments that were measured, with some of them that clip; None where
    there are too few."""
    texels = surface.texels
    usable = np.flatnonzero(coverage.observed & texels.interior)
    owner, normal = texels.object_index()[usable], texels.normal[usable]
    axis = np.abs(normal).argmax(axis=1)
    segment = 6 * owner + 2 * axis + (normal[np.arange(len(usable)), axis] > 0)
    measured = coverage.measured[usable]
    area = np.bincount(segment, texels.area[usable] * measured)
    enough = np.bincount(segment, measured) >= np.maximum(
        _LEAST_OF_SEGMENT, np.bincount(segment) / 2
    )
    largest = np.argsort(-area * enough, kind="stable")[:_SEGMENTS]
    largest = largest[enough[largest]]
    if not len(largest):
        return None
    rank = np.random.default_rng(seed ^ _SEED).permutation(len(usable))
    rank = rank[np.isin(segment[rank], largest)]
    rank = rank[np.argsort(segment[rank], kind="stable")]
    place = np.arange(len(rank)) - np.searchsorted(segment[rank], segment[rank])
    kept = rank[place < _PER_SEGMENT]
    index = usable[kept]
    known = np.where(seen.coverage.measured[:, None], seen.radiance, np.float32(0))
    environment = Environment(known.reshape(HEIGHT, WIDTH, 3), z_up)
    irradiance = irradiance_at(
        surface.rays, surface.texture(lit), lights_from_radiance(surface.scene, texels, lit),
        environment, texels.position[index], texels.normal[index], independent_tiles(len(index)),
        replace(_SAMPLING, seed=seed), surface.diagonal_m,
    ).mean  # fmt: skip
    reflected = np.pi * lit[index].astype(np.float64)
    bright = np.flatnonzero((reflected > 0).all(axis=1))
    index, kept, irradiance, reflected = (
        values[bright] for values in (index, kept, irradiance, reflected)
    )
    return Asked(
        index=index,
        segment=np.unique(segment[kept], return_inverse=True)[1].astype(np.int32),
        object=owner[kept].astype(np.int32),
        reflected=reflected,
        clipped=~measured[kept],
        irradiance=np.maximum(irradiance, _DARK * np.median(reflected)).astype(np.float64),
    )


def _patches(clipped: Bool, z_up: bool) -> Int:
    """(D,) the patch of the sky of each direction: bands of azimuths; what clips is in patches of
    its own, whose numbers follow."""
    directions = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
    up, x = directions[:, 2 if z_up else 1], directions[:, 0]
    ahead = -directions[:, 1] if z_up else directions[:, 2]
    elevation, turn = np.degrees(np.arcsin(np.clip(up, -1, 1))), np.arctan2(x, ahead) / (2 * np.pi)
    patch, first = np.zeros(len(directions), np.int32), 0
    for low, high, count in _BANDS:
        band = (elevation >= low) & (elevation <= high)
        patch[band] = first + np.floor((turn[band] % 1.0) * count).astype(np.int32) % count
        first += count
    return np.where(clipped, patch + first, patch).astype(np.int32)


_PATCHES = sum(count for _, _, count in _BANDS)


def _shares(
    surface: TexturedScene, asked: Asked, patches: Int, z_up: bool, seed: int
) -> tuple[Double, float]:
    """What each patch (-1: none) of radiance 1 brings to the texels asked, (2 _PATCHES, N), W/m^2;
    and the share of the light's directions that leave the scan."""
    texels, count = surface.texels, len(asked.index)
    normal = texels.normal[asked.index]
    origin = lift_from_surface(texels.position[asked.index], normal, surface.diagonal_m)
    towards = cosine_rays(normal, asked.index, seed ^ _SEED, _RAYS)
    out = np.flatnonzero(surface.rays.closest(origin, towards).face < 0)
    patch = patches[pixels_of_directions(towards[out], HEIGHT, WIDTH, z_up)]
    texel, kept = out % count, patch >= 0
    met = np.bincount(patch[kept] * count + texel[kept], minlength=2 * _PATCHES * count)
    return np.pi / _RAYS * met.reshape(2 * _PATCHES, count), len(out) / len(towards)


class Sources(NamedTuple):
    """K sources of unknown strength: what each brings per unit of it to the texels asked, (K, N);
    the logarithm of its strength before the evidence, mean (K, 3) and deviation (K,); whether the
    mean is a lower bound, (K,); and pairs of neighbours, which are alike, (P, 2)."""

    share: Double
    mean: Double
    deviation: Double
    bound: Bool
    pairs: Long

    def irradiance(self, log_radiance: Double) -> Double:
        """(N, 3) W/m^2 of all of them."""
        return np.asarray(np.einsum("kn,kc->nc", self.share, np.exp(log_radiance)))


_ABOVE_LIMIT = calibration.pair("outside.above_limit")
_SKY_DEVIATION = calibration.number("outside.sky_deviation")
_ALIKE = calibration.number("outside.alike")
_SUN_DEVIATION = calibration.number("outside.sun_deviation")
_LEAST_SUN = calibration.number("outside.least_sun")
_MOST_SUN_ERROR = calibration.number("outside.most_sun_error")


def _sky(
    asked: Asked, seen: Surroundings, patches: Int, share: Double, used: Long, z_up: bool
) -> Sources:
    """The patches that light what is asked."""
    known, usual = seen.coverage.measured, _usual_sky(seen)
    if not usual.any():
        usual = np.median(asked.reflected, axis=0) / np.pi
    bound = used >= _PATCHES
    mean = np.tile(np.log(np.maximum(usual, 1e-6 * usual.max() + 1e-30)), (len(used), 1))
    directions = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
    centre = np.zeros((len(used), 3))
    for k, patch in enumerate(used):
        centre[k] = directions[patches % _PATCHES == patch % _PATCHES].mean(axis=0)
        near = known & (directions @ centre[k] > np.cos(_BESIDE) * np.linalg.norm(centre[k]))
        if bound[k]:
            mean[k] = np.log(seen.radiance[patches == patch].max(axis=0)) + _ABOVE_LIMIT[0]
        elif near.any():
            mean[k] = np.log(np.maximum(np.median(seen.radiance[near], axis=0), 1e-30))
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    near = np.argwhere(np.triu(centre @ centre.T > np.cos(_BESIDE), 1))
    near = near[~bound[near].any(axis=1)]
    deviation = np.where(bound, _ABOVE_LIMIT[1], _SKY_DEVIATION)
    return Sources(share[used], mean, deviation, bound, near)


def _usual_sky(seen: Surroundings) -> Double:
    """(3,) the median radiance of what frames show of the surroundings; 0 where they show nothing."""
    known = seen.radiance[seen.coverage.measured].astype(np.float64)
    return np.median(known, axis=0) if len(known) else np.zeros(3)


def _with_sun(
    surface: TexturedScene, asked: Asked, sky: Sources, sun: Sun, seed: int
) -> tuple[Asked, Sources]:
    """The sun as the last of the sources; without the texels that see some of its disc only, whose
    share of it is not known as well as that."""
    share = sunlit(surface, asked.index, sun, seed).astype(np.float64)
    cosine = np.maximum(surface.texels.normal[asked.index] @ sun.direction, 0)
    kept = (share < 0.02 * cosine + 1e-6) | (share > 0.98 * cosine)
    strength = np.log(np.median(asked.irradiance, axis=0))
    sources = Sources(
        share=np.concatenate([sky.share, share[None]])[:, kept],
        mean=np.concatenate([sky.mean, strength[None]]),
        deviation=np.append(sky.deviation, _SUN_DEVIATION),
        bound=np.append(sky.bound, False),
        pairs=sky.pairs,
    )
    chosen = asked.of(kept)
    segment = np.unique(chosen.segment, return_inverse=True)[1].astype(np.int32)
    return chosen._replace(segment=segment), sources


_FREEDOM = calibration.number("lamps.student_freedom")
_INDEPENDENT = calibration.number("outside.independent")
USUAL_ALBEDO = calibration.pair("outside.albedo")
_OF_SEGMENT = calibration.number("outside.albedo_of_segment")
_WHITEST, _AS_WHITE = calibration.pair("outside.whitest")
_ITERATIONS = 40
_LEAST_NOISE = calibration.number("outside.least_noise")


class Solution(NamedTuple):
    """log_radiance (K, 3) of the sources, log_albedo (M, 3) of the segments, and the logarithm of
    the mean albedo, (3,)."""

    log_radiance: Double
    log_albedo: Double
    mean: Double


def solved(
    asked: Asked, sources: Sources, start: Solution | None = None, iterations: int = _ITERATIONS
) -> Solution:
    """The strengths that explain best what the texels reflect."""
    if start is None:
        light = np.log(asked.irradiance + sources.irradiance(sources.mean))
        rest = np.log(asked.reflected) - light
        num = int(asked.segment.max()) + 1
        albedo = np.stack([np.median(rest[asked.segment == k], axis=0) for k in range(num)])
        start = Solution(sources.mean.copy(), albedo, np.full(3, USUAL_ALBEDO[0]))
    found = start
    # Which channel it is that clips, what does not clip tells first.
    for counted in (~asked.clipped[:, None] & np.ones(3, np.bool_), None):
        if counted is None:
            light = asked.irradiance + sources.irradiance(found.log_radiance)
            brightest = (np.log(light) + found.log_albedo[asked.segment]).argmax(axis=1)
            counted = ~asked.clipped[:, None] | (np.arange(3) == brightest[:, None])
        channels = [
            _solved_channel(asked, sources, found, c, counted[:, c], iterations) for c in range(3)
        ]
        found = Solution(*(np.stack(parts, axis=-1) for parts in zip(*channels, strict=True)))
    return found


def _solved_channel(
    asked: Asked, sources: Sources, start: Solution, channel: int, counted: Bool, iterations: int
) -> tuple[Double, Double, Double]:
    """One channel's part of ``solved``: Gauss-Newton steps on the weighted squares of the texels
    that are ``counted`` (N,)."""
    known, observed = asked.irradiance[:, channel], np.log(asked.reflected[:, channel])
    g, albedo = start.log_radiance[:, channel].copy(), start.log_albedo[:, channel].copy()
    mean = float(start.mean[channel])
    num_sources, num_segments = len(g), len(albedo)
    size = np.bincount(asked.segment, minlength=num_segments)
    effective = np.minimum(1, _INDEPENDENT / np.maximum(size, 1))[asked.segment]
    of_segment = np.zeros((len(observed), num_segments))
    of_segment[np.arange(len(observed)), asked.segment] = 1
    for _ in range(iterations):
        parts = np.exp(g)[:, None] * sources.share
        total = known + parts.sum(axis=0)
        residual = observed - np.log(total) - albedo[asked.segment]
        # What clips reflects at least as much: it says something where the model says less.
        counts = counted & (~asked.clipped | (residual > 0))
        noise = _noise_of_segments(asked, residual, num_segments)[asked.segment]
        weight = (_FREEDOM + 1) / (_FREEDOM + (residual / noise) ** 2) / noise**2
        weight = weight * effective * counts
        jacobian = np.concatenate([(parts / total).T, of_segment], axis=1)
        rows = num_sources + num_segments + 1
        curvature, gradient = np.zeros((rows, rows)), np.zeros(rows)
        curvature[:-1, :-1] = jacobian.T @ (jacobian * weight[:, None])
        gradient[:-1] = jacobian.T @ (weight * residual)
        _add_priors(curvature, gradient, sources, channel, (g, albedo, mean))
        damped = curvature + 1e-3 * np.diag(np.diag(curvature))
        step = np.clip(np.linalg.solve(damped, gradient), -1, 1)
        g += step[:num_sources]
        albedo += step[num_sources:-1]
        mean += float(step[-1])
        if np.abs(step).max() < 1e-4:
            break
    return g, albedo, np.float64(mean)


def _noise_of_segments(asked: Asked, residual: Double, count: int) -> Double:
    """(M,) how much the residuals (N,) of each segment scatter: plain walls tell more than what is
    patterned."""
    off = np.abs(residual)
    usual = float(np.median(off[~asked.clipped]))
    own = [off[(asked.segment == k) & ~asked.clipped] for k in range(count)]
    middle = np.array([np.median(some) if len(some) else usual for some in own])
    return np.maximum(_LEAST_NOISE, 1.4826 * middle)


def _add_priors(
    curvature: Double,
    gradient: Double,
    sources: Sources,
    channel: int,
    at: tuple[Double, Double, float],
) -> None:
    """What is known of sources and albedos before the evidence."""
    g, albedo, mean = at
    k, last = len(g), len(gradient) - 1
    index = np.arange(k)
    off = sources.mean[:, channel] - g
    precision = sources.deviation**-2.0
    curvature[index, index] += precision
    gradient[:k] += precision * off
    for a, b in sources.pairs:
        apart = (g[a] - g[b]) / _ALIKE**2
        for one, other, sign in ((a, b, 1.0), (b, a, -1.0)):
            curvature[one, one] += _ALIKE**-2
            curvature[one, other] -= _ALIKE**-2
            gradient[one] -= sign * apart
    segment = np.arange(k, last)
    off = albedo - mean
    precision_of = _OF_SEGMENT**-2
    curvature[segment, segment] += precision_of
    curvature[segment, last] -= precision_of
    curvature[last, segment] -= precision_of
    curvature[last, last] += precision_of * len(albedo) + USUAL_ALBEDO[1] ** -2
    gradient[segment] -= precision_of * off
    gradient[last] += precision_of * off.sum() + (USUAL_ALBEDO[0] - mean) / USUAL_ALBEDO[1] ** 2
    # Nothing reflects more than it receives.
    over = np.maximum(albedo - np.log(_WHITEST), 0)
    curvature[segment, segment] += (over > 0) * _AS_WHITE**-2
    gradient[segment] -= over * _AS_WHITE**-2


_BLOCKS = 10


def _jackknife(asked: Asked, sources: Sources, found: Solution) -> Double:
    """(K, 3) standard errors of the logarithms, if objects err as a whole."""
    objects = np.unique(asked.object)
    block = np.searchsorted(objects, asked.object) % min(_BLOCKS, max(len(objects), 2))
    moved, blocks = np.zeros_like(found.log_radiance), np.unique(block)
    for number in blocks:
        kept = block != number
        some = asked.of(kept)
        numbers, segment = np.unique(some.segment, return_inverse=True)
        some = some._replace(segment=segment.astype(np.int32))
        start = found._replace(log_albedo=found.log_albedo[numbers])
        part = solved(some, sources._replace(share=sources.share[:, kept]), start, 8)
        moved += (part.log_radiance - found.log_radiance) ** 2
    return np.asarray(np.sqrt((1 - 1 / len(blocks)) * moved))


def _picture(seen: Surroundings, patches: Int, used: Long, radiance: Double) -> Float:
    """(HEIGHT, WIDTH, 3): what was measured, and the patches."""
    filled = np.tile(_usual_sky(seen), (HEIGHT * WIDTH, 1))
    for patch, value in zip(used, radiance, strict=True):
        filled[patches == patch] = value
    known = seen.coverage.measured[:, None]
    return np.where(known, seen.radiance, filled).reshape(HEIGHT, WIDTH, 3).astype(np.float32)


def _find_sun(
    surface: TexturedScene, asked: Asked, irradiance: Double, z_up: bool, near: Sun | None = None
) -> Sun:
    """The direction above the horizon whose shadows are in the texture, ``near`` one if that is
    given; irradiance (N, 3) without it."""
    texels, asked = surface.texels, asked.of(np.s_[::2])
    irradiance = irradiance[::2]
    normal = texels.normal[asked.index].astype(np.float64)
    origin = lift_from_surface(
        texels.position[asked.index], texels.normal[asked.index], surface.diagonal_m
    )
    level = np.median(irradiance.mean(axis=1))
    reflected, without = np.log(asked.reflected.max(axis=1)), irradiance.mean(axis=1)
    first = np.searchsorted(asked.segment, np.arange(asked.segment.max() + 2))
    strengths = level * _STRENGTHS

    def cost(directions: Double) -> Double:
        """(M,) of the best strength in each direction."""
        cosine = np.maximum(directions @ normal.T, 0)
        rays = np.repeat(directions.astype(np.float32), len(origin), axis=0)
        free = surface.rays.closest(origin, rays).face < 0
        share = cosine * free.reshape(cosine.shape)
        return _costs(reflected, without, share, asked.clipped, first, strengths)

    def costs(directions: Double) -> Double:
        parts = np.array_split(directions, max(1, len(directions) // 32))
        with ThreadPoolExecutor(2) as pool:
            return np.concatenate(list(pool.map(cost, parts)))

    tried = _spread(2 * _DIRECTIONS)
    tried = tried[tried[:, 2 if z_up else 1] > 0]
    if near:
        tried = tried[tried @ near.direction > np.cos(_NEAR)]
    # The way down is rough: a shadow's edge counts when it passes a texel.
    reach = 1.5 * float(np.sqrt(2 * np.pi / _DIRECTIONS))
    kept = tried[np.argsort(costs(tried), kind="stable")[:_FOLLOWED]]
    for _ in range(_REFINED):
        around = np.stack([_around(direction, reach) for direction in kept])
        cost_around = costs(around.reshape(-1, 3)).reshape(len(kept), -1)
        best = cost_around.argmin(axis=1)
        order = np.argsort(cost_around.min(axis=1), kind="stable")
        kept = around[np.arange(len(kept)), best][order][: max(1, len(kept) // 2)]
        reach /= _FINER
    return Sun(kept[0], np.full(3, level))


def _spread(count: int) -> Double:
    """(count, 3) unit directions, evenly over the sphere: a Fibonacci lattice."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + np.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1)


def _around(direction: Double, reach: float) -> Double:
    """(M, 3) unit directions on a grid within ``reach`` radians of one."""
    steps = np.linspace(-reach, reach, 9)
    x, y = (grid.ravel()[:, None] for grid in np.meshgrid(steps, steps))
    right = np.cross(np.eye(3)[np.abs(direction).argmin()], direction)
    right /= np.linalg.norm(right)
    near = direction + x * right + y * np.cross(direction, right)
    return np.asarray(near / np.linalg.norm(near, axis=1, keepdims=True))


@loop
def _costs(
    reflected: Double, without: Double, share: Double, clipped: Bool, first: Long, strengths: Double
) -> Double:
    """(M,) for each row of ``share`` (M, N) the least cost of all strengths: mean distance of the
    logarithms from their segment's median, none counting more than as an outlier."""
    count, points = share.shape
    best = np.empty(count)
    rest = np.empty(points)
    for m in range(count):
        best[m] = np.inf
        for strength in strengths:
            total = 0.0
            for k in range(len(first) - 1):
                low, high = first[k], first[k + 1]
                for i in range(low, high):
                    rest[i] = reflected[i] - np.log(without[i] + strength * share[m, i])
                middle = np.median(rest[low:high])
                for i in range(low, high):
                    off = rest[i] - middle
                    if not (clipped[i] and off < 0):
                        total += min(abs(off), _OUTLIER)
            best[m] = min(best[m], total / points)
    return best
