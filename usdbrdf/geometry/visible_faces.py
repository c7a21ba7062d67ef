"""Which triangle each pixel of a pinhole camera sees: the first hits of all its rays, by drawing.

A pixel's ray and a triangle's three planes through the eye (J. Olano and T. Greer, "Triangle scan
conversion using 2D homogeneous coordinates", Graphics Hardware 1997): nothing is clipped, and the
answer is a ray tracer's, at a fraction of its time. Where rounding could decide otherwise than a
ray would (at an edge, or where two surfaces meet) the pixel is left to a ray; and each pixel of a
picture that is small beside what it shows, where to ask all triangles would take longer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.transport.rays import BOX_FACES, RayScene

Vector = tuple[float, float, float]
# Rays decide within this many pixels of an edge, and where two depths differ by less than this
# share: single precision, in which rays are traced, errs by a tenth of both.
_EDGE, _DEPTH = 4e-3, 2e-5
# Bands of rows, drawn in any order by any thread, at most; a power of two. Each asks all triangles,
# which takes longer than to draw what small pictures show of them: so many rows has each at least.
_BANDS, _LEAST_ROWS = 32, 16
_BEHIND = 1e-9
# Of so many triangles in view for each pixel, rays find the nearest sooner than drawing does.
_CROWDED = 2


class _Pinhole(NamedTuple):
    """A camera as the kernels take it: eye (3,); rotation (3, 3), world to x right, y down, z
    ahead; fx, fy, cx, cy, width and height in pixels."""

    eye: Double
    rotation: Double
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class _Mesh(NamedTuple):
    """points (V, 3), triangles (F, 3) of a RayScene."""

    points: Float
    triangles: Int


class _Picture(NamedTuple):
    """What is drawn into, (H, W) each: triangle, 1 / depth of its point, and the greatest 1 / depth
    in doubt there."""

    face: Int
    nearness: Float
    doubt: Float


def visible_faces(rays: RayScene, camera: Camera) -> tuple[Int, Float]:
    """(H, W) int32 triangle, -1 where there is none, and (H, W, 3) float32 the point on it (zero
    where there is none), seen through each pixel's centre."""
    fx, fy, cx, cy = (float(number) for number in camera.intrinsics)
    axes = np.asarray(camera.world_from_camera, np.float64)[:3, :3]
    pinhole = _Pinhole(
        np.array(camera.eye, np.float64),
        np.ascontiguousarray((axes * [1.0, -1.0, -1.0]).T),
        fx, fy, cx, cy, camera.width, camera.height,
    )  # fmt: skip
    size = camera.height, camera.width
    boxes = np.flatnonzero(_boxes_in_view(rays.boxes, pinhole))
    if len(boxes) * BOX_FACES > _CROWDED * camera.width * camera.height:
        face, point = _traced(rays, camera, camera.pixels())
        return face.reshape(size), point.reshape(*size, 3)
    mesh = _Mesh(rays.points, rays.triangles)
    faces = np.full((len(boxes), BOX_FACES), -1, np.int32)
    extents = np.zeros((len(boxes), BOX_FACES, 4), np.int32)
    _faces_in_view(len(boxes), mesh, boxes, pinhole, faces, extents)
    kept = faces >= 0
    picture = _Picture(
        np.full(size, -1, np.int32), np.zeros(size, np.float32), np.zeros(size, np.float32)
    )
    bands = _bands(camera.height)
    _draw(bands, bands, mesh, faces[kept], extents[kept], pinhole, picture)
    point = np.empty((*size, 3), np.float32)
    _points(len(point), pinhole, picture.nearness, point)
    _trace_doubtful(rays, camera, picture, point)
    return picture.face, point


def _bands(height: int) -> int:
    bands = _BANDS
    while bands > 1 and height < bands * _LEAST_ROWS:
        bands //= 2
    return bands


def _trace_doubtful(rays: RayScene, camera: Camera, picture: _Picture, point: Float) -> None:
    doubt, nearness = picture.doubt, picture.nearness
    row, column = np.nonzero((doubt > 0) & (doubt >= nearness * np.float32(1 - _DEPTH)))
    if not len(row):
        return
    pixels = np.stack([column + 0.5, row + 0.5], axis=-1)
    picture.face[row, column], point[row, column] = _traced(rays, camera, pixels)


