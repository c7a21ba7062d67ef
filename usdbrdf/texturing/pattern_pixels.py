"""What pixels show beside what is known of a surface, and by what shares they cover its texels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from usdbrdf import calibration
from usdbrdf.geometry.visible_faces import place_on_face, visible_faces
from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.texturing.samples import MIN_COSINE, FirstSurfaces, Picture, glares, shows_surface
from usdbrdf.transport.rays import RayScene

# Texels to each side of a pixel's middle that it may cover. A larger pixel tells nothing of them.
REACH = 2
ACROSS = 2 * REACH + 1
# Pixels around one whose mean residual is taken off it, to each side; so many of them are enough.
_COMMON = 3
_ENOUGH = 10
# What a pixel covers is read so often per texel; neighbours' steps on the atlas may differ by so
# much, else a seam lies between them.
_TAPS, _BENT = 2.0, 0.25
_OUTLYING = calibration.number("patterns.outlying")


class PatternedSurface(NamedTuple):
    """What patterns are looked for on: ``values`` (T, 3), W/(m^2 sr), of texels, and the ``object``
    of each (T,); ``own`` (P,) int32 the texel of every flat pixel that is asked for, else -1;
    variance (T,) of a pixel's errors."""

    scene: Scene
    rays: RayScene
    texels: Texels
    object: Int
    values: Float
    own: Int
    variance: Float


class Covering(NamedTuple):
    """M pixels of a frame: texel (M,) int32 in the middle of each; where (M, 2) float32, x right
    and y down in its atlas, and step (M, 2, 2), the next pixel right's and the next one's below;
    rest (M, 3), what they show beside what is known; weight (M,), 1 / variance."""

    texel: Int
    where: Float
    step: Float
    rest: Float
    weight: Float

    def take(self, which: Bool) -> Covering:
        return Covering._make(values[which] for values in self)


def pixels_of_frame(
    surface: PatternedSurface,
    picture: Picture,
    camera: Camera,
    noise: float,
    error: float,
    part: slice | None = None,
) -> Covering:
    """Those that show texels of ``surface``, of ``part`` alone if it is given, and no edge, with
    the deviation ``noise``, W/(m^2 sr), and the share ``error`` of their radiance."""
    scene, texels = surface.scene, surface.texels
    face, point = visible_faces(surface.rays, camera)
    surfaces = FirstSurfaces.of(face, point, scene.face_object)
    size = face.shape
    texel = np.full(size, -1, np.int32)
    where = np.zeros((*size, 2), np.float32)
    _places(
        size[0], scene.points, scene.triangles, scene.face_object, texels.corner_pixel,
        texels.first_pixel, texels.resolution, surface.own, face, point, texel, where,
    )  # fmt: skip
    asked = texel >= 0
    fits = picture.valid & asked & ~glares(picture)
    if part is not None:
        asked = (texel >= part.start) & (texel < part.stop)
        # What others have in common with these counts.
        fits &= maximum_filter(asked, 2 * _COMMON + 1)
    step = np.zeros((*size, 2, 2), np.float32)
    rest = np.full((*size, 3), np.nan, np.float32)
    pixel_size = 1 / float(camera.intrinsics[0])
    eye = np.array(camera.eye, np.float64)
    _residuals(
        size[0], surface.own, surface.values, texels.pixel, texels.first_pixel,
        texels.resolution, texels.position, texels.geometric_normal, eye, pixel_size,
        surfaces, picture.radiance, fits, texel, where, step, rest,
    )  # fmt: skip
    weight = np.zeros(size, np.float32)
    beside = np.empty_like(rest)
    _without_common(
        size[0], surfaces.object, texel, rest, surface.values, surface.variance, noise, error,
        beside, weight,
    )  # fmt: skip
    kept = (weight > 0) & asked
    return Covering(texel[kept], where[kept], step[kept], beside[kept], weight[kept])


@parallel_kernel
def _places(
    start: int, stop: int, points: Float, triangles: Int, face_object: Int, corner_pixel: Float,
    first_pixel: Long, resolution: Int, own: Int, face: Int, point: Float, texel: Int,
    where: Float,
) -> None:  # fmt: skip
    """Of each pixel the place of its point in its object's atlas, and its texel."""
    for j in range(start, stop):
        for i in range(face.shape[1]):
            f = face[j, i]
            if f < 0:
                continue
            known, u, v = place_on_face(points, triangles, f, point[j, i])
            if not known:
                continue
            for k in range(2):
                q = corner_pixel[f]
                where[j, i, k] = (1 - u - v) * q[0, k] + u * q[1, k] + v * q[2, k]
            o = face_object[f]
            width, height = resolution[o, 0], resolution[o, 1]
            x, y = int(np.floor(where[j, i, 0])), int(np.floor(where[j, i, 1]))
            if 0 <= x < width and 0 <= y < height:
                texel[j, i] = own[first_pixel[o] + y * width + x]


