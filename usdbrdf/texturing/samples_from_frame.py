"""What one frame says about each texel: visible, valid, and which radiance.

The loop is over texels, not pixels. A texel takes a sample where it faces the camera, where the
pixels around its projection (3 x 3, or as many as its footprint covers) all show its own object
near its own tangent plane (so it is unoccluded, and away from depth edges and the image border),
and where every pixel of its footprint lies between noise floor and saturation in every channel.
Beside a lamp it takes none: no lens and no filter keeps all of a lamp's light to its own pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import prange
from scipy import ndimage

from usdbrdf.geometry.cameras import camera_rays, pixel_centres
from usdbrdf.geometry.rays import RayScene
from usdbrdf.geometry.texels import Texels
from usdbrdf.kernel import kernel, parallel_kernel

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]

# Seen flatter than this a texel's footprint is smeared over its neighbours.
_MIN_COSINE = 0.1
# Sub-samples of a texel's footprint per side, at most.
_MAX_TAPS = 4

# Glare: pixels this many times brighter than the frame's median, within this many pixels, and this
# many times brighter than the sample itself. Of such light some per cent arrive two pixels off.
_GLARING, _GLARE_REACH, _GLARE_CONTRAST = 10.0, 3, 3.0

NOTHING, SAMPLE, CLIPPED = 0, 1, 2


@dataclass(frozen=True, kw_only=True)
class FirstSurfaces:
    """What each pixel of one frame sees: object (H, W) int32 (-1: nothing) and the point
    (H, W, 3) float32 in the world."""

    object: Int
    point: Float


def first_surfaces(
    rays: RayScene,
    face_object: Int,
    world_from_camera: Double,
    intrinsics: Double,
    resolution: Int,
) -> FirstSurfaces:
    """Trace one ray through every pixel's centre."""
    width, height = int(resolution[0]), int(resolution[1])
    origins, directions = camera_rays(world_from_camera, intrinsics, pixel_centres(width, height))
    hits = rays.closest(origins, directions)
    seen = np.where(hits.face >= 0, face_object[hits.face], -1).astype(np.int32)
    point = origins + directions * np.where(hits.face >= 0, hits.distance, 0)[:, None]
    return FirstSurfaces(
        object=seen.reshape(height, width),
        point=point.reshape(height, width, 3).astype(np.float32),
    )


def samples_from_frame(
    texels: Texels,
    texel_object: Int,
    surfaces: FirstSurfaces,
    radiance: Float,
    valid: Bool,
    clipped: Bool,
    world_from_camera: Double,
    intrinsics: Double,
    beside_glare: bool = False,
) -> tuple[npt.NDArray[np.int8], Float]:
    """Per texel: NOTHING, SAMPLE, or CLIPPED (visible, and saturated all over its footprint),
    (T,) int8, and the radiance of the samples, (T, 3) float32.

    radiance (H, W, 3) float32; valid, clipped (H, W) bool; world_from_camera (4, 4);
    intrinsics fx, fy, cx, cy. beside_glare: take samples there too, for whom highlights matter.
    """
    camera_from_world = np.linalg.inv(world_from_camera).astype(np.float64, copy=False)
    kind = np.zeros(len(texels), np.int8)
    values = np.zeros((len(texels), 3), np.float32)
    _sample(
        texels.position,
        texels.geometric_normal,
        texels.step_x,
        texels.step_y,
        texel_object,
        surfaces.object,
        surfaces.point,
        radiance,
        valid,
        clipped,
        camera_from_world,
        world_from_camera[:3, 3].copy(),
        np.asarray(intrinsics, np.float64),
        np.zeros_like(valid, np.float32) if beside_glare else _glare(radiance, valid, clipped),
        kind,
        values,
    )
    return kind, values


def _glare(radiance: Float, valid: Bool, clipped: Bool) -> Float:
    """(H, W) float32: the brightest glaring pixel nearby, in any channel; 0 where there is none."""
    level = radiance.max(axis=2)
    usual = float(np.median(level[valid])) if valid.any() else 0.0
    glaring = np.where((valid | clipped) & (level > _GLARING * usual), level, 0)
    brightest: Float = ndimage.maximum_filter(glaring, 2 * _GLARE_REACH + 1, mode="nearest")
    return brightest


@kernel
def _project(
    p: Float, sx: Float, sy: Float, dx: float, dy: float, k: Double, m: Double
) -> tuple[float, float, float]:
    """Pixel of the point p + dx sx + dy sy and its depth in front of the camera."""
    x = p[0] + dx * sx[0] + dy * sy[0]
    y = p[1] + dx * sx[1] + dy * sy[1]
    z = p[2] + dx * sx[2] + dy * sy[2]
    depth = -(m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3])
    if depth <= 1e-6:
        return 0.0, 0.0, -1.0
    u = k[2] + k[0] * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
    v = k[3] - k[1] * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
    return u, v, depth


