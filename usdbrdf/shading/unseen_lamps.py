"""Lamps that no frame shows, from the light that they cast: a ceiling light above all pictures.

Objects of which frames show nothing are sources of unknown strength. As for light from outside,
what texels reflect tells it: pi L_d = albedo (S_seen + sum_k g_k B_k), by least squares on the
logarithms with one albedo for each facing of an object. What comes out much brighter than anything
that only reflects could be where it is shines by itself; the others keep what was filled in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.options import Sampling
from usdbrdf.shading.clipped_light import CLOSELY, Shining, irradiance_of_texels
from usdbrdf.shading.gloss import mirrored_irradiance, mirrored_to_frames
from usdbrdf.shading.outside import LEAST_OF_SEGMENT, asked_texels, looked_around
from usdbrdf.shading.outside_light import Asked, Sources, gloss_of_scene, jackknife, solved
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.lit_scene import TexturedScene

_UNSEEN = calibration.number("unseen.most_seen")
_LEAST_SHARE = calibration.number("unseen.least_share")
_BRIGHTER = calibration.number("unseen.brighter")
_LEAST_PART = calibration.number("unseen.least_part")
_DEVIATION = calibration.number("unseen.deviation")
_MOST_OPEN = calibration.number("unseen.most_open")
_MOST_ERROR = calibration.number("unseen.most_error")
# Rays from each texel that is asked, objects that may shine, and those whose light is traced.
_RAYS, _CANDIDATES, _TRACED = 256, 32, 8
_SEED = 0x1A3
# How roughly what a lamp brings tells even light from shadows' edges.
_ROUGHLY = Sampling(standard_error=0, max_rays=32)
# Texels from one to those beside it; by what share of the lamps' light and of all other light these
# may differ.
_AROUND = 2
_UNEVEN, _OF_OTHER_LIGHT = calibration.pair("unseen.uneven")
_LEAST_EVEN = calibration.number("unseen.least_even")


@dataclass(frozen=True, kw_only=True)
class UnseenLamps:
    """K objects that shine though no frame shows them: object (K,) int32, radiance (K, 3) float32
    W/(m^2 sr), and its relative standard error (K,)."""

    object: Int
    radiance: Float
    error: Float

    @classmethod
    def none(cls) -> UnseenLamps:
        return cls(
            object=np.zeros(0, np.int32),
            radiance=np.zeros((0, 3), np.float32),
            error=np.zeros(0, np.float32),
        )

    def error_of(self, index: int) -> float:
        """Of one object; NaN where it is none of them."""
        own = np.flatnonzero(self.object == index)
        return float(self.error[own[0]]) if len(own) else float("nan")

    def with_light(self, texels: Texels, lit: Float) -> Float:
        """``lit`` (T, 3) with these lamps in it."""
        if not len(self.object):
            return lit
        lit = lit.copy()
        for index, radiance in zip(self.object, self.radiance, strict=True):
            lit[texels.of_object(int(index))] = radiance
        return lit


def estimate_unseen_lamps(
    run: TaskRun,
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    frames: Frames,
    seed: int,
    dark: Sequence[int] = (),
) -> UnseenLamps:
    """Of a closed scan with the radiance ``lit`` (T, 3); the objects ``dark`` are none."""

    def compute() -> dict[str, Array]:
        return dict(vars(lamps_that_explain(surface, lit, coverage, frames, seed, dark)))

    found = UnseenLamps(**run.checkpoint("unseen", compute))
    if len(found.object):
        say(f"shade: {len(found.object)} lamps that no frame shows, by the light that they cast")
    return found


def lamps_that_explain(
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    frames: Frames,
    seed: int,
    dark: Sequence[int] = (),
) -> UnseenLamps:
    """The unseen objects that must shine for plain surfaces to be plain, without those that are
    known to be ``dark``."""
    texels = surface.texels
    owner = texels.object_index()
    area, observed = (
        np.bincount(owner, weights, len(texels.resolution))
        for weights in (texels.area, texels.area * coverage.observed)
    )
    seen = observed / np.maximum(area, 1e-12)
    seen[list(dark)] = 1.0
    asked = asked_texels(texels, lit, coverage, seed)
    if asked is None or not (seen < _UNSEEN).any():
        return UnseenLamps.none()
    share, open_share = _shares(surface, asked, seen < _UNSEEN, seed)
    if open_share > _MOST_OPEN:
        return UnseenLamps.none()
    brings = share.mean(axis=1)
    candidates = np.argsort(-brings, kind="stable")[:_CANDIDATES]
    candidates = candidates[brings[candidates] > _LEAST_SHARE * np.pi]
    if not len(candidates):
        return UnseenLamps.none()
    # Few rays meet a lamp, and errors of what it brings draw its strength to nothing: they only
    # say which of the objects may be one.
    asked = _beside_candidates(surface, lit, asked, candidates, seed)
    found, _, near, part = _strengths(asked, _unknown(asked, share[candidates]))
    likely = np.where(np.pi * found.mean(axis=1) > near, part, 0)
    likeliest = np.argsort(-likely, kind="stable")[:_TRACED]
    likeliest = likeliest[likely[likeliest] > _LEAST_PART / 4]
    candidates, strength = candidates[likeliest], found[likeliest].mean(axis=1)
    while len(candidates):
        even, sources = _looked_at_closely(surface, lit, frames, asked, candidates, strength, seed)
        found, error, near, part = _strengths(even, sources)
        # Clearly brighter than what only reflects: even with as much light as the texels that see
        # it receive.
        brightness = np.log(np.pi * found.mean(axis=1) / near)
        lamp = (brightness > np.log(_BRIGHTER)) & (part > _LEAST_PART)
        if lamp.all():  # none of the others blurs what these are any more
            lamp = (brightness > 2 * error) & (error < _MOST_ERROR)
        if lamp.all():
            order = np.argsort(candidates)
            return UnseenLamps(
                object=candidates[order].astype(np.int32),
                radiance=found[order].astype(np.float32),
                error=error[order].astype(np.float32),
            )
        candidates, strength = candidates[lamp], found[lamp].mean(axis=1)
    return UnseenLamps.none()


def _shares(surface: TexturedScene, asked: Asked, unseen: Bool, seed: int) -> tuple[Double, float]:
    """(num_objects, N) W/m^2: what each unseen object of radiance 1 brings to the texels asked; and
    the share of the light's directions that leave the scan."""
    count = len(asked.texel)
    _, face = looked_around(surface, asked.texel, seed ^ _SEED, _RAYS)
    met = np.where(face >= 0, surface.scene.face_object[np.maximum(face, 0)], -1)
    kept = (met >= 0) & unseen[met]
    place = met[kept].astype(np.int64) * count + np.arange(len(met))[kept] % count
    number = np.bincount(place, minlength=len(unseen) * count)
    brought = np.asarray(np.pi / _RAYS * number.reshape(len(unseen), count), np.float64)
    return brought, float((face < 0).mean())


