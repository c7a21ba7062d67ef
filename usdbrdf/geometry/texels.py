"""From charts to texels: each triangle of the atlas drawn, texel by texel."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Float, Int, Long
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels

# A texel whose centre lies outside every triangle, but no further than this from one (in texels),
# still belongs to the chart: bilinear lookup at the chart's border reads it.
_BORDER = 0.75
# How far from its triangle's edges a texel's point stays, in texels (less in slivers).
_INSET = 0.01
# Texels computed at a time, by each thread.
_AT_A_TIME = 1 << 16


def texels_from_atlas(scene: Scene, resolution: Int) -> Texels:
    """Rasterise every object's charts into its atlas of ``resolution`` (num_objects, 2)."""
    if scene.corner_uv is None:
        raise ValueError("the scene has no texture coordinates yet")
    size = resolution[scene.face_object].astype(np.float32)
    corner_pixel = scene.corner_uv * size[:, None]
    corner_pixel[..., 1] = size[:, None, 1] - corner_pixel[..., 1]
    pixels = resolution.astype(np.int64).prod(axis=1)
    first_pixel = np.concatenate([[0], np.cumsum(pixels)])

    owner = np.full(first_pixel[-1], -1, np.int32)
    distance = np.full(first_pixel[-1], np.inf, np.float32)
    _rasterise(corner_pixel, scene.face_object, first_pixel, resolution, owner, distance)
    pixel = np.flatnonzero(owner >= 0)
    face, interior = owner[pixel], distance[pixel] <= 0
    del distance
    nearest = np.full(len(owner), -1, np.int32)
    nearest[pixel] = np.arange(len(pixel), dtype=np.int32)
    for i, (width, height) in enumerate(resolution):
        picture = nearest[first_pixel[i] : first_pixel[i + 1]].reshape(height, width)
        if (picture >= 0).any():
            rows, columns = ndimage.distance_transform_edt(
                picture < 0, return_distances=False, return_indices=True
            )
            picture[:] = picture[rows, columns]
    return Texels(
        pixel=pixel,
        face=face,
        **_surface_points(scene, corner_pixel, pixel, face, resolution, first_pixel),
        interior=interior,
        resolution=resolution,
        first_pixel=first_pixel,
        first_texel=np.searchsorted(pixel, first_pixel),
        nearest_texel=nearest,
        corner_pixel=corner_pixel,
    )


