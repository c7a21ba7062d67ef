"""Polygons of a UsdGeomMesh -> triangles, with the way back to the polygons' own data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pxr import UsdGeom

Int = npt.NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Triangulation:
    """T triangles of P polygons with C corners in all.

    triangles  (T, 3) int32, point indices, counter-clockwise seen from outside
    corners    (T, 3) int32, index of each triangle corner among the C polygon corners
    polygon    (T,) int32, the polygon that each triangle came from
    """

    triangles: Int
    corners: Int
    polygon: Int

    def element_of_corner(self, interpolation: str) -> Int:
        """(T, 3) int32: which value of a primvar of this interpolation each corner has."""
        by_interpolation: dict[str, Int] = {
            UsdGeom.Tokens.faceVarying: self.corners,
            UsdGeom.Tokens.vertex: self.triangles,
            UsdGeom.Tokens.varying: self.triangles,
            UsdGeom.Tokens.uniform: np.repeat(self.polygon[:, None], 3, axis=1),
            UsdGeom.Tokens.constant: np.zeros_like(self.triangles),
        }
        return by_interpolation[interpolation]


def triangulate(
    counts: Int, indices: Int, *, left_handed: bool = False, holes: Int | None = None
) -> Triangulation:
    """Fans from each polygon's first corner; polygons that are holes or have no area disappear.

    counts   (P,) corners per polygon
    indices  (C,) point of each corner
    """
    counts = np.asarray(counts, np.int64)
    fans = np.maximum(counts - 2, 0)
    if holes is not None and len(holes):
        fans[np.asarray(holes)] = 0
    polygon = np.repeat(np.arange(len(counts)), fans)
    in_fan = np.arange(len(polygon)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = (np.cumsum(counts) - counts)[polygon]
    corners = np.stack([first, first + in_fan + 1, first + in_fan + 2], axis=-1)
    if left_handed:
        corners = corners[:, [0, 2, 1]]
    return Triangulation(
        triangles=np.asarray(indices, np.int32)[corners].reshape(-1, 3),
        corners=corners.astype(np.int32),
        polygon=polygon.astype(np.int32),
    )