def _beside_candidates(
    surface: TexturedScene, lit: Float, asked: Asked, candidates: Long, seed: int
) -> Asked:
    """The texels asked with S of all but the candidates."""
    rest = Shining.of(surface, _without(surface, lit, candidates))
    known = irradiance_of_texels(surface, rest, black_environment(), asked.texel, seed)
    floor = 1e-4 * np.median(asked.reflected)
    return asked._replace(irradiance=np.maximum(known, floor).astype(np.float64))


def _without(surface: TexturedScene, lit: Float, objects: Long) -> Float:
    of_objects = np.isin(surface.texels.object_index(), objects)
    return np.where(of_objects[:, None], np.float32(0), lit)


def _looked_at_closely(
    surface: TexturedScene,
    lit: Float,
    frames: Frames,
    asked: Asked,
    candidates: Long,
    strength: Double,
    seed: int,
) -> tuple[Asked, Sources]:
    """What the candidates bring, by rays that are sent to them, to texels that lie evenly in their
    light, and what surfaces mirror of it and of all other light. strength (K,): the candidates'
    radiance so far."""
    asked = _beside_candidates(surface, lit, asked, candidates, seed)
    alone = [_alone(surface, int(k)) for k in candidates]
    lights = [Shining.of(surface, light) for light in alone]
    even = _evenly_lit(surface, asked, lights, strength, seed)
    asked = asked.of(even)
    texel, seed = asked.texel, seed ^ _SEED
    share = [
        _brought(surface, light, texel, seed + int(k))
        for k, light in zip(candidates, lights, strict=True)
    ]
    rest = _without(surface, lit, candidates)
    mirrored = np.pi * mirrored_to_frames(surface, rest, frames, texel, seed)
    sent_on = [
        mirrored_irradiance(surface, light, texel, seed + int(k))[:, 0]
        for k, light in zip(candidates, alone, strict=True)
    ]
    asked = asked._replace(mirrored=mirrored)
    return asked, gloss_of_scene(asked, _unknown(asked, np.stack(share)), np.stack(sent_on))