def _traced(rays: RayScene, camera: Camera, pixels: Double) -> tuple[Int, Float]:
    """Triangle and point, as of ``visible_faces``, at places in the picture (S, 2)."""
    origins, directions = camera.rays(pixels)
    hits = rays.closest(origins, directions)
    reached = origins + directions * hits.distance[:, None]
    return hits.face, np.where(hits.face[:, None] >= 0, reached, np.float32(0))


def _boxes_in_view(boxes: Float, camera: _Pinhole) -> Bool:
    """(B,) whether any part of a box (low, high) lies ahead of the camera, between its image's
    borders and a pixel beyond."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    # Inward normals of the planes through the image's borders, and of the one through the eye.
    sides = np.array([
        [fx, 0.0, cx + 1], [-fx, 0.0, camera.width - cx + 1],
        [0.0, fy, cy + 1], [0.0, -fy, camera.height - cy + 1],
        [0.0, 0.0, 1.0],
    ])  # fmt: skip
    planes = sides @ camera.rotation
    low, high = boxes[:, 0] - camera.eye, boxes[:, 1] - camera.eye
    farthest = np.maximum(planes, 0) @ high.T + np.minimum(planes, 0) @ low.T
    return np.asarray((farthest >= 0).all(axis=0), np.bool_)


@kernel
def _in_camera(points: Float, vertex: int, camera: _Pinhole) -> Vector:
    x = points[vertex, 0] - camera.eye[0]
    y = points[vertex, 1] - camera.eye[1]
    z = points[vertex, 2] - camera.eye[2]
    m = camera.rotation
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )


@kernel
def _extent(a: Vector, b: Vector, c: Vector, camera: _Pinhole) -> tuple[int, int, int, int]:
    """First and last column and row whose pixels' centres a triangle can cover; first > last if
    there are none."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    width, height = camera.width, camera.height
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    corners = (a, b, c)
    for k in range(3):
        p = corners[k]
        q = corners[(k + 1) % 3]
        if p[2] > _BEHIND:
            u, v = fx * p[0] / p[2], fy * p[1] / p[2]
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        if (p[2] > _BEHIND) != (q[2] > _BEHIND):
            t = (_BEHIND - p[2]) / (q[2] - p[2])
            u = fx * (p[0] + t * (q[0] - p[0])) / _BEHIND
            v = fy * (p[1] + t * (q[1] - p[1])) / _BEHIND
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    if left > right:
        return 0, -1, 0, -1
    # Clamped before they become integers: a point beside the eye is anywhere.
    return (
        int(np.ceil(min(max(left + cx - 0.5 - _EDGE, 0.0), width))),
        int(np.floor(max(min(right + cx - 0.5 + _EDGE, width - 1.0), -1.0))),
        int(np.ceil(min(max(top + cy - 0.5 - _EDGE, 0.0), height))),
        int(np.floor(max(min(bottom + cy - 0.5 + _EDGE, height - 1.0), -1.0))),
    )


@parallel_kernel
def _faces_in_view(
    start: int, stop: int, mesh: _Mesh, boxes: Long, camera: _Pinhole, faces: Int, extents: Int
) -> None:
    """Of each box the triangles that can cover a pixel's centre, and their extents."""
    for i in range(start, stop):
        first = boxes[i] * BOX_FACES
        for k in range(min(BOX_FACES, len(mesh.triangles) - first)):
            f = first + k
            a, b, c = _corners(mesh, f, camera)
            left, right, top, bottom = _extent(a, b, c, camera)
            if left <= right and top <= bottom:
                faces[i, k] = f
                extents[i, k, 0], extents[i, k, 1] = left, right
                extents[i, k, 2], extents[i, k, 3] = top, bottom


@kernel
def _corners(mesh: _Mesh, f: int, camera: _Pinhole) -> tuple[Vector, Vector, Vector]:
    """Of triangle f, as the camera sees them."""
    points, triangles = mesh.points, mesh.triangles
    return (
        _in_camera(points, triangles[f, 0], camera),
        _in_camera(points, triangles[f, 1], camera),
        _in_camera(points, triangles[f, 2], camera),
    )


@parallel_kernel
def _draw(
    first: int, last: int, bands: int, mesh: _Mesh, faces: Int, extents: Int, camera: _Pinhole,
    picture: _Picture,
) -> None:  # fmt: skip
    height = camera.height
    for i in range(first, last):
        # Neighbouring bands, which are similarly full, go to different threads.
        band = i * 13 % bands
        low = band * height // bands
        high = (band + 1) * height // bands
        for j in range(len(faces)):
            if extents[j, 2] < high and extents[j, 3] >= low:
                rows = max(extents[j, 2], low), min(extents[j, 3] + 1, high)
                columns = extents[j, 0], extents[j, 1] + 1
                _draw_face(mesh, faces[j], rows, columns, camera, picture)


