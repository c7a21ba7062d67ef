"""Clipped texels that hang together, and whether they look like a lamp or like a bright wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Float, Int
from usdbrdf.model.texels import Texels

_MIN_TEXELS = calibration.count("lamps.min_texels")

# More lamps are not told apart; the faintest keep their bounds.
_MAX_GROUPS = 24

_REACH = calibration.number("lamps.reach")

_NEARLY = calibration.number("lamps.nearly_as_bright")

_AROUND = calibration.number("lamps.around")


@dataclass(frozen=True, kw_only=True)
class ClippedGroups:
    """K groups of texels with one radiance each.

    group  (T,) int32, -1 for a texel of none
    object (K,) int32, whose texels they are
    bound  (K,) float32, the largest radiance at which one of its texels clipped
    lamp   (K,) bool: no measured texel around is nearly as bright
    """

    group: Int
    object: Int
    bound: Float
    lamp: Bool

    def __len__(self) -> int:
        return len(self.object)


def clipped_groups(texels: Texels, radiance: Float, seen: Bool, clipped: Bool) -> ClippedGroups:
    """An object more than half of whose observed area clipped is one group, with what nobody saw
    of it; on others each connected part is one.

    radiance (T, 3): L_d, a lower bound where ``clipped`` (T,); seen (T,): measured.
    """
    found: list[tuple[float, int, float, bool, npt.NDArray[np.int64]]] = []
    bright = radiance.max(axis=1)
    for i in range(len(texels.resolution)):
        own = np.arange(*texels.of_object(i).indices(len(texels)))
        candidates = own[clipped[own]]
        if len(candidates) < _MIN_TEXELS:
            continue
        measured = own[seen[own]]
        whole = texels.area[candidates].sum() > texels.area[measured].sum()
        parts = [own[~seen[own]]] if whole else _connected(texels, candidates)
        for part in parts:
            bound = float(bright[part][clipped[part]].max())
            lamp = whole or _stands_out(texels, bright, part, measured, bound)
            found.append((bound * float(texels.area[part].sum()), i, bound, lamp, part))
    found = sorted(found, key=lambda item: -item[0])[:_MAX_GROUPS]
    group = np.full(len(texels), -1, np.int32)
    for k, item in enumerate(found):
        group[item[-1]] = k
    return ClippedGroups(
        group=group,
        object=np.array([item[1] for item in found], np.int32),
        bound=np.array([item[2] for item in found], np.float32),
        lamp=np.array([item[3] for item in found], np.bool_),
    )


def _connected(texels: Texels, candidates: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """Parts of at least _MIN_TEXELS that touch in space, across the charts of the atlas."""
    reach = _REACH * float(np.sqrt(np.median(texels.area[candidates])))
    pairs = cKDTree(texels.position[candidates]).query_pairs(reach, output_type="ndarray")
    graph = coo_array(
        (np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(candidates),) * 2
    )
    count, label = connected_components(graph, directed=False)
    parts = [candidates[label == k] for k in range(count)]
    return [part for part in parts if len(part) >= _MIN_TEXELS]


def _stands_out(
    texels: Texels,
    bright: Float,
    part: npt.NDArray[np.int64],
    measured: npt.NDArray[np.int64],
    bound: float,
) -> bool:
    distance, _ = cKDTree(texels.position[part]).query(texels.position[measured])
    around = measured[distance < _AROUND]
    return not len(around) or float(np.median(bright[around])) < _NEARLY * bound
