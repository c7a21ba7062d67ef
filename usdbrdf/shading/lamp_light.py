"""How strong lamps are that no frame measures, be it that all of them clip or that none shows them:
from the light that they cast on texels that tell it well.

These lie evenly in it, away from shadows' edges; what they mirror to the frames that see them is
traced, since L_d holds it; and segments (facings of objects) count by how much they scatter.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.options import Sampling
from usdbrdf.shading.asked import CLOSELY, LEAST_OF_SEGMENT, Shining, irradiance_of_texels
from usdbrdf.shading.gloss import mirrored_irradiance, mirrored_to_frames
from usdbrdf.shading.outside_light import (
    Asked,
    Solution,
    Sources,
    gloss_of_scene,
    jackknife,
    likeliest,
    pull_of_prior,
)
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.lit_scene import TexturedScene

_SEED = 0x1A3
# How roughly what a lamp brings tells even light from shadows' edges, and which may be one.
ROUGHLY = Sampling(standard_error=0, max_rays=32)
# Texels from one to those beside it; by what share of the lamps' light and of all other light these
# may differ.
_AROUND = 2
_UNEVEN, _OF_OTHER_LIGHT = calibration.pair("unseen.uneven")
# Among the sources of one scan, beside the sky's patches and the sun, which are 0.
_LAMP = 1
# In the dark some of the little light that arrives is not known.
_STRAY = calibration.number("lamps.stray")
_LEAST_EVEN = calibration.number("unseen.least_even")
_BRIGHTER = calibration.number("unseen.brighter")
LEAST_PART = calibration.number("unseen.least_part")
MOST_OF_CERTAIN = calibration.number("unseen.most_beside")


class Lamps(NamedTuple):
    """K lamps: of (T,) int32, the number of each texel's, -1 for none; the logarithm of their
    radiance before the evidence, mean (K, 3) and deviation (K,); and which are lamps for certain,
    (K,)."""

    of: Int
    mean: Double
    deviation: Double
    certain: Bool


class Strengths(NamedTuple):
    """Radiance (K, 3) of the lamps, W/(m^2 sr), its relative error (K,), S (K,) of the texels that
    they light, each as much as it does, and what part of that is theirs, (K,)."""

    radiance: Double
    error: Double
    near: Double
    part: Double


def looked_at_closely(
    surface: TexturedScene,
    lit: Float,
    outside: Environment,
    frames: Frames,
    asked: Asked,
    lamps: Lamps,
    strength: Double,
    seed: int,
) -> Strengths:
    """The lamps' strengths in the scene of radiance ``lit`` (T, 3), by what they bring by rays that
    are sent to them, to texels that lie evenly in their light, and what surfaces mirror of it and
    of all other light. strength (K,): the lamps' radiance so far."""
    asked = beside_lamps(surface, lit, outside, asked, lamps, seed)
    asked = asked.of(_evenly_lit(surface, asked, lamps, strength, seed))
    texel, seed = asked.texel, seed ^ _SEED
    share = brought(surface, lamps, texel, seed)
    rest = without(lit, lamps)
    asked = asked._replace(
        mirrored=np.pi * mirrored_to_frames(surface, rest, outside, frames, texel, seed)
    )
    sent_on = [
        mirrored_irradiance(surface, light, texel, seed + k)[:, 0]
        for k, light in enumerate(_alone(lamps))
    ]
    sources = sources_of(lamps, share)
    start = np.repeat(np.log(strength)[:, None], 3, axis=1)
    glossy = gloss_of_scene(asked, sources, np.stack(sent_on), start)
    return strengths(asked, glossy, lamps.certain, start)


def beside_lamps(
    surface: TexturedScene, lit: Float, outside: Environment, asked: Asked, lamps: Lamps, seed: int
) -> Asked:
    """The texels asked with S of all but the lamps."""
    rest = Shining.of(surface, without(lit, lamps), outside)
    known = irradiance_of_texels(surface, rest, outside, asked.texel, seed)
    floor = 1e-4 * np.median(asked.reflected)
    return asked._replace(irradiance=np.maximum(known, floor).astype(np.float64))


def sources_of(lamps: Lamps, share: Double) -> Sources:
    """The lamps, which bring ``share`` (K, N) to the texels asked."""
    return Sources(
        share=share,
        mean=lamps.mean,
        deviation=lamps.deviation,
        family=np.full(len(share), _LAMP, np.int64),
        pairs=np.zeros((0, 2), np.int64),
        apart=np.zeros(0),
        stray=_STRAY,
    )