def _alone(surface: TexturedScene, index: int) -> Float:
    """(T, 3): an object of radiance 1 in the dark."""
    alone = surface.texels.object_index() == index
    return np.repeat(alone[:, None].astype(np.float32), 3, axis=1)


def _brought(
    surface: TexturedScene, light: Shining, texel: Long, seed: int, sampling: Sampling = CLOSELY
) -> Double:
    """(N,) W/m^2: what grey ``light`` brings, by rays that are sent to it."""
    found = irradiance_of_texels(surface, light, black_environment(), texel, seed, sampling)
    return np.asarray(found[:, 0], np.float64)


def _evenly_lit(
    surface: TexturedScene, asked: Asked, lights: Sequence[Shining], strength: Double, seed: int
) -> Bool:
    """Which of the texels asked, (N,), lie among others that are as much lit: a pixel beside a
    shadow's edge mixes light and shadow, and a lamp that casts mixed ones comes out too dim.
    Segments of which few are measured leave; if too few were left in all, all stay."""
    total, most = np.zeros(len(asked.texel)), np.zeros(len(asked.texel))
    for light, radiance in zip(lights, strength, strict=True):
        # The same rays from each, so that their noise is the same.
        own = _brought(surface, light, asked.texel, seed, _ROUGHLY)
        total += radiance * own
        uneven = np.zeros(len(own))
        for beside in surface.texels.around(asked.texel, _AROUND):
            other = _brought(surface, light, beside, seed, _ROUGHLY)
            uneven = np.maximum(uneven, np.abs(other - own))
        most += radiance * uneven
    even = most <= _UNEVEN * total + _OF_OTHER_LIGHT * asked.irradiance.mean(axis=1)
    count = np.bincount(
        asked.segment[even & ~asked.clipped], minlength=int(asked.segment.max()) + 1
    )
    even &= count[asked.segment] >= LEAST_OF_SEGMENT // 2
    return even if even.mean() > _LEAST_EVEN else np.ones_like(even)


def _unknown(asked: Asked, share: Double) -> Sources:
    """Sources that bring ``share`` (K, N), of which nothing else is known."""
    usual, count = np.log(np.median(asked.reflected, axis=0) / np.pi), len(share)
    return Sources(
        share=share,
        mean=np.tile(usual, (count, 1)),
        deviation=np.full(count, _DEVIATION),
        bound=np.zeros(count, np.bool_),
        pairs=np.zeros((0, 2), np.int64),
        apart=np.zeros(0),
    )


def _strengths(asked: Asked, sources: Sources) -> tuple[Double, Double, Double, Double]:
    """Radiance (K, 3) of the sources, its relative error (K,), S (K,) of the texels that they
    light, each as much as it does, and what part of all light is theirs, (K,)."""
    found = solved(asked, sources)
    error = jackknife(asked, sources, found).max(axis=1)
    light = (asked.irradiance + sources.irradiance(found.log_radiance)).mean(axis=1)
    radiance = np.exp(found.log_radiance)
    part = (sources.share * radiance.mean(axis=1)[:, None] / light).mean(axis=1)
    near = (sources.share @ light) / np.maximum(sources.share.sum(axis=1), 1e-12)
    return radiance, np.asarray(error), np.asarray(near), np.asarray(part)
