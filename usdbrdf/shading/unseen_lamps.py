"""Lamps that no frame shows, from the light that they cast: a ceiling light above all pictures.

Objects of which frames show nothing are sources of unknown strength. As for light from outside,
what texels reflect tells it: pi L_d = albedo (S_seen + sum_k g_k B_k), by least squares on the
logarithms with one albedo for each facing of an object. What comes out much brighter than anything
that only reflects could be where it is shines by itself; the others reflect what they receive.
Lamps that clip are unknown as well meanwhile. Light from outside that is inferred likewise is not
told from lamps that no frame shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.shading.asked import asked_texels, first_of_segments, looked_around
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
from usdbrdf.shading.outside_light import Asked, medians_of_segments
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.rays import lift_from_surface

_UNSEEN = calibration.number("unseen.most_seen")
_BRIGHTER = calibration.number("unseen.brighter")
_LEAST_PART = calibration.number("unseen.least_part")
_DEVIATION = calibration.number("unseen.deviation")
_MOST_OPEN = calibration.number("unseen.most_open")
_MOST_ERROR = calibration.number("unseen.most_error")
# Rays that look around from each texel that is asked; objects that may shine, at most, and by how
# much likelier they must make what is seen; lamps that clip, the strongest.
_RAYS, _CANDIDATES, _LEAST_GAIN, _CLIPPED = 64, 8, 10.0, 4
# Which may shine so many texels of a segment tell, each by rays to few points of every object, then
# to more of those that bring most, and for radiances from one to the other, next to that with which
# an object would bring as much as all else.
_FEW_OF_SEGMENT, _FEW_POINTS, _POINTS, _MANY = 24, 4, 64, 64
_TRIED = np.geomspace(1 / 8, 64, 10)
# Nearer points than this share of the scene's size count as that far; what is met before this share
# of the way hides one; and no segment errs less than by this.
_NEAREST, _REACHED, _LEAST_OFF = 1e-4, 0.99, 0.01
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
    if _open_share(surface, asked, seed) > _MOST_OPEN and (outside is None or outside.is_inferred):
        return UnseenLamps.none()
    groups = clipped_groups(texels, lit, coverage, said)
    asked = asked.of(~groups.texels_of(groups.lamp)[asked.texel])
    environment = outside.environment if outside else black_environment()
    unseen = np.flatnonzero(seen < _UNSEEN)
    candidates, usual = _candidates(surface, lit, environment, asked, unseen, groups, said, seed)
    if not len(candidates):
        return UnseenLamps.none()
    lamps = _unknown(texels, candidates, usual, groups, said)
    asked = beside_lamps(surface, lit, environment, asked, lamps, seed)
    roughly = brought(surface, lamps, asked.texel, seed, ROUGHLY)
    # Errors of what a lamp brings draw its strength to nothing: this only says which may be one.
    found, error, near, part = strengths(asked, sources_of(lamps, roughly), lamps.certain)
    likely = np.where((np.pi * found.mean(axis=1) > near) & (error < 1), part, 0)
    likely = likely[: len(candidates)]
    likeliest = np.argsort(-likely, kind="stable")
    kept = likeliest[likely[likeliest] > _LEAST_PART / 2]
    while len(kept):
        strength = np.append(found[kept], found[len(candidates) :], axis=0).mean(axis=1)
        candidates, usual = candidates[kept], usual[kept]
        lamps = _unknown(texels, candidates, usual, groups, said)
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


def _open_share(surface: TexturedScene, asked: Asked, seed: int) -> float:
    """The share of the light's directions that leave the scan."""
    _, face = looked_around(surface, asked.texel, seed ^ _SEED, _RAYS)
    return float((face < 0).mean())


def _candidates(
    surface: TexturedScene,
    lit: Float,
    environment: Environment,
    asked: Asked,
    unseen: Long,
    groups: ClippedGroups,
    said: Mapping[int, bool],
    seed: int,
) -> tuple[Long, Double]:
    """Of the objects ``unseen`` those that explain most if they shine, (K,), the best first, and of
    each the logarithm of the radiance with which it would bring as much as all else to the texels
    that see it, (K, 3): in itself a lamp may be as bright as it is small."""
    nothing = np.zeros((len(unseen), 3))
    lamps = _unknown(surface.texels, unseen, nothing, groups, said)
    segments = np.arange(int(asked.segment.max()) + 1)
    each = np.arange(len(asked.texel))
    some = np.sort(first_of_segments(each, asked.segment, segments, _FEW_OF_SEGMENT))
    few = beside_lamps(surface, lit, environment, asked.of(some), lamps, seed)
    # Those that clip are among them, lest another stands for their light. Of what is large or near
    # a few points tell little: what brings most is looked at again, and what was chosen.
    every = range(len(lamps.mean))
    roughly = _shares(surface, few, lamps, every, _FEW_POINTS, seed)
    brightest = np.argsort(-roughly.mean(axis=1), kind="stable")[:_MANY]
    pool = np.union1d(np.array(_likeliest(few, roughly), np.int64), brightest)
    share = np.zeros_like(roughly)
    share[pool] = _shares(surface, few, lamps, pool.tolist(), _POINTS, seed)
    by_hand = [k for k, number in enumerate(unseen.tolist()) if said.get(number) and share[k].any()]
    chosen = dict.fromkeys([*by_hand, *_likeliest(few, share)])
    best = np.array([k for k in chosen if k < len(unseen)][:_CANDIDATES], np.int64)
    usual, rest = np.zeros((len(best), 3)), np.log(few.irradiance)
    for level, own in zip(usual, share[best], strict=True):
        sees = np.flatnonzero(own)
        level[:] = np.median(rest[sees] - np.log(own[sees])[:, None], axis=0)
    return unseen[best], usual


