"""Lamps that no frame shows, from the light that they cast: a ceiling light above all pictures.

Objects of which frames show nothing are sources of unknown strength. As for light from outside,
what texels reflect tells it: pi L_d = albedo (S_seen + sum_k g_k B_k), by least squares on the
logarithms with one albedo for each facing of an object. What comes out much brighter than anything
that only reflects could be where it is shines by itself; the others reflect what they receive.
Lamps that clip are unknown as well meanwhile. Light from outside that is inferred likewise is not
told from lamps that no frame shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.shading.asked import asked_texels, looked_around
from usdbrdf.shading.clipped_light import ClippedGroups, clipped_groups
from usdbrdf.shading.lamp_light import (
    ROUGHLY,
    Lamps,
    beside_lamps,
    brought,
    looked_at_closely,
    sources_of,
    strengths,
)
from usdbrdf.shading.outside import Outside
from usdbrdf.shading.outside_light import Asked
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.lit_scene import TexturedScene

_UNSEEN = calibration.number("unseen.most_seen")
_LEAST_SHARE = calibration.number("unseen.least_share")
_BRIGHTER = calibration.number("unseen.brighter")
_LEAST_PART = calibration.number("unseen.least_part")
_DEVIATION = calibration.number("unseen.deviation")
_MOST_OPEN = calibration.number("unseen.most_open")
_MOST_ERROR = calibration.number("unseen.most_error")
# Rays from each texel that is asked, objects that may shine, and those whose light is traced; of
# lamps that clip, those with the most light.
_RAYS, _CANDIDATES, _TRACED, _CLIPPED = 256, 32, 8, 4
_SEED = 0x1A3


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
    outside: Outside | None,
    seed: int,
    said: Mapping[int, bool] = MappingProxyType({}),
) -> UnseenLamps:
    """Of a scan with the radiance ``lit`` (T, 3), before what is known of what lies ``outside``.
    said: of objects whether they are lamps, where that is known."""

    def compute() -> dict[str, Array]:
        found = lamps_that_explain(surface, lit, coverage, frames, seed, said, outside)
        return dict(vars(found))

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
    said: Mapping[int, bool] = MappingProxyType({}),
    outside: Outside | None = None,
) -> UnseenLamps:
    """The unseen objects that must shine for plain surfaces to be plain, without those that are
    said to be none."""
    texels = surface.texels
    owner = texels.object_index()
    area, observed = (
        np.bincount(owner, weights, len(texels.resolution))
        for weights in (texels.area, texels.area * coverage.observed)
    )
    seen = observed / np.maximum(area, 1e-12)
    seen[[i for i, shines in said.items() if not shines]] = 1.0
    asked = asked_texels(texels, lit, coverage, seed)
    if asked is None or not (seen < _UNSEEN).any():
        return UnseenLamps.none()
    share, open_share = _shares(surface, asked, seen < _UNSEEN, seed)
    if open_share > _MOST_OPEN and (outside is None or outside.is_inferred):
        return UnseenLamps.none()
    brings = share.mean(axis=1)
    candidates = np.argsort(-brings, kind="stable")[:_CANDIDATES]
    candidates = candidates[brings[candidates] > _LEAST_SHARE * np.pi]
    if not len(candidates):
        return UnseenLamps.none()
    groups = clipped_groups(texels, lit, coverage, said)
    asked = asked.of(~groups.texels_of(groups.lamp)[asked.texel])
    environment = outside.environment if outside else black_environment()
    lamps = _unknown(texels, asked, candidates, groups, said)
    asked = beside_lamps(surface, lit, environment, asked, lamps, seed)
    roughly = brought(surface, lamps, asked.texel, seed, ROUGHLY)
    # Errors of what a lamp brings draw its strength to nothing: this only says which may be one.
    found, error, near, part = strengths(asked, sources_of(lamps, roughly), lamps.certain)
    likely = np.where((np.pi * found.mean(axis=1) > near) & (error < 1), part, 0)
    likely = likely[: len(candidates)]
    likeliest = np.argsort(-likely, kind="stable")[:_TRACED]
    kept = likeliest[likely[likeliest] > _LEAST_PART / 2]
    while len(kept):
        strength = np.append(found[kept], found[len(candidates) :], axis=0).mean(axis=1)
        candidates = candidates[kept]
        lamps = _unknown(texels, asked, candidates, groups, said)
        found, error, near, part = looked_at_closely(
            surface, lit, environment, frames, asked, lamps, strength, seed
        )
        own = slice(len(candidates))
        # Clearly brighter than what only reflects: even with as much light as the texels that see
        # it receive.
        brightness = np.log(np.pi * found.mean(axis=1) / near)[own]
        lamp = (brightness > np.log(_BRIGHTER)) & (part[own] > _LEAST_PART)
        if lamp.all():  # none of the others blurs what these are any more
            lamp = (brightness > 2 * error[own]) & (error[own] < _MOST_ERROR)
        if lamp.all():
            order = np.argsort(candidates)
            return UnseenLamps(
                object=candidates[order].astype(np.int32),
                radiance=found[order].astype(np.float32),
                error=error[order].astype(np.float32),
            )
        kept = np.flatnonzero(lamp)
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


def _unknown(
    texels: Texels, asked: Asked, objects: Long, groups: ClippedGroups, said: Mapping[int, bool]
) -> Lamps:
    """Objects (K,) that may be lamps, of which nothing else is known, and after them those that
    clip."""
    usual = np.log(np.median(asked.reflected, axis=0) / np.pi)
    number = np.full(len(texels.resolution), -1, np.int32)
    number[objects] = np.arange(len(objects))
    clipped = groups.as_lamps(np.flatnonzero(groups.lamp)[:_CLIPPED])
    return Lamps(
        np.where(clipped.of >= 0, clipped.of + len(objects), number[texels.object_index()]),
        np.concatenate([np.tile(usual, (len(objects), 1)), clipped.mean]),
        np.concatenate([np.full(len(objects), _DEVIATION), clipped.deviation]),
        np.array([*(said.get(int(i), False) for i in objects), *clipped.certain], np.bool_),
    )
