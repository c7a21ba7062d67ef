"""Values for texels that nobody saw, from the nearest seen ones of the same object: of those far
away from as large a part of them as they are away, since single texels say little about what is
not beside them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float, Long
from usdbrdf.model.texels import Texels

# Texels that a fill is the mean of, and one from afar: there few that mix with what is behind them,
# as the edges of blinds do with the sky, would tell of a whole side, which the sun may lie on.
_NEIGHBOURS, _FROM_AFAR = 8, 32
_NORMAL_WEIGHT = calibration.number("inpaint.normal_weight")
_TELLING = calibration.count("inpaint.telling")
_TELLING_SHARE = calibration.number("inpaint.telling_share")
# Zero has no logarithm: it counts as this share of the median of all known positive values.
_ZERO = 1e-6
# How much further off than the nearest a texel may lie that is taken for it, which halves the time.
_SLACK = 0.25
# Texels filled at a time, which bounds what their neighbours take.
_AT_A_TIME = 1 << 16
# How many times fewer sources each level has than the one before, and how many the last, at least.
_COARSER, _FEWEST, _SEED = 4, 32, 0
# Of more known texels than this in an object, evenly many are left out: among so many the nearest
# is never far.
_MOST_SOURCES = 1 << 18


def telling(num_texels: npt.ArrayLike) -> Double:
    """How many of an object's texels must tell something of it, by their number in all: a few, of
    much that nobody saw, are as often a neighbour's pixels."""
    return np.minimum(_TELLING, _TELLING_SHARE * np.asarray(num_texels))


def inpaint(texels: Texels, values: Float, known: Bool) -> Float:
    """Fill ``values`` (T, 3) where ``known`` (T,) is False; known ones are returned unchanged.

    Geometric mean of known texels of the same object that are near in position and normal: the 8
    nearest ones, or for a texel at a distance 32, evenly over an area of about that size. An object
    of which nothing is known takes the nearest known texels of the scene; a scene of which nothing
    is known, or only black, becomes zero. Values in another unit give the same fill in that
    unit.
    """
    return inpaint_alike(texels, [values], known)[0]


def inpaint_alike(texels: Texels, maps: Sequence[Float], known: Bool) -> list[Float]:
    """``inpaint`` of several maps that are known at the same texels."""
    filled = [np.where(known[:, None], values, 0).astype(np.float32) for values in maps]
    floors = []
    for values in filled:
        positive = values[values > 0]
        middle = np.median(positive, overwrite_input=True) if len(positive) else 0
        floors.append(float(_ZERO * middle))
    orphans = []
    for i in range(len(texels.resolution)):
        own = np.arange(*texels.of_object(i).indices(len(texels)))
        missing, source = own[~known[own]], own[known[own]]
        if not len(missing):
            continue
        if not len(source):
            orphans.append(missing)
            continue
        position = texels.position[own]
        weight = _NORMAL_WEIGHT * float(np.linalg.norm(np.ptp(position, axis=0)))
        _fill(texels, filled, floors, source, missing, weight)
    if orphans and known.any():
        _fill(texels, filled, floors, np.flatnonzero(known), np.concatenate(orphans), 0.0)
    return filled


class _Sources(NamedTuple):
    """Known texels (N,), and where they are."""

    texel: Long
    tree: cKDTree

    @classmethod
    def at(cls, texel: Long, places: Callable[[Long], Float]) -> _Sources:
        return cls(texel, cKDTree(places(texel), balanced_tree=False, compact_nodes=False))

    def near(self, places: Float, count: int) -> tuple[Double, Long]:
        """Of each place the distance (M,) of the nearest, and as many of the nearest (M, k)."""
        k = min(count, len(self.texel))
        distance, nearest = self.tree.query(places, k=k, eps=_SLACK, workers=-1)
        return distance.reshape(len(places), k)[:, 0], self.texel[nearest.reshape(len(places), k)]


def _fill(
    texels: Texels,
    filled: Sequence[Float],
    floors: Sequence[float],
    source: Long,
    missing: Long,
    normal_weight: float,
) -> None:
    """Set the ``missing`` texels of all maps from the nearest of ``source``."""

    def feature(index: Long) -> Float:
        return np.concatenate(
            [texels.position[index], normal_weight * texels.normal[index]], axis=-1
        )

    area = float(texels.area[source].sum())
    source = source[:: -(-len(source) // _MOST_SOURCES)]
    spacing = math.sqrt(area / len(source))
    # Each level has a part of the one before, evenly: its sources lie that much further apart.
    mixed = np.random.default_rng(_SEED).permutation(source)
    counts = [len(source)]
    while counts[-1] > _COARSER * _FEWEST:
        counts.append(counts[-1] // _COARSER)
    levels = [_Sources.at(np.sort(mixed[:count]), feature) for count in counts]
    for start in range(0, len(missing), _AT_A_TIME):
        some = missing[start : start + _AT_A_TIME]
        places = feature(some)
        distance, neighbours = levels[0].near(places, _NEIGHBOURS)
        # Sources in a circle around it with half the distance as its radius, for each of its mean.
        many = np.pi / 4 / _FROM_AFAR * (distance / max(spacing, 1e-30)) ** 2
        level = (np.log(np.maximum(many, 1)) / math.log(_COARSER)).astype(np.int64)
        level = np.minimum(level, len(levels) - 1)
        beside = many < 1
        fills = [(some[beside], neighbours[beside])]
        for number, sources in enumerate(levels):
            own = np.flatnonzero(~beside & (level == number))
            if len(own):
                fills.append((some[own], sources.near(places[own], _FROM_AFAR)[1]))
        for values, floor in zip(filled, floors, strict=True):
            for own, neighbours in fills if floor > 0 else ():
                logarithm = np.log(np.maximum(values[neighbours], floor), dtype=np.float64)
                values[own] = np.exp(logarithm.mean(axis=1))