def strengths(asked: Asked, sources: Sources, certain: Bool, *others: Double) -> Strengths:
    """Those that explain best what the texels reflect; ``certain`` (K,) as of ``Lamps``,
    ``others`` (K, 3) of ``likeliest``."""
    found = likeliest(asked, sources, *others)
    error = np.hypot(
        jackknife(asked, sources, found, certain), pull_of_prior(asked, sources, found)
    ).max(axis=1)
    near, part = beside_others(asked, sources, found)
    return Strengths(np.exp(found.log_radiance), np.asarray(error), near, part)


def beside_others(asked: Asked, sources: Sources, found: Solution) -> tuple[Double, Double]:
    """Of each source, (K,): S of the texels that it lights, each as much as it does, W/m^2, and
    what part of that is its own."""
    light = (asked.irradiance + sources.irradiance(found.log_radiance)).mean(axis=1)
    radiance = np.exp(found.log_radiance).mean(axis=1)
    lights = np.maximum(sources.share.sum(axis=1), 1e-12)
    near = (sources.share @ light) / lights
    part = radiance * (sources.share**2 / light).sum(axis=1) / lights
    return np.asarray(near), np.asarray(part)


def shining(radiance: Double, near: Double, part: Double) -> Bool:
    """Which (K,) are clearly brighter than what only reflects, even with as much light as the
    texels that see it receive; near and part (K,) as of ``Strengths``."""
    return np.asarray((np.pi * radiance.mean(axis=1) > _BRIGHTER * near) & (part > LEAST_PART))


def known_well(error: Double, part: Double, most: float) -> Bool:
    """Which sources (K,) are known so well that light is with them closer to what it is than
    without, by a factor ``most``.

    The logarithm of S of which a source brings a ``part`` (K,) is off by part times the relative
    ``error`` (K,) of its strength, and by -log(1 - part) if it is left out: what brings little must
    be known well, and what brings most of the light need not.
    """
    part = np.clip(part, 1e-6, 1 - 1e-6)
    return np.asarray(part * error < -most * np.log1p(-part), np.bool_)


def brought(
    surface: TexturedScene, lamps: Lamps, texel: Long, seed: int, sampling: Sampling = CLOSELY
) -> Double:
    """(K, N) W/m^2: what each of the lamps brings to texels (N,) with a radiance of 1, by rays that
    are sent to it."""
    return np.stack(
        [
            _brought(surface, Shining.of(surface, light), texel, seed + k, sampling)
            for k, light in enumerate(_alone(lamps))
        ]
    )


def _alone(lamps: Lamps) -> Iterator[Float]:
    """(T, 3): each of the lamps with a radiance of 1, in the dark; one after the other, since each
    takes as much memory as the scene's textures."""
    for k in range(len(lamps.mean)):
        yield np.repeat((lamps.of == k)[:, None].astype(np.float32), 3, axis=1)


def without(lit: Float, lamps: Lamps) -> Float:
    """``lit`` (T, 3) with the lamps off."""
    return np.where((lamps.of >= 0)[:, None], np.float32(0), lit)


def _brought(
    surface: TexturedScene, light: Shining, texel: Long, seed: int, sampling: Sampling
) -> Double:
    """(N,) W/m^2: what grey ``light`` brings, by rays that are sent to it."""
    found = irradiance_of_texels(surface, light, black_environment(), texel, seed, sampling)
    return np.asarray(found[:, 0], np.float64)


def _evenly_lit(
    surface: TexturedScene, asked: Asked, lamps: Lamps, strength: Double, seed: int
) -> Bool:
    """Which of the texels asked, (N,), lie among others that are as much lit: a pixel beside a
    shadow's edge mixes light and shadow, and a lamp that casts mixed ones comes out too dim.
    Segments of which few are measured leave; if too few were left in all, all stay."""
    total, most = np.zeros(len(asked.texel)), np.zeros(len(asked.texel))
    for alone, radiance in zip(_alone(lamps), strength, strict=True):
        light = Shining.of(surface, alone)
        # The same rays from each, so that their noise is the same.
        own = _brought(surface, light, asked.texel, seed, ROUGHLY)
        total += radiance * own
        uneven = np.zeros(len(own))
        for beside in surface.texels.around(asked.texel, _AROUND):
            other = _brought(surface, light, beside, seed, ROUGHLY)
            uneven = np.maximum(uneven, np.abs(other - own))
        most += radiance * uneven
    even = most <= _UNEVEN * total + _OF_OTHER_LIGHT * asked.irradiance.mean(axis=1)
    count = np.bincount(
        asked.segment[even & ~asked.clipped], minlength=int(asked.segment.max()) + 1
    )
    even &= count[asked.segment] >= LEAST_OF_SEGMENT // 2
    return even if even.mean() > _LEAST_EVEN else np.ones_like(even)
