"""What one frame says about each texel: visible, valid, and which radiance.

The loop is over texels, not pixels. A texel takes a sample where it faces the camera, where the
pixels around its projection (3 x 3, or as many as its footprint covers) all show its own object
near its own tangent plane (so it is unoccluded, and away from depth edges and the image border),
and where every pixel of its footprint lies between noise floor and saturation in every channel.
Beside a lamp it takes none: no lens and no filter keeps all of a lamp's light to its own pixels.
Of what is thinner than that, a pixel whose centre shows the texel is a glimpse of it at least.
What no frame measures because it is too dark is known to be dark: that is told as well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf import calibration
from usdbrdf.files.frames import FramePixels
from usdbrdf.geometry.visible_faces import visible_faces
from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.model.arrays import Bool, Double, Float, Int
from usdbrdf.model.camera import Camera
from usdbrdf.model.texels import Texels
from usdbrdf.transport.rays import RayScene

_GLARING = calibration.number("glare.from")
_REACH = calibration.count("glare.reach")


def brightest_glare(radiance: Float, valid: Bool, clipped: Bool) -> Float:
    """(H, W) float32: the brightest glaring pixel nearby, in any channel; 0 where there is none."""
    level = np.empty(valid.shape, np.float32)
    _levels(len(level), radiance, valid, clipped, level)
    brightest = np.zeros(valid.shape, np.float32)
    glares = np.zeros(len(level), np.bool_)
    _keep_above(len(level), np.float32(_GLARING * _median(level, valid)), level, glares)
    if glares.any():
        _spread(len(level), level, glares, brightest)
    return brightest


@parallel_kernel
def _levels(
    first: int, last: int, radiance: Float, valid: Bool, clipped: Bool, level: Float
) -> None:
    """The brightest channel; 0 where a pixel is neither valid nor clipped."""
    for j in range(first, last):
        for i in range(valid.shape[1]):
            known = valid[j, i] or clipped[j, i]
            brightest = max(radiance[j, i, 0], radiance[j, i, 1], radiance[j, i, 2])
            level[j, i] = brightest if known else np.float32(0)


def _median(level: Float, valid: Bool) -> float:
    """np.median of the valid levels, in a quarter of its time; 0 if there are none."""
    levels = level[valid]
    if not len(levels):
        return 0.0
    middle = [(len(levels) - 1) // 2, len(levels) // 2]
    return float(np.partition(levels, middle)[middle].mean())


@parallel_kernel
def _keep_above(first: int, last: int, limit: np.float32, level: Float, glares: Bool) -> None:
    """Zero what glares not; ``glares`` (H,): rows where anything is left."""
    for j in range(first, last):
        for i in range(level.shape[1]):
            if level[j, i] > limit:
                glares[j] = True
            else:
                level[j, i] = 0


@parallel_kernel
def _spread(first: int, last: int, level: Float, glares: Bool, brightest: Float) -> None:
    """The largest level within _REACH pixels to all sides."""
    height, width = level.shape
    for j in range(first, last):
        for k in range(max(0, j - _REACH), min(height, j + _REACH + 1)):
            if not glares[k]:
                continue
            for i in range(width):
                for n in range(max(0, i - _REACH), min(width, i + _REACH + 1)):
                    brightest[j, i] = max(brightest[j, i], level[k, n])


MIN_COSINE = calibration.number("samples.min_cosine")
# Sub-samples of a texel's footprint per side, at most.
_MAX_TAPS = 4
_GLARE_CONTRAST = calibration.number("samples.glare_contrast")
NOTHING, SAMPLE, CLIPPED, DARK, GLIMPSE = 0, 1, 2, 3, 4


class FirstSurfaces(NamedTuple):
    """What each pixel of one frame sees: object (H, W) int32 (-1: nothing) and the point
    (H, W, 3) float32 in the world."""

    object: Int
    point: Float

    @classmethod
    def of(cls, face: Int, point: Float, face_object: Int) -> FirstSurfaces:
        """Those of triangles (H, W), -1 where there is none, at points (H, W, 3)."""
        shown = face_object[face]
        shown[face < 0] = -1
        return cls(shown, point)


class Picture(NamedTuple):
    """One frame: radiance (H, W, 3) float32; valid, clipped, dark (H, W) bool."""

    radiance: Float
    valid: Bool
    clipped: Bool
    dark: Bool

    @classmethod
    def of(cls, pixels: FramePixels) -> Picture:
        return cls(pixels.radiance, pixels.valid, pixels.clipped, pixels.dark)


def glares(picture: Picture) -> Bool:
    """(H, W): pixels beside something so bright that its light lies on them too."""
    radiance, valid, clipped, _ = picture
    glare = brightest_glare(radiance, valid, clipped)
    return np.asarray(glare > _GLARE_CONTRAST * radiance.max(axis=2), np.bool_)


class Projection(NamedTuple):
    """The camera as kernels take it: eye (3,), camera_from_world (4, 4), intrinsics (4,)."""

    eye: Double
    camera_from_world: Double
    intrinsics: Double

    @classmethod
    def of(cls, camera: Camera) -> Projection:
        inverse = np.linalg.inv(camera.world_from_camera).astype(np.float64, copy=False)
        return cls(camera.eye.copy(), inverse, np.asarray(camera.intrinsics, np.float64))


class _Image(NamedTuple):
    """What the pixels of one frame see, and how brightly something nearby glares, (H, W)."""

    object: Int
    point: Float
    radiance: Float
    valid: Bool
    clipped: Bool
    dark: Bool
    glare: Float


class _Surface(NamedTuple):
    """The texels' positions, normals and steps, each (T, 3), and objects, (T,)."""

    position: Float
    normal: Float
    step_x: Float
    step_y: Float
    object: Int


