"""Lamps that no frame shows, from the light that they cast: a ceiling light above all pictures.

Objects of which frames show nothing are sources of unknown strength. As for light from outside,
what texels reflect tells it: pi L_d = albedo (S_seen + sum_k g_k B_k), by least squares on the
logarithms with one albedo for each facing of an object. What comes out much brighter than anything
that only reflects could be where it is shines by itself; the others reflect what they receive.
Lamps that clip are unknown as well meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.shading.asked import asked_texels
from usdbrdf.shading.clipped_emitters import UNTOLD
from usdbrdf.shading.clipped_groups import clipped_groups
from usdbrdf.shading.lamp_light import (
    LEAST_PART,
    MOST_OF_CERTAIN,
    ROUGHLY,
    beside_lamps,
    brought,
    known_well,
    looked_at_closely,
    shining,
    sources_of,
    strengths,
)
from usdbrdf.shading.likely_lamps import likely_lamps, strongest, unseen_objects
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lit_scene import TexturedScene

_MOST_ERROR = calibration.number("unseen.most_error")


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
    name: str,
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    frames: Frames,
    environment: Environment,
    seed: int,
    said: Mapping[int, bool] = MappingProxyType({}),
) -> UnseenLamps:
    """Of a scan with the radiance ``lit`` (T, 3), in the ``environment``; kept under ``name``.
    said: of objects whether they are lamps, where that is known."""

    def compute() -> dict[str, Array]:
        found = lamps_that_explain(surface, lit, coverage, frames, environment, seed, said)
        return dict(vars(found))

    return UnseenLamps(**run.checkpoint(name, compute))


def lamps_that_explain(
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    frames: Frames,
    environment: Environment,
    seed: int,
    said: Mapping[int, bool] = MappingProxyType({}),
) -> UnseenLamps:
    """The unseen objects that must shine for plain surfaces to be plain, without those that are
    said to be none."""
    texels = surface.texels
    unseen = unseen_objects(texels, coverage, said)
    asked = asked_texels(texels, lit, coverage, seed)
    if asked is None or not len(unseen):
        return UnseenLamps.none()
    groups = clipped_groups(texels, lit, coverage, said)
    asked = asked.of(~groups.texels_of(groups.lamp)[asked.texel])
    likely = likely_lamps(surface, lit, environment, asked, unseen, groups, said, seed)
    if not len(likely.object):
        return UnseenLamps.none()
    likely = likely._replace(clipped=strongest(groups))
    lamps = likely.as_lamps(texels, groups, said)
    asked = beside_lamps(surface, lit, environment, asked, lamps, seed)
    roughly = brought(surface, lamps, asked.texel, seed, ROUGHLY)
    # Errors of what a lamp brings draw its strength to nothing: this only says which may be one.
    found, error, near, part = strengths(asked, sources_of(lamps, roughly), lamps.certain)
    part = np.where((np.pi * found.mean(axis=1) > near) & (error < 1), part, 0)
    part = part[: len(likely.object)]
    likeliest = np.argsort(-part, kind="stable")
    kept = likeliest[(part > LEAST_PART / 2)[likeliest] | lamps.certain[likeliest]]
    while len(kept):
        strength = np.append(found[kept], found[len(likely.object) :], axis=0).mean(axis=1)
        likely = likely.of(kept)
        lamps = likely.as_lamps(texels, groups, said)
        found, error, near, part = looked_at_closely(
            surface, lit, environment, frames, asked, lamps, strength, seed
        )
        own = slice(len(likely.object))
        certain = lamps.certain[own]
        lamp = shining(found, near, part)[own] | certain
        if lamp.all():  # none of the others blurs what these are any more
            brightness = np.log(np.pi * found.mean(axis=1) / near)[own]
            lamp = (brightness > 2 * error[own]) & known_well(error[own], part[own], _MOST_ERROR)
            lamp |= certain & (error[own] < MOST_OF_CERTAIN)
        if lamp.all():
            order = np.argsort(likely.object)
            return UnseenLamps(
                object=likely.object[order].astype(np.int32),
                radiance=found[order].astype(np.float32),
                error=np.hypot(error[order], UNTOLD).astype(np.float32),
            )
        kept = np.flatnonzero(lamp)
    return UnseenLamps.none()
