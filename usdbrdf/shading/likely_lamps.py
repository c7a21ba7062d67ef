"""Which objects that no frame shows, and which parts that clip in all of them, may be lamps: those
that make it likelier that plain surfaces are plain if they shine.

What a source brings to texels is told by rays to points of it, since it may be as small as it likes
if it is bright. The likeliest are chosen one after the other, each beside those before it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.shading.asked import first_of_segments
from usdbrdf.shading.clipped_groups import ClippedGroups, clipped_groups
from usdbrdf.shading.lamp_light import Lamps, beside_lamps
from usdbrdf.shading.outside_light import Asked, medians_of_segments
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.rays import lift_from_surface

_UNSEEN = calibration.number("unseen.most_seen")
_DEVIATION = calibration.number("unseen.deviation")
# Objects that may shine, at most, and by how much likelier they must make what is seen; lamps that
# clip, the strongest.
_CANDIDATES, _LEAST_GAIN, _CLIPPED = 8, 10.0, 4
# Which may shine so many texels of a segment tell, each by rays to few points of every object, then
# to more of those that bring most, and for radiances from one to the other, next to that with which
# an object would bring as much as all else.
_FEW_OF_SEGMENT, _FEW_POINTS, _POINTS, _MANY = 24, 4, 64, 64
_TRIED = np.geomspace(1 / 8, 64, 10)
# Nearer points than this share of the scene's size count as that far; what is met before this share
# of the way hides one; and no segment errs less than by this.
_NEAREST, _REACHED, _LEAST_OFF = 1e-4, 0.99, 0.01
_SEED = 0x1A3


class Likely(NamedTuple):
    """Objects that no frame shows and that may shine, (K,), the likeliest first; of each the
    logarithm of the radiance with which it would bring as much as all else to the texels that see
    it, (K, 3), for in itself a lamp may be as bright as it is small; and the parts that clip and
    may, (P,)."""

    object: Long
    usual: Double
    clipped: Long

    def of(self, which: Long) -> Likely:
        """Some of the objects, and all the parts."""
        return self._replace(object=self.object[which], usual=self.usual[which])

    def as_lamps(self, texels: Texels, groups: ClippedGroups, said: Mapping[int, bool]) -> Lamps:
        """What is known of them: the K objects, and after them the parts."""
        number = np.full(len(texels.resolution), -1, np.int32)
        number[self.object] = np.arange(len(self.object))
        clipped = groups.as_lamps(self.clipped)
        return Lamps(
            np.where(clipped.of >= 0, clipped.of + len(self.object), number[texels.object_index()]),
            np.concatenate([self.usual, clipped.mean]),
            np.concatenate([np.full(len(self.object), _DEVIATION), clipped.deviation]),
            np.array([*(said.get(int(i), False) for i in self.object), *clipped.certain], np.bool_),
        )


def unseen_objects(texels: Texels, coverage: CoverageMap, said: Mapping[int, bool]) -> Long:
    """Numbers of those of which frames show next to nothing, without those that are said to be no
    lamps."""
    owner = texels.object_index()
    area, observed = (
        np.bincount(owner, weights, len(texels.resolution))
        for weights in (texels.area, texels.area * coverage.observed)
    )
    seen = observed / np.maximum(area, 1e-12)
    seen[[i for i, shines in said.items() if not shines]] = 1.0
    return np.flatnonzero(seen < _UNSEEN)


def strongest(groups: ClippedGroups) -> Long:
    """Numbers of the lamps that clip, of which the others are told."""
    return np.flatnonzero(groups.lamp)[:_CLIPPED]


@dataclass(frozen=True)
class Beside:
    """What may light a scan beside daylight: ``likely``, of those ``groups`` that clip; and of
    objects whether they are lamps, where that is ``said``."""

    likely: Likely
    groups: ClippedGroups
    said: Mapping[int, bool]

    @property
    def count(self) -> int:
        """Of the objects and of the parts that clip."""
        return len(self.likely.object) + len(self.likely.clipped)

    def lamps(self, texels: Texels) -> Lamps:
        """What is known of them."""
        return self.likely.as_lamps(texels, self.groups, self.said)

    def of(self, shines: Bool) -> Beside:
        """With those of the objects that do."""
        return replace(self, likely=self.likely.of(np.flatnonzero(shines)))


def beside_daylight(
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    environment: Environment,
    asked: Asked,
    seed: int,
    said: Mapping[int, bool] = MappingProxyType({}),
) -> Beside:
    """What lights the scan of radiance ``lit`` (T, 3) beside the ``environment``, though that was
    to explain all of it."""
    groups = clipped_groups(surface.texels, lit, coverage, said)
    unseen = unseen_objects(surface.texels, coverage, said)
    asked = asked.of(~groups.texels_of(groups.lamp)[asked.texel])
    return Beside(
        likely_lamps(surface, lit, environment, asked, unseen, groups, said, seed), groups, said
    )


def likely_lamps(
    surface: TexturedScene,
    lit: Float,
    environment: Environment,
    asked: Asked,
    unseen: Long,
    groups: ClippedGroups,
    said: Mapping[int, bool],
    seed: int,
) -> Likely:
    """Of the objects ``unseen`` (N,) and the lamps that clip those that explain most if they
    shine."""
    every = Likely(unseen, np.zeros((len(unseen), 3)), strongest(groups))
    if not len(asked.texel) or not len(every.object) + len(every.clipped):
        return Likely(unseen[:0], every.usual[:0], every.clipped[:0])
    lamps = every.as_lamps(surface.texels, groups, said)
    segments = np.arange(int(asked.segment.max()) + 1)
    each = np.arange(len(asked.texel))
    some = np.sort(first_of_segments(each, asked.segment, segments, _FEW_OF_SEGMENT))
    few = beside_lamps(surface, lit, environment, asked.of(some), lamps, seed)
    # Those that clip are among them, lest another stands for their light. Of what is large or near
    # a few points tell little: what brings most is looked at again, and what was chosen.
    roughly = _shares(surface, few, lamps, range(len(lamps.mean)), _FEW_POINTS, seed)
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
    clipped = sorted(k - len(unseen) for k in chosen if k >= len(unseen))
    return Likely(unseen[best], usual, every.clipped[clipped])


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
            hits = surface.light_rays.closest(origin, sent)
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