def first_surfaces(rays: RayScene, face_object: Int, camera: Camera) -> FirstSurfaces:
    """The first hits of the rays through all pixels' centres."""
    return FirstSurfaces.of(*visible_faces(rays, camera), face_object)


def samples_from_frame(
    texels: Texels,
    texel_object: Int,
    surfaces: FirstSurfaces,
    picture: Picture,
    camera: Camera,
    *,
    which: Int | None = None,
    beside_glare: bool = False,
    glimpses: bool = False,
) -> tuple[npt.NDArray[np.int8], Float]:
    """Of the texels ``which`` (M,) int32 (None: all): NOTHING, SAMPLE, CLIPPED (visible, and
    saturated all over its footprint), DARK (visible, and below the noise floor in some channel
    and pixel) or GLIMPSE (visible at the centre of a pixel that may show more than it), (M,) int8;
    and the radiance (M, 3) float32 of what is SAMPLE, DARK or GLIMPSE, of DARK with the noise.

    texel_object  (T,) int32
    beside_glare  take samples there too, for whom highlights matter
    glimpses      whether these are asked for
    """
    if which is None:
        which = np.arange(len(texels), dtype=np.int32)
    none = np.zeros(picture.valid.shape, np.float32)
    radiance, valid, clipped, dark = picture
    glare = none if beside_glare else brightest_glare(radiance, valid, clipped)
    image = _Image(*surfaces, radiance, valid, clipped, dark, glare)
    surface = _Surface(
        texels.position, texels.geometric_normal, texels.step_x, texels.step_y, texel_object
    )
    kind, values = np.zeros(len(which), np.int8), np.zeros((len(which), 3), np.float32)
    _sample(len(which), which, surface, image, Projection.of(camera), glimpses, kind, values)
    return kind, values


@kernel
def project(
    p: Float, sx: Float, sy: Float, dx: float, dy: float, camera: Projection
) -> tuple[float, float, float]:
    """Pixel of the point p + dx sx + dy sy and its depth in front of the camera."""
    m, k = camera.camera_from_world, camera.intrinsics
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
    first: int,
    last: int,
    which: Int,
    surface: _Surface,
    image: _Image,
    camera: Projection,
    glimpses: bool,
    kind: npt.NDArray[np.int8],
    values: Float,
) -> None:
    for m in range(first, last):
        kind[m] = _sample_of(which[m], surface, image, camera, glimpses, values[m])