@kernel
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def _on_image(n: Vector, camera: _Pinhole, scale: float) -> Vector:
    """n . d of the ray d through pixel (column, row), as coefficients of column, row and 1."""
    a = scale * n[0] / camera.fx
    b = scale * n[1] / camera.fy
    return a, b, scale * n[2] + a * (0.5 - camera.cx) + b * (0.5 - camera.cy)


@kernel
def _side(p: Vector, q: Vector, camera: _Pinhole, sign: float) -> Vector:
    """Distance in pixels from the edge p q, positive inside."""
    a, b, c = _on_image(_cross(p, q), camera, sign)
    length = np.sqrt(a * a + b * b)
    if length == 0:
        return 0.0, 0.0, 0.0  # no edge at all: in doubt
    scale = 1 / length
    return a * scale, b * scale, c * scale


@kernel
def _draw_face(
    mesh: _Mesh, f: int, rows: tuple[int, int], columns: tuple[int, int], camera: _Pinhole,
    picture: _Picture,
) -> None:  # fmt: skip
    """One triangle into some rows and columns, from the first to before the last."""
    face, nearness, doubt = picture.face, picture.nearness, picture.doubt
    a, b, c = _corners(mesh, f, camera)
    n = _cross((b[0] - a[0], b[1] - a[1], b[2] - a[2]), (c[0] - a[0], c[1] - a[1], c[2] - a[2]))
    volume = n[0] * a[0] + n[1] * a[1] + n[2] * a[2]
    sign = 1.0 if volume >= 0 else -1.0
    ax, ay, a1 = _side(b, c, camera, sign)
    bx, by, b1 = _side(c, a, camera, sign)
    cx, cy, c1 = _side(a, b, camera, sign)
    wx, wy, w1 = 0.0, 0.0, 0.0
    if volume != 0:
        wx, wy, w1 = _on_image(n, camera, 1 / volume)
    nearest = min(a[2], b[2], c[2])
    at_most = 1 / nearest if nearest > _BEHIND else np.inf
    for row in range(rows[0], rows[1]):
        in_a = a1 + ay * row
        in_b = b1 + by * row
        in_c = c1 + cy * row
        in_w = w1 + wy * row
        for column in range(columns[0], columns[1]):
            inside = min(in_a + ax * column, in_b + bx * column, in_c + cx * column)
            if inside < -_EDGE:
                continue
            if inside < _EDGE:
                doubt[row, column] = max(doubt[row, column], np.float32(at_most))
                continue
            w = np.float32(in_w + wx * column)
            known = nearness[row, column]
            if abs(w - known) <= _DEPTH * known:
                doubt[row, column] = max(doubt[row, column], w)
            if w > known:
                nearness[row, column] = w
                face[row, column] = f


@parallel_kernel
def _points(first: int, last: int, camera: _Pinhole, nearness: Float, point: Float) -> None:
    """The world points at 1 / nearness ahead; zero where that is zero."""
    m = camera.rotation
    for row in range(first, last):
        y = (row + 0.5 - camera.cy) / camera.fy
        for column in range(nearness.shape[1]):
            x = (column + 0.5 - camera.cx) / camera.fx
            w = nearness[row, column]
            for k in range(3):
                d = m[0, k] * x + m[1, k] * y + m[2, k]
                point[row, column, k] = camera.eye[k] + d / w if w > 0 else 0.0


@kernel
def place_on_face(points: Float, triangles: Int, f: int, p: Float) -> tuple[bool, float, float]:
    """Has triangle f an area, and barycentric (u, v) of the point p (3,) on it, by least squares,
    for it lies in its plane; beside a corner both may be a little less than zero."""
    a, b, c = triangles[f]
    e00, e01, e11, r0, r1 = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        along = np.float64(points[b, k]) - points[a, k]
        aside = np.float64(points[c, k]) - points[a, k]
        off = np.float64(p[k]) - points[a, k]
        e00 += along * along
        e01 += along * aside
        e11 += aside * aside
        r0 += along * off
        r1 += aside * off
    determinant = e00 * e11 - e01 * e01
    if determinant <= 0:
        return False, 0.0, 0.0
    return True, (e11 * r0 - e01 * r1) / determinant, (e00 * r1 - e01 * r0) / determinant