def _shares(
    surface: TexturedScene, asked: Asked, lamps: Lamps, which: Sequence[int], points: int, seed: int
) -> Double:
    """(W, N) W/m^2: what each of the lamps with the numbers ``which`` (W,), of radiance 1, brings
    to the texels asked, by rays to so many of its points: it may be as small as it likes, if it is
    bright."""
    texels, random = surface.texels, np.random.default_rng(seed ^ _SEED)
    normal, owner = texels.normal[asked.texel], texels.object_index()
    origin = lift_from_surface(texels.position[asked.texel], normal, surface.diagonal_m)
    shining = np.flatnonzero((lamps.of >= 0) & (texels.area > 0))
    shining = shining[np.argsort(lamps.of[shining], kind="stable")]
    ends = np.searchsorted(lamps.of[shining], np.arange(len(lamps.mean) + 1))
    brought = np.zeros((len(which), len(origin)))
    for share, number in zip(brought, which, strict=True):
        own = shining[ends[number] : ends[number + 1]]
        below, thing = np.cumsum(texels.area[own], dtype=np.float64), owner[own[:1]]
        for part in range(points if len(own) else 0):
            at = below[-1] * (part + random.random(len(origin))) / points
            point = own[np.searchsorted(below[:-1], at)]
            towards = texels.position[point] - origin
            distance = np.maximum(np.linalg.norm(towards, axis=1), _NEAREST * surface.diagonal_m)
            towards = towards / distance[:, None]
            cosines = (towards * normal).sum(axis=1), -(towards * texels.normal[point]).sum(axis=1)
            facing = np.maximum(cosines, 0).prod(axis=0)
            sent = np.where(facing[:, None] > 0, towards, 0).astype(np.float32)
            hits = surface.rays.closest(origin, sent)
            met = (hits.face >= 0) & (surface.scene.face_object[np.maximum(hits.face, 0)] == thing)
            met &= hits.distance > _REACHED * distance
            share += np.minimum(met * facing * below[-1] / distance**2, np.pi) / points
    return brought


def _likeliest(asked: Asked, share: Double) -> list[int]:
    """Which sources of share (K, N) make what the texels reflect likelier if they shine, as strong
    as is likeliest, one after the other: the next is the one that adds most to those before it."""
    plain = np.flatnonzero(~asked.clipped)
    asked, share = asked.of(plain), share[:, plain]
    reflected = np.log(asked.reflected).mean(axis=1)
    chosen, light = list[int](), asked.irradiance.mean(axis=1)
    left = np.flatnonzero((share > 0).sum(axis=1) >= _FEW_OF_SEGMENT // 2)
    while len(left) and len(chosen) < _CANDIDATES:
        found = [_alone(reflected, asked.segment, light, share[k]) for k in left]
        gain = np.array([of_one for of_one, _ in found])
        best = int(gain.argmax())
        if gain[best] < _LEAST_GAIN:
            break
        chosen.append(int(left[best]))
        light = light + found[best][1] * share[left[best]]
        left = np.delete(left, best)
    return chosen


def _alone(reflected: Double, segment: Int, light: Double, share: Double) -> tuple[float, float]:
    """By how much likelier a source of share (N,) beside the ``light`` (N,) makes what the texels
    of a ``segment`` (N,) each reflect, a logarithm (N,), errors being Laplace's, of each segment
    its own; and the radiance at which it does."""
    size = np.bincount(segment)

    def cost(radiance: float) -> float:
        rest = reflected - np.log(light + radiance * share)
        off = np.abs(rest - medians_of_segments(rest, segment, len(size))[segment])
        mean = np.bincount(segment, off) / size
        return float(size @ np.log(np.maximum(mean, _LEAST_OFF)))

    usual = float(np.median(light[share > 0] / share[share > 0]))
    costs = [cost(usual * tried) for tried in _TRIED]
    return cost(0.0) - min(costs), usual * float(_TRIED[np.argmin(costs)])


def _unknown(
    texels: Texels, objects: Long, usual: Double, groups: ClippedGroups, said: Mapping[int, bool]
) -> Lamps:
    """Objects (K,) that may be lamps, of which nothing is known but the logarithm of the radiance
    that would be usual, (K, 3), and after them those that clip."""
    number = np.full(len(texels.resolution), -1, np.int32)
    number[objects] = np.arange(len(objects))
    clipped = groups.as_lamps(np.flatnonzero(groups.lamp)[:_CLIPPED])
    return Lamps(
        np.where(clipped.of >= 0, clipped.of + len(objects), number[texels.object_index()]),
        np.concatenate([usual, clipped.mean]),
        np.concatenate([np.full(len(objects), _DEVIATION), clipped.deviation]),
        np.array([*(said.get(int(i), False) for i in objects), *clipped.certain], np.bool_),
    )
