"""Values for texels that nobody saw, from the nearest seen ones of the same object."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from usdbrdf.geometry.texels import Texels

Float = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

_NEIGHBOURS = 8
# A normal that differs by 90 degrees counts as this share of the object's size in distance: the
# unseen back of a box is filled from its own sides before the far end of its front.
_NORMAL_WEIGHT = 0.25
# Zero has no logarithm: it counts as this share of the median of all known positive values.
_ZERO = 1e-6
# Texels filled at a time, which bounds what their neighbours take.
_AT_A_TIME = 1 << 18


def inpaint(texels: Texels, values: Float, known: Bool) -> Float:
    """Fill ``values`` (T, 3) where ``known`` (T,) is False; known ones are returned unchanged.

    Geometric mean of the 8 nearest known texels of the same object in position and normal. An
    object of which nothing is known takes the nearest known texels of the scene; a scene of which
    nothing is known, or only black, becomes zero. Values in another unit give the same fill in that
    unit.
    """
    filled = np.where(known[:, None], values, 0).astype(np.float32)
    if not known.any():
        return filled
    positive = filled[filled > 0]
    if not len(positive):
        return filled
    floor = float(_ZERO * np.median(positive, overwrite_input=True))
    del positive
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
        filled[missing] = _nearest_mean(texels, values, source, missing, weight, floor)
    if orphans:
        filled[np.concatenate(orphans)] = _nearest_mean(
            texels, values, np.flatnonzero(known), np.concatenate(orphans), 0.0, floor
        )
    return filled


def _nearest_mean(
    texels: Texels,
    values: Float,
    source: npt.NDArray[np.int64],
    missing: npt.NDArray[np.int64],
    normal_weight: float,
    floor: float,
) -> Float:
    def feature(index: npt.NDArray[np.int64]) -> Float:
        return np.concatenate(
            [texels.position[index], normal_weight * texels.normal[index]], axis=-1
        )

    tree = cKDTree(feature(source))
    k = min(_NEIGHBOURS, len(source))
    means = np.empty((len(missing), 3), np.float32)
    for start in range(0, len(missing), _AT_A_TIME):
        some = missing[start : start + _AT_A_TIME]
        _, nearest = tree.query(feature(some), k=k, workers=-1)
        neighbours = values[source[nearest.reshape(len(some), k)]]
        logarithm = np.log(np.maximum(neighbours, floor))
        means[start : start + _AT_A_TIME] = np.exp(logarithm.mean(axis=1))
    return means
