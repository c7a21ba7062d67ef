"""Bounds around tiles of texels, by which a frame passes over most of those it cannot see."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from usdbrdf.geometry.unwrap import MAX_SIDE
from usdbrdf.kernel import parallel_kernel
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.texels import Texels

# Texels to a side of a tile.
_SIDE = 8


class TexelBlocks(NamedTuple):
    """B tiles of texels, or parts of such, and what bounds their points and normals.

    order   (T,) int32, texels; block b holds order[first[b]:first[b + 1]], first (B + 1,) int64
    centre  (B, 3) float32, radius (B,) float32: a sphere around their points
    axis    (B, 3) float32, spread (B,) float32: all normals lie within ``spread`` radians of it
    """

    order: Int
    first: Long
    centre: Float
    radius: Float
    axis: Float
    spread: Float

    def texels_in_view(self, camera: Camera, min_cosine: float) -> Int:
        """All texels, by block, that lie before the camera, project into the image and
        face the eye at ``min_cosine`` or more, and of few others."""
        width, height = camera.width, camera.height
        fx, fy, cx, cy = camera.intrinsics
        # Inward normals, in camera axes, of the planes through the image's borders and the eye.
        planes = np.array([
            [fx, 0, -cx], [-fx, 0, cx - width], [0, -fy, -cy], [0, fy, cy - height], [0, 0, -1],
        ])  # fmt: skip
        planes /= np.linalg.norm(planes, axis=1, keepdims=True)
        normals = np.ascontiguousarray(planes @ camera.world_from_camera[:3, :3].T)
        eye = np.array(camera.eye, np.float64)
        seen = np.flatnonzero(_in_view(self, normals, eye, float(np.arccos(min_cosine))))
        count = self.first[seen + 1] - self.first[seen]
        ends = np.cumsum(count)
        shift = np.repeat(self.first[seen] - (ends - count), count)
        which: Int = self.order[np.arange(len(shift)) + shift]
        return which


def blocks_of_texels(texels: Texels, part: slice) -> TexelBlocks:
    """Blocks of the texels of ``part``, each of one object and, as far as _SIDE allows, one side of
    a chart: tiles of the atlas, split by the axis along which the normal is longest."""
    owner = texels.object_index()[part]
    local = texels.pixel[part] - texels.first_pixel[owner]
    width = texels.resolution[owner, 0]
    tile = (local // width // _SIDE) * (MAX_SIDE // _SIDE) + local % width // _SIDE
    key = (owner.astype(np.int64) * (MAX_SIDE // _SIDE) ** 2 + tile) * 6
    key += _longest_axis(texels.geometric_normal[part])
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    order = (order + part.start).astype(np.int32)
    vectors, scalars = (len(first), 3), len(first)
    blocks = TexelBlocks(
        order=order,
        first=np.append(first, len(order)),
        centre=np.zeros(vectors, np.float32),
        radius=np.zeros(scalars, np.float32),
        axis=np.zeros(vectors, np.float32),
        spread=np.zeros(scalars, np.float32),
    )
    _bound(texels.position, texels.geometric_normal, *blocks)
    return blocks


def _longest_axis(normal: Float) -> Long:
    """0 to 5: x, y, z and their opposites."""
    axis = np.abs(normal).argmax(axis=1)
    along = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0]
    longest: Long = axis + 3 * (along < 0)
    return longest


@parallel_kernel
def _bound(
    position: Float, normal: Float, order: Int, first: Long, centre: Float, radius: Float,
    axis: Float, spread: Float,
) -> None:  # fmt: skip
    for b in prange(len(first) - 1):
        low, high = position[order[first[b]]].copy(), position[order[first[b]]].copy()
        total = np.zeros(3)
        for t in order[first[b] : first[b + 1]]:
            for k in range(3):
                low[k] = min(low[k], position[t, k])
                high[k] = max(high[k], position[t, k])
                total[k] += normal[t, k]
        length = np.sqrt((total**2).sum())
        away, least = 0.0, 1.0
        for k in range(3):
            centre[b, k] = (low[k] + high[k]) / 2
            axis[b, k] = total[k] / length if length > 0 else 0.0
        for t in order[first[b] : first[b + 1]]:
            squared, cosine = 0.0, 0.0
            for k in range(3):
                squared += (np.float64(position[t, k]) - centre[b, k]) ** 2
                cosine += np.float64(normal[t, k]) * axis[b, k]
            away, least = max(away, squared), min(least, cosine)
        # Rounded outwards: single precision, in which the bounds are kept, has seven digits.
        radius[b] = 1.00001 * np.sqrt(away) + 1e-6 * (np.abs(centre[b]).max() + 1e-3)
        spread[b] = np.arccos(max(least, -1.0)) + 2e-3


@parallel_kernel
def _in_view(blocks: TexelBlocks, planes: Double, eye: Double, widest: float) -> Bool:
    _, _, centre, radius, axis, spread = blocks
    seen = np.zeros(len(centre), np.bool_)
    for b in prange(len(centre)):
        x = eye[0] - centre[b, 0]
        y = eye[1] - centre[b, 1]
        z = eye[2] - centre[b, 2]
        inside = True
        for k in range(len(planes)):
            inside = inside and (
                planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] * z <= radius[b]
            )
        if not inside:
            continue
        distance = np.sqrt(x * x + y * y + z * z)
        if distance <= radius[b]:
            seen[b] = True
            continue
        # The eye, seen from any point of the sphere, and any of the normals.
        cosine = (axis[b, 0] * x + axis[b, 1] * y + axis[b, 2] * z) / distance
        least = np.arccos(min(max(cosine, -1.0), 1.0)) - spread[b]
        seen[b] = least - np.arcsin(radius[b] / distance) <= widest
    return seen