@kernel
def _sample_of(
    t: int, surface: _Surface, image: _Image, camera: Projection, glimpses: bool, value: Float
) -> int:
    """What the frame shows of texel t; its radiance goes to ``value`` (3,)."""
    height, width = image.valid.shape
    p, n, eye = surface.position[t], surface.normal[t], camera.eye
    wx, wy, wz = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
    distance = np.sqrt(wx * wx + wy * wy + wz * wz)
    if n[0] * wx + n[1] * wy + n[2] * wz < MIN_COSINE * distance:
        return NOTHING
    sx, sy = surface.step_x[t], surface.step_y[t]
    u, v, depth = project(p, sx, sy, 0.0, 0.0, camera)
    column = int(np.floor(u))
    row = int(np.floor(v))
    if depth < 0 or column < 1 or row < 1 or column > width - 2 or row > height - 2:
        return NOTHING
    ux, vx, _ = project(p, sx, sy, 1.0, 0.0, camera)
    uy, vy, _ = project(p, sx, sy, 0.0, 1.0, camera)
    taps_x = min(_MAX_TAPS, max(1, int(np.ceil(np.sqrt((ux - u) ** 2 + (vx - v) ** 2)))))
    taps_y = min(_MAX_TAPS, max(1, int(np.ceil(np.sqrt((uy - u) ** 2 + (vy - v) ** 2)))))
    # How far from the centre bilinear reading of the footprint's taps reaches, in pixels.
    off_x, off_y = 0.5 - 0.5 / taps_x, 0.5 - 0.5 / taps_y
    wide = off_x * abs(ux - u) + off_y * abs(uy - u)
    high = off_x * abs(vx - v) + off_y * abs(vy - v)
    reach = max(1, int(np.ceil(max(wide, high) + 0.5)))
    own, size = surface.object[t], depth / camera.intrinsics[0]
    if not shows_surface(row, column, reach, p, n, own, size, image):
        if not (glimpses and shows_surface(row, column, 0, p, n, own, size, image)):
            return NOTHING
        value[:] = image.radiance[row, column]
        glares = image.glare[row, column] > _GLARE_CONTRAST * value.max()
        return GLIMPSE if image.valid[row, column] and not glares else NOTHING
    taps = taps_x * taps_y
    red, green, blue = 0.0, 0.0, 0.0
    num_valid, num_clipped, num_dark = 0, 0, 0
    for tap in range(taps):
        dx = (tap // taps_y + 0.5) / taps_x - 0.5
        dy = (tap % taps_y + 0.5) / taps_y - 0.5
        su, sv, _ = project(p, sx, sy, dx, dy, camera)
        x = min(max(su - 0.5, 0.0), width - 1.001)
        y = min(max(sv - 0.5, 0.0), height - 1.001)
        i, j = int(x), int(y)
        fx, fy = x - i, y - j
        for corner in range(4):
            a, b = corner % 2, corner // 2
            w = (fx if a else 1 - fx) * (fy if b else 1 - fy)
            num_valid += image.valid[j + b, i + a]
            num_clipped += image.clipped[j + b, i + a]
            num_dark += image.dark[j + b, i + a]
            red += w * image.radiance[j + b, i + a, 0]
            green += w * image.radiance[j + b, i + a, 1]
            blue += w * image.radiance[j + b, i + a, 2]
    # Partly saturated is no bound: a lamp's neighbour catches some of its light.
    if num_clipped == 4 * taps:
        return CLIPPED
    # A lamp's light beside it makes what is dark brighter: it is at least as dark as it looks.
    is_dark = num_dark > 0 and num_clipped == 0 and num_valid + num_dark == 4 * taps
    glares = image.glare[row, column] * taps > _GLARE_CONTRAST * max(red, green, blue)
    if not is_dark and (num_valid < 4 * taps or glares):
        return NOTHING
    value[0], value[1], value[2] = red / taps, green / taps, blue / taps
    return DARK if is_dark else SAMPLE


@kernel
def shows_surface(
    row: int, column: int, reach: int, p: Float, n: Float, own: int, pixel_size: float,
    surfaces: FirstSurfaces | _Image,
) -> bool:  # fmt: skip
    """Do all pixels within ``reach`` show object ``own``, a pixel's size off its plane at most?"""
    height, width = surfaces.object.shape
    if row < reach or column < reach or row + reach >= height or column + reach >= width:
        return False
    for j in range(row - reach, row + reach + 1):
        for i in range(column - reach, column + reach + 1):
            if surfaces.object[j, i] != own:
                return False
            s = surfaces.point[j, i]
            off = (s[0] - p[0]) * n[0] + (s[1] - p[1]) * n[1] + (s[2] - p[2]) * n[2]
            if abs(off) > pixel_size:
                return False
    return True