@parallel_kernel
def _residuals(
    start: int, stop: int, own: Int, values: Float, pixel: Long, first_pixel: Long,
    resolution: Int, position: Float, normal: Float, eye: Double, pixel_size: float,
    surfaces: FirstSurfaces, radiance: Float, fits: Bool, texel: Int, where: Float, step: Float,
    rest: Float,
) -> None:  # fmt: skip
    """What pixels show beside the means of ``values`` over what they cover, and the steps from
    each to the next ones; NaN stays where a pixel tells nothing of a pattern."""
    height, width = fits.shape
    covered = np.empty(ACROSS * ACROSS, np.float32)
    for j in range(max(start, 1), min(stop, height - 1)):
        for i in range(1, width - 1):
            if not fits[j, i]:
                continue
            t, o = texel[j, i], surfaces.object[j, i]
            x, y, z = eye[0] - position[t, 0], eye[1] - position[t, 1], eye[2] - position[t, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            cosine = x * normal[t, 0] + y * normal[t, 1] + z * normal[t, 2]
            if cosine < MIN_COSINE * distance or not shows_surface(
                j, i, 1, position[t], normal[t], o, distance * pixel_size, surfaces
            ):
                continue
            bent = 0.0
            for k in range(2):
                left, right = where[j, i - 1, k], where[j, i + 1, k]
                above, below = where[j - 1, i, k], where[j + 1, i, k]
                step[j, i, 0, k] = (right - left) / 2
                step[j, i, 1, k] = (below - above) / 2
                bent += abs(left + right - 2 * where[j, i, k])
                bent += abs(above + below - 2 * where[j, i, k])
            if bent > _BENT * np.abs(step[j, i]).sum():
                continue
            wide = resolution[o, 0]
            at = pixel[t] - first_pixel[o]
            row, column = at // wide, at % wide
            if not covers(where[j, i], step[j, i], column, row, wide, resolution[o, 1], covered):
                continue
            red, green, blue, known = 0.0, 0.0, 0.0, True
            for n in range(len(covered)):
                if covered[n] > 0:
                    down, along = n // ACROSS - REACH, n % ACROSS - REACH
                    s = own[pixel[t] + down * wide + along]
                    known = known and s >= 0
                    if s >= 0:
                        red += covered[n] * values[s, 0]
                        green += covered[n] * values[s, 1]
                        blue += covered[n] * values[s, 2]
            if known:
                rest[j, i, 0] = radiance[j, i, 0] - red
                rest[j, i, 1] = radiance[j, i, 1] - green
                rest[j, i, 2] = radiance[j, i, 2] - blue


@kernel
def covers(
    where: Float, step: Float, column: int, row: int, width: int, height: int, covered: Float
) -> bool:
    """By what shares a pixel, its middle at ``where``, covers the texels around (column, row):
    covered (25,), in rows. False where it covers others too."""
    covered[:] = 0
    long_x, long_y = np.abs(step[0]).max(), np.abs(step[1]).max()
    if max(long_x, long_y) > ACROSS:
        return False
    taps_x, taps_y = int(np.ceil(_TAPS * long_x)) + 1, int(np.ceil(_TAPS * long_y)) + 1
    share = np.float32(1 / (taps_x * taps_y))
    for b in range(taps_y):
        for a in range(taps_x):
            right, down = (a + 0.5) / taps_x - 0.5, (b + 0.5) / taps_y - 0.5
            # A texel's middle lies half a pixel of the atlas off its corner.
            x = where[0] + right * step[0, 0] + down * step[1, 0] - 0.5
            y = where[1] + right * step[0, 1] + down * step[1, 1] - 0.5
            x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
            i, j = int(x), int(y)
            fx, fy = x - i, y - j
            for corner in range(4):
                e, d = corner % 2, corner // 2
                part = (fx if e else 1 - fx) * (fy if d else 1 - fy)
                if part <= 0:
                    continue
                along, down_by = i + e - column, j + d - row
                if abs(along) > REACH or abs(down_by) > REACH:
                    return False
                covered[(down_by + REACH) * ACROSS + along + REACH] += share * part
    return True


@parallel_kernel
def _without_common(
    start: int, stop: int, shown: Int, texel: Int, rest: Float, values: Float, variance: Float,
    noise: float, error: float, beside: Float, weight: Float,
) -> None:  # fmt: skip
    """What is left of each pixel's rest without the mean of those around it on its object, and its
    weight: that of its error, less the further it lies off (A. Beaton and J. Tukey, 1974)."""
    height, width = shown.shape
    for j in range(start, stop):
        for i in range(width):
            if not np.isfinite(rest[j, i, 0]):
                continue
            count, red, green, blue = 0, 0.0, 0.0, 0.0
            for n in range(max(j - _COMMON, 0), min(j + _COMMON + 1, height)):
                for m in range(max(i - _COMMON, 0), min(i + _COMMON + 1, width)):
                    if shown[n, m] == shown[j, i] and np.isfinite(rest[n, m, 0]):
                        count += 1
                        red += rest[n, m, 0]
                        green += rest[n, m, 1]
                        blue += rest[n, m, 2]
            if count < _ENOUGH:
                continue
            beside[j, i, 0] = rest[j, i, 0] - red / count
            beside[j, i, 1] = rest[j, i, 1] - green / count
            beside[j, i, 2] = rest[j, i, 2] - blue / count
            t = texel[j, i]
            level = (values[t, 0] + values[t, 1] + values[t, 2]) / 3
            own = (error * level) ** 2 + noise * noise
            off = 0.0
            for c in range(3):
                off += beside[j, i, c] ** 2 / 3
            off /= _OUTLYING**2 * (own + variance[t])
            if off < 1:
                weight[j, i] = (1 - off) ** 2 / max(own, 1e-30)
