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

from usdbrdf import calibration
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.model.arrays import Bool, Double, Float, Int
from usdbrdf.model.camera import Camera
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.glare import brightest_glare
from usdbrdf.transport.rays import RayScene

MIN_COSINE = calibration.number("samples.min_cosine")

# Sub-samples of a texel's footprint per side, at most.
_MAX_TAPS = 4

_GLARE_CONTRAST = calibration.number("samples.glare_contrast")

NOTHING, SAMPLE, CLIPPED = 0, 1, 2


@dataclass(frozen=True, kw_only=True)
class FirstSurfaces:
    """What each pixel of one frame sees: object (H, W) int32 (-1: nothing) and the point
    (H, W, 3) float32 in the world."""

    object: Int
    point: Float


def first_surfaces(rays: RayScene, face_object: Int, camera: Camera) -> FirstSurfaces:
    """The first hits of the rays through all pixels' centres."""
    face, point = visible_faces(rays, camera)
    seen = face_object[face]
    seen[face < 0] = -1
    return FirstSurfaces(object=seen, point=point)


def samples_from_frame(
    texels: Texels,
    texel_object: Int,
    surfaces: FirstSurfaces,
    radiance: Float,
    valid: Bool,
    clipped: Bool,
    camera: Camera,
    beside_glare: bool = False,
) -> tuple[npt.NDArray[np.int8], Float]:
    """Per texel: NOTHING, SAMPLE, or CLIPPED (visible, and saturated all over its footprint),
    (T,) int8, and the radiance of the samples, (T, 3) float32.

    radiance (H, W, 3) float32; valid, clipped (H, W) bool. beside_glare: take samples there too,
    for whom highlights matter.
    """
    return samples_of_texels(
        texels, np.arange(len(texels), dtype=np.int32), texel_object, surfaces, radiance, valid,
        clipped, camera, beside_glare,
    )  # fmt: skip


def samples_of_texels(
    texels: Texels,
    which: Int,
    texel_object: Int,
    surfaces: FirstSurfaces,
    radiance: Float,
    valid: Bool,
    clipped: Bool,
    camera: Camera,
    beside_glare: bool = False,
) -> tuple[npt.NDArray[np.int8], Float]:
    """The same for some texels, ``which`` (M,) int32: (M,) int8 and (M, 3) float32."""
    camera_from_world = np.linalg.inv(camera.world_from_camera).astype(np.float64, copy=False)
    if beside_glare:
        glare = np.zeros(valid.shape, np.float32)
    else:
        glare = brightest_glare(radiance, valid, clipped)
    kind = np.zeros(len(which), np.int8)
    values = np.zeros((len(which), 3), np.float32)
    _sample(
        which,
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
        camera.eye.copy(),
        np.asarray(camera.intrinsics, np.float64),
        glare,
        kind,
        values,
    )
    return kind, values


@kernel
def project(
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
    which: Int,
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
    for m in prange(len(which)):
        t = which[m]
        p = position[t]
        n = normal[t]
        wx = eye[0] - p[0]
        wy = eye[1] - p[1]
        wz = eye[2] - p[2]
        distance = np.sqrt(wx * wx + wy * wy + wz * wz)
        if n[0] * wx + n[1] * wy + n[2] * wz < MIN_COSINE * distance:
            continue
        sx = step_x[t]
        sy = step_y[t]
        u, v, depth = project(p, sx, sy, 0.0, 0.0, intrinsics, camera_from_world)
        column = int(np.floor(u))
        row = int(np.floor(v))
        if depth < 0 or column < 1 or row < 1 or column > width - 2 or row > height - 2:
            continue
        pixel_size = depth / intrinsics[0]
        ux, vx, _ = project(p, sx, sy, 1.0, 0.0, intrinsics, camera_from_world)
        uy, vy, _ = project(p, sx, sy, 0.0, 1.0, intrinsics, camera_from_world)
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
        red, green, blue = 0.0, 0.0, 0.0
        num_valid = 0
        num_clipped = 0
        for a in range(taps_x):
            for b in range(taps_y):
                dx = (a + 0.5) / taps_x - 0.5
                dy = (b + 0.5) / taps_y - 0.5
                su, sv, _ = project(p, sx, sy, dx, dy, intrinsics, camera_from_world)
                good, saturated, red, green, blue = _bilinear(
                    su, sv, radiance, valid, clipped, red, green, blue
                )
                num_valid += good
                num_clipped += saturated
        # Partly saturated is no bound: a lamp's neighbour catches some of its light.
        if num_valid == 4 * taps_x * taps_y:
            brightest = max(red, green, blue)
            if glare[row, column] * (taps_x * taps_y) > _GLARE_CONTRAST * brightest:
                continue
            kind[m] = SAMPLE
            values[m, 0] = red / (taps_x * taps_y)
            values[m, 1] = green / (taps_x * taps_y)
            values[m, 2] = blue / (taps_x * taps_y)
        elif num_clipped == 4 * taps_x * taps_y:
            kind[m] = CLIPPED


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
    u: float,
    v: float,
    radiance: Float,
    valid: Bool,
    clipped: Bool,
    red: float,
    green: float,
    blue: float,
) -> tuple[int, int, float, float, float]:
    """How many of the four pixels around (u, v) are valid, and clipped; and the image there added
    to red, green and blue."""
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
            red += w * radiance[j + b, i + a, 0]
            green += w * radiance[j + b, i + a, 1]
            blue += w * radiance[j + b, i + a, 2]
    return num_valid, num_clipped, red, green, blue
