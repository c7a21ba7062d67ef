"""Texture coordinates that a mesh came with: are they fit to hold what is measured?"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from usdbrdf.geometry.unwrap import MAX_SIDE
from usdbrdf.kernel import kernel

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]

# Texels between charts: bilinear lookup stays inside its own.
_GAP = 2
# A texel's sides on the surface may differ from those wanted by this factor, up or down, on all
# but a small share of the area.
_MAX_STRETCH, _MAX_SHARE = 2.0, 0.05


def atlas_side(corner_uv: Float, corners: Float, texel_size: float) -> int | None:
    """Texels along each side of the square atlas that an object's own coordinates ask for; None
    where they are not fit: outside [0, 1], stretched, or with two places of the surface in one
    place of the atlas or too near to each other.

    corner_uv (F, 3, 2); corners (F, 3, 3), metres; texel_size in metres
    """
    if not (np.isfinite(corner_uv).all() and corner_uv.min() >= 0 and corner_uv.max() <= 1):
        return None
    edges = (corners[:, 1:] - corners[:, :1]).astype(np.float64)
    flat = (corner_uv[:, 1:] - corner_uv[:, :1]).astype(np.float64)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    flat_area = np.abs(np.linalg.det(flat)) / 2
    shown = area > 0
    if not shown.any() or (flat_area[shown] < 1e-12).any():
        return None
    side = math.ceil(math.sqrt(area.sum() / flat_area[shown].sum()) / texel_size)
    if side > MAX_SIDE:
        return None
    # Metres along the surface per unit of the coordinates, the longest and the shortest.
    metres = np.linalg.svd(np.linalg.inv(flat[shown]) @ edges[shown], compute_uv=False)
    stretch = metres / (side * texel_size)
    odd = ((stretch > _MAX_STRETCH) | (stretch < 1 / _MAX_STRETCH)).any(axis=1)
    if area[shown][odd].sum() > _MAX_SHARE * area.sum():
        return None
    return side if _is_one_to_one(corner_uv, _charts(corner_uv, corners), side) else None


def _charts(corner_uv: Float, corners: Float) -> Int:
    """(F,) the chart of each triangle: connected both on the surface and in the atlas."""
    rows = np.concatenate([corner_uv, corners], axis=2).reshape(-1, 5)
    _, vertex = np.unique(rows, axis=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    a, b = vertex[:, [0, 0]].reshape(-1), vertex[:, [1, 2]].reshape(-1)
    size = int(vertex.max()) + 1
    links = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(size, size))
    _, chart = connected_components(links, directed=False)
    return np.asarray(chart[vertex[:, 0]], np.int32)


def _is_one_to_one(corner_uv: Float, chart: Int, side: int) -> bool:
    """No texel's centre in two triangles, none of two charts nearer than _GAP texels."""
    owner = np.full((side, side), -1, np.int32)
    if not _paint(corner_uv.astype(np.float64) * side, chart, owner):
        return False
    near = 2 * _GAP + 1
    highest = ndimage.maximum_filter(owner, near, mode="nearest")
    lowest = ndimage.minimum_filter(
        np.where(owner >= 0, owner, np.iinfo(np.int32).max), near, mode="nearest"
    )
    return bool((highest == lowest)[owner >= 0].all())


@kernel
def _paint(corners: Double, chart: Int, owner: Int) -> bool:
    """Write each triangle's chart to the texels whose centres it covers; False if two share one."""
    side = len(owner)
    for f in range(len(corners)):
        x, y = corners[f, :, 0], corners[f, :, 1]
        for j in range(max(0, int(y.min() - 0.5)), min(side, int(y.max() + 0.5) + 1)):
            for i in range(max(0, int(x.min() - 0.5)), min(side, int(x.max() + 0.5) + 1)):
                left = 0
                right = 0
                for a in range(3):
                    b = (a + 1) % 3
                    turn = (x[b] - x[a]) * (j + 0.5 - y[a]) - (y[b] - y[a]) * (i + 0.5 - x[a])
                    # On an edge the centre belongs to neither side.
                    left += turn > 1e-6
                    right += turn < -1e-6
                if left == 3 or right == 3:
                    if owner[j, i] >= 0:
                        return False
                    owner[j, i] = chart[f]
    return True
