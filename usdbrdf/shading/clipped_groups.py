"""Texels that clip in every frame, in groups: each a lamp that may be, or part of a bright wall."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.shading.clipped_emitters import LAMP_PRIOR
from usdbrdf.shading.lamp_light import Lamps

_MIN_TEXELS = calibration.count("lamps.min_texels")
_SHOWN_OF_SMALL = calibration.number("lamps.shown_of_small")
# More lamps are not told apart; the faintest keep their bounds.
_MAX_GROUPS = 24
_REACH = calibration.number("lamps.reach")
_NEARLY = calibration.number("lamps.nearly_as_bright")
_AROUND = calibration.number("lamps.around")
_WALL_PRIOR = calibration.pair("lamps.wall_prior")


@dataclass(frozen=True, kw_only=True)
class ClippedGroups:
    """K groups of texels with one radiance each.

    group  (T,) int32, -1 for a texel of none
    object (K,) int32, whose texels they are
    bound  (K,) float32, the largest radiance at which one of its texels clipped
    lamp   (K,) bool: no measured texel around is nearly as bright, nor does daylight explain it
    small  (K,) bool: of so few texels that it may be a glint as well
    wall   (T,) bool: the texels of those that are no lamps, of fainter ones than the K too
    """

    group: Int
    object: Int
    bound: Float
    lamp: Bool
    small: Bool
    wall: Bool

    def __len__(self) -> int:
        return len(self.object)

    def texels_of(self, which: Bool) -> Bool:
        """(T,): the texels of those of the groups (K,)."""
        return np.asarray(np.append(which, False)[self.group], np.bool_)

    def without(self, which: Bool) -> ClippedGroups:
        """The same, but texels of those of the groups (K,) are of none."""
        return replace(self, group=np.where(self.texels_of(which), np.int32(-1), self.group))

    def with_walls(self, which: Bool) -> ClippedGroups:
        """The same where those of the groups (K,) are no lamps."""
        wall = self.wall | self.texels_of(which)
        return replace(self, lamp=self.lamp & ~which, wall=wall)

    def priors(self) -> Double:
        """(K, 2): of the logarithms of what multiplies their bounds, before the evidence."""
        return np.array([LAMP_PRIOR if lamp else _WALL_PRIOR for lamp in self.lamp])

    def as_lamps(self, which: Long) -> Lamps:
        """The groups with the numbers ``which`` (N,), as what is known of lamps that clip."""
        number = np.full(len(self) + 1, -1, np.int32)
        number[which] = np.arange(len(which))
        bound = np.log(self.bound[which].astype(np.float64))
        before = np.tile(bound[:, None] + LAMP_PRIOR[0], (1, 3))
        deviation = np.full(len(which), LAMP_PRIOR[1])
        return Lamps(number[self.group], before, deviation, self.lamp[which])


def clipped_groups(
    texels: Texels,
    radiance: Float,
    coverage: CoverageMap,
    said: Mapping[int, bool] = MappingProxyType({}),
    hardly_shown: Collection[int] = (),
) -> ClippedGroups:
    """An object more than half of whose observed area clipped is one group, with what nobody saw
    of it; on others each connected part is one. Few texels are none, unless they are all that was
    seen of an object, and enough of it, or it is one of those ``hardly_shown``, or a person says
    that it is a lamp.

    radiance (T, 3): L_d, a lower bound where ``coverage`` says clipped
    said     of objects whether they are lamps, where that is known
    """
    found: list[tuple[float, int, float, bool, bool, Long]] = []
    measured, clipped = coverage.measured, coverage.clipped
    bright = radiance.max(axis=1)
    reach, shown = _AROUND * float(np.sqrt(texels.area.sum())), _clips_alone(texels, coverage)[1]
    for i in range(len(texels.resolution)):
        own = np.arange(*texels.of_object(i).indices(len(texels)))
        candidates, around = own[clipped[own]], own[measured[own]]
        shines = texels.area[candidates].sum()
        whole, small = shines > texels.area[around].sum(), len(candidates) < _MIN_TEXELS
        if small and not (whole and said.get(i, bool(shown[i]) or i in hardly_shown)):
            continue
        parts = [own[~measured[own]]] if whole else _connected(texels, candidates)
        for part in parts:
            bound, lamp = float(bright[part][clipped[part]].max()), bool(whole)
            if not lamp:  # one that stands out from what is around it
                distance, _ = cKDTree(texels.position[part]).query(texels.position[around])
                near = bright[around[distance < reach]]
                lamp = not len(near) or float(np.median(near)) < _NEARLY * bound
            lamp = said.get(i, lamp)
            # What it may send at most, by all likelihood.
            most = bound * float(np.exp(sum(LAMP_PRIOR if lamp else _WALL_PRIOR)))
            found.append((most * float(texels.area[part].sum()), i, bound, lamp, small, part))
    wall = np.zeros(len(texels), np.bool_)
    for *_, lamp, _, part in found:
        wall[part] = not lamp
    found = sorted(found, key=lambda item: -item[0])[:_MAX_GROUPS]
    group = np.full(len(texels), -1, np.int32)
    for k, item in enumerate(found):
        group[item[-1]] = k
    return ClippedGroups(
        group=group,
        object=np.array([item[1] for item in found], np.int32),
        bound=np.array([item[2] for item in found], np.float32),
        lamp=np.array([item[3] for item in found], np.bool_),
        small=np.array([item[4] for item in found], np.bool_),
        wall=wall,
    )


def hardly_shown(texels: Texels, coverage: CoverageMap, said: Mapping[int, bool]) -> Long:
    """Numbers of the objects of which few texels clip and no others are seen, and hardly any of
    it: spots seen from the side, or glints. None of those that are ``said`` to be lamps or not."""
    number, shown = _clips_alone(texels, coverage)
    few = (number > 0) & (number < _MIN_TEXELS) & ~shown
    few[[*said]] = False
    return np.flatnonzero(few)


def _clips_alone(texels: Texels, coverage: CoverageMap) -> tuple[Long, Bool]:
    """Of each object: how many texels clip, 0 where others are measured; and whether these are
    enough of it for a lamp, however few."""
    owner, count = texels.object_index(), len(texels.resolution)
    clipped, measured = (
        np.bincount(owner[kind], minlength=count) for kind in (coverage.clipped, coverage.measured)
    )
    area, shines = (
        np.bincount(owner, weights, count)
        for weights in (texels.area, texels.area * coverage.clipped)
    )
    number = np.where(measured == 0, clipped, 0)
    return number, (number > 0) & (shines > _SHOWN_OF_SMALL * area)


def _connected(texels: Texels, candidates: Long) -> list[Long]:
    """Parts of at least _MIN_TEXELS that touch in space, across the charts of the atlas."""
    reach = _REACH * float(np.sqrt(np.median(texels.area[candidates])))
    pairs = cKDTree(texels.position[candidates]).query_pairs(reach, output_type="ndarray")
    graph = coo_array(
        (np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(candidates),) * 2
    )
    count, label = connected_components(graph, directed=False)
    parts = [candidates[label == k] for k in range(count)]
    return [part for part in parts if len(part) >= _MIN_TEXELS]


def with_unseen(texels: Texels, part: Long, observed: Long, unseen: Long) -> Long:
    """A lamp's texels, with those that no frame shows to which they are the nearest observed ones:
    in units of the lamp's own radius, or of how far a normal turns by 60 degrees, and by no more
    than one."""
    radius = float(np.sqrt(texels.area[part].sum() / np.pi))
    low, high = texels.position[part].min(axis=0), texels.position[part].max(axis=0)

    def within(index: Long, reach: float) -> Long:
        at = texels.position[index]
        return index[np.all((at >= low - reach) & (at <= high + reach), axis=1)]

    def place(index: Long) -> Float:
        return np.hstack([texels.position[index] / radius, texels.geometric_normal[index]])

    # A wall has millions of texels: what is farther off than this is in no one's reach.
    unseen, observed = within(unseen, radius), within(observed, 2 * radius)
    if not len(unseen) or not radius:
        return part
    distance, nearest = cKDTree(place(observed)).query(place(unseen), distance_upper_bound=1.0)
    near = np.isfinite(distance)
    near[near] = np.isin(observed[nearest[near]], part)
    return np.sort(np.concatenate([part, unseen[near]]))