def _surface_points(
    scene: Scene, corner_pixel: Float, pixel: Long, face: Int, resolution: Int, first_pixel: Long
) -> dict[str, Float]:
    """What ``Texels`` says of each texel's point, some at a time: on the way there are hundreds of
    bytes per texel."""
    names = ("barycentric", "position", "normal", "geometric_normal", "step_x", "step_y")
    points: dict[str, Float] = {name: np.empty((len(pixel), 3), np.float32) for name in names}
    points["area"] = np.empty(len(pixel), np.float32)

    def fill(start: int) -> None:
        some = slice(start, min(start + _AT_A_TIME, len(pixel)))
        own = face[some]
        width = resolution[scene.face_object[own], 0]
        local = pixel[some] - first_pixel[scene.face_object[own]]
        centre = np.stack([local % width, local // width], axis=-1) + np.float32(0.5)
        barycentric = _barycentric(corner_pixel[own], centre)
        corners = scene.points[scene.triangles[own]]
        # How the surface point moves by one texel right and one texel down, in metres.
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        a, b = (corner_pixel[own, k] - corner_pixel[own, 0] for k in (1, 2))
        det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        det = np.where(np.abs(det) < 1e-9, np.inf, det)[:, None]
        step_x = ((e1 * b[:, 1:2] - e2 * a[:, 1:2]) / det).astype(np.float32)
        step_y = ((e2 * a[:, 0:1] - e1 * b[:, 0:1]) / det).astype(np.float32)
        geometric = np.cross(e1, e2)
        normal = np.einsum("tc,tcd->td", barycentric, scene.corner_normals[own])
        points["barycentric"][some] = barycentric
        points["position"][some] = np.einsum("tc,tcd->td", barycentric, corners)
        points["normal"][some] = _unit(normal, otherwise=geometric)
        points["geometric_normal"][some] = _unit(geometric, otherwise=normal)
        points["step_x"][some], points["step_y"][some] = step_x, step_y
        points["area"][some] = np.linalg.norm(np.cross(step_x, step_y), axis=-1)

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for _ in pool.map(fill, range(0, len(pixel), _AT_A_TIME)):
            pass
    return points


@kernel
def _rasterise(
    corner_pixel: Float,
    face_object: Int,
    first_pixel: Long,
    resolution: Int,
    owner: Int,
    distance: Float,
) -> None:
    """Give each pixel the face nearest to its centre, at most _BORDER away (0 = inside)."""
    for f in range(len(face_object)):
        width, height = resolution[face_object[f], 0], resolution[face_object[f], 1]
        base = first_pixel[face_object[f]]
        x = corner_pixel[f, :, 0]
        y = corner_pixel[f, :, 1]
        x0 = max(0, int(np.floor(x.min() - _BORDER)))
        x1 = min(width, int(np.ceil(x.max() + _BORDER)) + 1)
        y0 = max(0, int(np.floor(y.min() - _BORDER)))
        y1 = min(height, int(np.ceil(y.max() + _BORDER)) + 1)
        for j in range(y0, y1):
            for i in range(x0, x1):
                away = _distance_to_triangle(x, y, i + 0.5, j + 0.5)
                k = base + j * width + i
                if away <= _BORDER and away < distance[k]:
                    distance[k] = away
                    owner[k] = f


@kernel
def _distance_to_triangle(x: Float, y: Float, px: float, py: float) -> float:
    """Distance of a point from a triangle in the plane; 0 inside, whatever its winding."""
    nearest = np.inf
    positive = 0
    negative = 0
    for a in range(3):
        b = (a + 1) % 3
        ex = x[b] - x[a]
        ey = y[b] - y[a]
        dx = px - x[a]
        dy = py - y[a]
        side = ex * dy - ey * dx
        positive += side >= 0
        negative += side <= 0
        t = min(1.0, max(0.0, (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-20)))
        nearest = min(nearest, (dx - t * ex) ** 2 + (dy - t * ey) ** 2)
    if (positive == 3) != (negative == 3):
        return 0.0
    return float(np.sqrt(nearest))


def _barycentric(corners: Float, points: npt.NDArray[np.floating]) -> Float:
    """Barycentric coordinates (T, 3) of points (T, 2) in triangles (T, 3, 2).

    Every texel is moved to _INSET texels inside its triangle's edges: packers like to put a chart's
    corners onto texel centres, and exactly on an edge a ray would start on, or behind, whatever
    touches the object there.
    """
    a = (corners[:, 1] - corners[:, 0]).astype(np.float64)
    b = (corners[:, 2] - corners[:, 0]).astype(np.float64)
    p = points.astype(np.float64) - corners[:, 0]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    det = np.where(np.abs(det) < 1e-12, 1e-12, det)
    u = (p[:, 0] * b[:, 1] - p[:, 1] * b[:, 0]) / det
    v = (a[:, 0] * p[:, 1] - a[:, 1] * p[:, 0]) / det
    # A weight is the distance from the opposite edge, over the triangle's height above it.
    edge = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=-1)
    inset = np.minimum(_INSET * edge / np.abs(det)[:, None], 0.1)
    weights = np.maximum(np.stack([1 - u - v, u, v], axis=-1), inset)
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True), np.float32)


def _unit(vectors: npt.NDArray[np.floating], otherwise: npt.NDArray[np.floating]) -> Float:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    other = np.linalg.norm(otherwise, axis=-1, keepdims=True)
    fallback = np.where(other > 0, otherwise / np.maximum(other, 1e-30), (0, 0, 1))
    unit = np.where(length > 1e-12, vectors / np.maximum(length, 1e-30), fallback)
    return unit.astype(np.float32)
