"""UV charts per object at a given texel size, by xatlas in a child process.

xatlas hangs on absurd coordinates and returns NaN for degenerate ones; so each object is
normalised to a unit box before and checked after, the child has a time limit, and an object that
it cannot unwrap falls back to packing its triangles one by one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import InputRefused
from usdbrdf.geometry.normals import doubled_areas
from usdbrdf.geometry.scene import Scene
from usdbrdf.job.child import run_child

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]

# Texels between charts: bilinear lookup and two mip levels stay inside a chart's own gutter.
PADDING = 4
MAX_SIDE = 16384


def unwrap(scene: Scene, texel_size: float) -> tuple[Float, Int]:
    """UVs of every object in its own atlas: corner_uv (F, 3, 2) in [0, 1], v up, and the atlas
    size in texels of each object, (num_objects, 2) int32 width, height.

    texel_size is in metres: equal areas of surface get equal numbers of texels on all objects.
    Raises InputRefused when an atlas would be larger than 16,384 texels on a side.
    """
    _refuse_huge(scene, texel_size)
    first = np.array([obj.first_face for obj in scene.objects], np.int64)
    count = np.array([obj.num_faces for obj in scene.objects], np.int64)
    result = run_child(
        "usdbrdf.geometry.unwrap:unwrap_objects",
        {
            "points": scene.points,
            "triangles": scene.triangles,
            "first": first,
            "count": count,
        },
        {"texel_size": texel_size},
        timeout_s=120 + 2e-3 * len(scene.triangles),
        label="unwrapping the objects",
    )
    for obj, (width, height) in zip(scene.objects, result["resolution"], strict=True):
        if max(width, height) > MAX_SIDE:
            raise InputRefused(
                f"<{obj.prim_path}>: its texture would be {width} x {height} texels (limit "
                f"{MAX_SIDE}). Choose a larger --texel-size than {texel_size:g} m. [texturing.size]"
            )
    return result["corner_uv"], result["resolution"]


def _refuse_huge(scene: Scene, texel_size: float) -> None:
    """Packing what cannot fit takes xatlas minutes; the area alone tells it at once."""
    area = np.bincount(scene.face_object, doubled_areas(scene.points, scene.triangles) / 2)
    for obj, square_metres in zip(scene.objects, area, strict=True):
        side = int(np.ceil(np.sqrt(square_metres) / texel_size))
        if side > MAX_SIDE:
            raise InputRefused(
                f"<{obj.prim_path}>: its {square_metres:.3g} m^2 would need {side} x {side} texels "
                f"(limit {MAX_SIDE}). Choose a larger --texel-size than {texel_size:g} m. "
                "[texturing.size]"
            )


def unwrap_objects(
    arrays: Mapping[str, npt.NDArray[Any]], parameters: Mapping[str, Any]
) -> dict[str, npt.NDArray[Any]]:
    """Child process: unwrap each object by itself (see ``unwrap``)."""
    triangles, points = arrays["triangles"], arrays["points"]
    corner_uv = np.zeros((len(triangles), 3, 2), np.float32)
    resolution = np.zeros((len(arrays["first"]), 2), np.int32)
    for i, (first, count) in enumerate(zip(arrays["first"], arrays["count"], strict=True)):
        faces = slice(int(first), int(first + count))
        used, local = np.unique(triangles[faces], return_inverse=True)
        uv, size = _unwrap_one(
            points[used], local.reshape(-1, 3).astype(np.uint32), parameters["texel_size"]
        )
        corner_uv[faces], resolution[i] = uv, size
    return {"corner_uv": corner_uv, "resolution": resolution}


def _unwrap_one(
    points: Float, triangles: npt.NDArray[np.uint32], texel_size: float
) -> tuple[Float, tuple[int, int]]:
    import xatlas

    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high - low).max())
    unit = ((points - low) / max(extent, 1e-12)).astype(np.float32)
    atlas = xatlas.Atlas()
    atlas.add_mesh(unit, triangles)
    options = xatlas.PackOptions()
    options.padding = PADDING
    options.texels_per_unit = extent / texel_size
    options.bilinear = True
    options.rotate_charts = True
    atlas.generate(xatlas.ChartOptions(), options)
    _, corners, uv = atlas[0]
    width, height = int(atlas.width), int(atlas.height)
    if corners.shape == triangles.shape and np.isfinite(uv).all() and min(width, height) > 0:
        corner_uv = uv[corners]
        corner_uv[..., 1] = 1 - corner_uv[..., 1]
        if corner_uv.min() >= 0 and corner_uv.max() <= 1:
            return corner_uv.astype(np.float32), (width, height)
    return pack_triangles_singly(points[triangles.astype(np.int64)], texel_size)


def pack_triangles_singly(corners: Float, texel_size: float) -> tuple[Float, tuple[int, int]]:
    """The fallback without charts: every triangle in a square cell of its own.

    corners (F, 3, 3) metres. Cells are as large as the largest triangle needs, so this wastes
    texels, but it has no failure modes. Returns (F, 3, 2) UVs and the atlas size.
    """
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    side = int(np.clip(np.ceil(edges.max() / texel_size), 1, 1024))
    cell = side + 2 * PADDING
    columns = int(np.ceil(np.sqrt(len(corners))))
    rows = -(-len(corners) // columns)
    index = np.arange(len(corners))
    origin = np.stack([index % columns, index // columns], axis=-1) * cell + PADDING
    shape = np.array([[0, 0], [side, 0], [0, side]], np.float64)
    uv = (origin[:, None] + shape[None]) / (columns * cell, rows * cell)
    uv[..., 1] = 1 - uv[..., 1]
    return uv.astype(np.float32), (columns * cell, rows * cell)
