"""Which vertices share a position: exporters split vertices at seams, the surface does not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]


def welded_ids(points: Float) -> Int:
    """(V,) int32: vertices with bit-equal positions (V, 3) float32 get the same number.

    Numbers run from 0 without gaps, in the order of x, then y, then z. Minus zero equals zero.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32)
    position = np.asarray(points, np.float32) + np.float32(0)  # -0.0 becomes 0.0
    order = np.lexsort((position[:, 2], position[:, 1], position[:, 0]))
    in_order = position[order]
    differs = np.zeros(len(points), np.int32)
    differs[1:] = (in_order[1:] != in_order[:-1]).any(axis=1)
    ids = np.zeros(len(points), np.int32)
    ids[order] = np.cumsum(differs, dtype=np.int32)
    return ids