@parallel_kernel
def _sample(
    position: Float,
    normal: Float,
    step_x: Float,
    step_y: Float,
    texel_object: Int,
    seen_object: Int,
    seen_point: Float,
    radiance: Float,
    valid: Bool,
    clipped: Bool,
    camera_from_world: Double,
    eye: Double,
    intrinsics: Double,
    glare: Float,
    kind: npt.NDArray[np.int8],
    values: Float,
) -> None:
    height, width = valid.shape
    for t in prange(len(position)):
        p = position[t]
        n = normal[t]
        wx = eye[0] - p[0]
        wy = eye[1] - p[1]
        wz = eye[2] - p[2]
        distance = np.sqrt(wx * wx + wy * wy + wz * wz)
        if n[0] * wx + n[1] * wy + n[2] * wz < _MIN_COSINE * distance:
            continue
        sx = step_x[t]
        sy = step_y[t]
        u, v, depth = _project(p, sx, sy, 0.0, 0.0, intrinsics, camera_from_world)
        column = int(np.floor(u))
        row = int(np.floor(v))
        if depth < 0 or column < 1 or row < 1 or column > width - 2 or row > height - 2:
            continue
        pixel_size = depth / intrinsics[0]
        ux, vx, _ = _project(p, sx, sy, 1.0, 0.0, intrinsics, camera_from_world)
        uy, vy, _ = _project(p, sx, sy, 0.0, 1.0, intrinsics, camera_from_world)
        span_x = np.sqrt((ux - u) ** 2 + (vx - v) ** 2)
        span_y = np.sqrt((uy - u) ** 2 + (vy - v) ** 2)
        taps_x = min(_MAX_TAPS, max(1, int(np.ceil(span_x))))
        taps_y = min(_MAX_TAPS, max(1, int(np.ceil(span_y))))
        # How far from the centre bilinear reading of the footprint's taps reaches, in pixels.
        off_x, off_y = 0.5 - 0.5 / taps_x, 0.5 - 0.5 / taps_y
        wide = off_x * abs(ux - u) + off_y * abs(uy - u)
        high = off_x * abs(vx - v) + off_y * abs(vy - v)
        reach = max(1, int(np.ceil(max(wide, high) + 0.5)))
        if not _shows_surface(
            row, column, reach, p, n, texel_object[t], pixel_size, seen_object, seen_point
        ):
            continue
        total = np.zeros(3)
        num_valid = 0
        num_clipped = 0
        for a in range(taps_x):
            for b in range(taps_y):
                dx = (a + 0.5) / taps_x - 0.5
                dy = (b + 0.5) / taps_y - 0.5
                su, sv, _ = _project(p, sx, sy, dx, dy, intrinsics, camera_from_world)
                good, saturated = _bilinear(su, sv, radiance, valid, clipped, total)
                num_valid += good
                num_clipped += saturated
        # Partly saturated is no bound: a lamp's neighbour catches some of its light.
        if num_valid == 4 * taps_x * taps_y:
            if glare[row, column] * (taps_x * taps_y) > _GLARE_CONTRAST * total.max():
                continue
            kind[t] = SAMPLE
            for c in range(3):
                values[t, c] = total[c] / (taps_x * taps_y)
        elif num_clipped == 4 * taps_x * taps_y:
            kind[t] = CLIPPED


@kernel
def _shows_surface(
    row: int,
    column: int,
    reach: int,
    p: Float,
    n: Float,
    own: int,
    pixel_size: float,
    seen_object: Int,
    seen_point: Float,
) -> bool:
    """Do all pixels within ``reach`` show object ``own``, a pixel's size off its plane at most?"""
    height, width = seen_object.shape
    if row < reach or column < reach or row + reach >= height or column + reach >= width:
        return False
    for j in range(row - reach, row + reach + 1):
        for i in range(column - reach, column + reach + 1):
            if seen_object[j, i] != own:
                return False
            s = seen_point[j, i]
            off = (s[0] - p[0]) * n[0] + (s[1] - p[1]) * n[1] + (s[2] - p[2]) * n[2]
            if abs(off) > pixel_size:
                return False
    return True


@kernel
def _bilinear(
    u: float, v: float, radiance: Float, valid: Bool, clipped: Bool, total: Double
) -> tuple[int, int]:
    """Add the image at (u, v) to ``total``; how many of the four pixels are valid, and clipped."""
    height, width = valid.shape
    x = min(max(u - 0.5, 0.0), width - 1.001)
    y = min(max(v - 0.5, 0.0), height - 1.001)
    i = int(x)
    j = int(y)
    fx = x - i
    fy = y - j
    num_valid = 0
    num_clipped = 0
    for b in range(2):
        for a in range(2):
            w = (fx if a else 1 - fx) * (fy if b else 1 - fy)
            num_valid += valid[j + b, i + a]
            num_clipped += clipped[j + b, i + a]
            for c in range(3):
                total[c] += w * radiance[j + b, i + a, c]
    return num_valid, num_clipped
