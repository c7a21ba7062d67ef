"""What frames show at points of the mesh, and how that changes as their cameras move a little."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usdbrdf.files.frames import FramePixels
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.camera import Camera
from usdbrdf.texturing.agreement import MIN_COSINE, MeshPoints
from usdbrdf.texturing.samples import Projection
from usdbrdf.transport.rays import RayScene

# Farther than this many pixels, seen from the front, off the plane of a point's surface its
# neighbours in the picture belong to something behind or before it.
_BESIDE = 2.5
# Pixels beside a picture's border in which nothing is looked up.
_INSET = 2


class LookedUp(NamedTuple):
    """What one frame shows of M points: their numbers (M,) int32, the logarithm of the radiance
    (M,) float32, and its slope (M, 6) float32 along a step of the camera in its own axes, turned by
    the first three (radians), moved by the last (scene units); and in which patch of the picture,
    (M,) int32."""

    point: Int
    value: Float
    slope: Float
    patch: Int


def logarithms(pixels: FramePixels, shrink: int) -> Float:
    """(H / shrink, W / shrink) float32 logarithm of the mean of R, G and B, of the mean of each
    block of pixels; NaN where half of these or more are not valid."""
    level = pixels.radiance.mean(axis=2)
    known = pixels.valid & (level > 0)
    height, width = (side // shrink for side in level.shape)
    shape = height, shrink, width, shrink
    crop = np.s_[: height * shrink, : width * shrink]
    count = known[crop].reshape(shape).sum(axis=(1, 3))
    total = np.where(known, level, 0)[crop].reshape(shape).sum(axis=(1, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(2 * count > shrink**2, np.log(total / count), np.nan)
    return np.asarray(found, np.float32)


def halved(picture: Float) -> Float:
    """The mean of each 2 x 2 pixels; NaN where two of these or more are unknown."""
    height, width = (side // 2 for side in picture.shape)
    blocks = picture[: 2 * height, : 2 * width].astype(np.float32).reshape(height, 2, width, 2)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0).sum(axis=(1, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(count > 2, total / count, np.nan), np.float32)


def look_up(
    surface: MeshPoints,
    visible: RayScene | tuple[Int, Float],
    camera: Camera,
    picture: Float,
    patch: int,
) -> LookedUp:
    """What a frame shows, whose logarithms are ``picture`` in any size; points beside an edge of
    what hides others are left out. Patches have ``patch`` pixels to a side. visible: the mesh, or
    what ``visible_faces`` says of it in this size already."""
    height, width = picture.shape
    camera = camera.at_size(width, height)
    if isinstance(visible, RayScene):
        visible = visible_faces(visible, camera)
    face, seen = visible
    value = np.full(len(surface.point), np.nan, np.float32)
    slope = np.zeros((len(surface.point), 6), np.float32)
    smooth = np.empty_like(picture)
    _smooth(len(picture), picture, smooth)
    place = np.zeros(len(value), np.int32)
    _look_up(
        len(value), surface.point, surface.normal, Projection.of(camera), face, seen, smooth, patch,
        value, slope, place,
    )  # fmt: skip
    shown = np.flatnonzero(np.isfinite(value)).astype(np.int32)
    return LookedUp(shown, value[shown], slope[shown], place[shown])


@parallel_kernel
def _smooth(first: int, last: int, picture: Float, out: Float) -> None:
    height, width = picture.shape
    for j in range(first, last):
        for i in range(width):
            total, weight = 0.0, 0.0
            if 0 < j < height - 1 and 0 < i < width - 1:
                # Most pixels: all about them are known, which this sum alone tells.
                for b in range(3):
                    for a in range(3):
                        own = (2.0 if a == 1 else 1.0) * (2.0 if b == 1 else 1.0)
                        total += own * picture[j - 1 + b, i - 1 + a]
                if not np.isnan(total):
                    out[j, i] = total / 16
                    continue
                total = 0.0
            for b in range(max(j - 1, 0), min(j + 2, height)):
                for a in range(max(i - 1, 0), min(i + 2, width)):
                    own = (2.0 if a == i else 1.0) * (2.0 if b == j else 1.0)
                    if not np.isnan(picture[b, a]):
                        total += own * picture[b, a]
                        weight += own
            out[j, i] = np.nan if np.isnan(picture[j, i]) else total / weight


@parallel_kernel
def _look_up(
    first: int, last: int, point: Double, normal: Double, camera: Projection, face: Int,
    seen: Float, picture: Float, patch: int, value: Float, slope: Float, place: Int,
) -> None:  # fmt: skip
    height, width = picture.shape
    m, (fx, fy, cx, cy) = camera.camera_from_world, camera.intrinsics
    for k in range(first, last):
        p, n = point[k], normal[k]
        wx, wy, wz = camera.eye[0] - p[0], camera.eye[1] - p[1], camera.eye[2] - p[2]
        towards = n[0] * wx + n[1] * wy + n[2] * wz
        if towards <= 0:  # half of all, which need no root
            continue
        distance = np.sqrt(wx * wx + wy * wy + wz * wz)
        cosine = towards / max(distance, 1e-30)
        x = m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3]
        y = m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3]
        z = m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3]
        if cosine < MIN_COSINE or -z < 1e-6 * distance:
            continue
        u, v = cx - fx * x / z - 0.5, cy + fy * y / z - 0.5
        if not (_INSET <= u < width - 1 - _INSET and _INSET <= v < height - 1 - _INSET):
            continue
        i, j = int(np.floor(u)), int(np.floor(v))
        if not _is_surface(i, j, p, n, -z / fx * _BESIDE, face, seen):
            continue
        a, b = u - i, v - j
        middle = _between(picture, i, j, a, b)
        right = (_between(picture, i + 1, j, a, b) - _between(picture, i - 1, j, a, b)) / 2
        down = (_between(picture, i, j + 1, a, b) - _between(picture, i, j - 1, a, b)) / 2
        if not np.isfinite(middle + right + down):
            continue
        value[k] = middle
        place[k] = j // patch * (width // patch + 1) + i // patch
        # Of the picture's value by the point's place in the camera.
        by_x, by_y = -right * fx / z, down * fy / z
        by_z = (right * fx * x - down * fy * y) / (z * z)
        slope[k, 0] = by_y * z - by_z * y
        slope[k, 1] = by_z * x - by_x * z
        slope[k, 2] = by_x * y - by_y * x
        slope[k, 3], slope[k, 4], slope[k, 5] = -by_x, -by_y, -by_z


@kernel
def _between(picture: Float, i: int, j: int, a: float, b: float) -> float:
    upper = (1 - a) * picture[j, i] + a * picture[j, i + 1]
    lower = (1 - a) * picture[j + 1, i] + a * picture[j + 1, i + 1]
    return float((1 - b) * upper + b * lower)


@kernel
def _is_surface(
    i: int, j: int, p: Double, n: Double, farthest: float, face: Int, seen: Float
) -> bool:
    """Do all pixels that make up a value show something near the plane through its point p, across
    n? Along that plane they are as far from it as pixels are, wherever in its own it lies."""
    for row in range(j - 1, j + 3):
        for column in range(i - 1, i + 3):
            if face[row, column] < 0:
                return False
            off = 0.0
            for k in range(3):
                off += n[k] * (seen[row, column, k] - p[k])
            if abs(off) > farthest:
                return False
    return True
