"""How much more light falls on what a pixel covers than on the texel that takes a sample of it.

A pixel shows the mean of what it covers. Where that is lit unevenly, as on mouldings as narrow as
itself or in the shade of slats, a texel's sample holds its neighbours' light, while S is the
texel's own: their quotient would show the pattern of the light turned round, and would be too
bright on the mean. Of a surface of one albedo all over a pixel the texel itself would show

    L S / mean of S over the pixel,

whatever the shape of that surface: edges of charts and of faces do not matter here, as they do
where textures are blurred in their atlas. S is drawn into the picture and read there just as the
picture is (``samples_from_frame``)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from usdbrdf import calibration
from usdbrdf.geometry.visible_faces import place_on_face, visible_faces
from usdbrdf.kernel import parallel_kernel
from usdbrdf.model.arrays import Float, Int
from usdbrdf.model.camera import Camera
from usdbrdf.texturing.samples import Picture, first_surfaces, samples_from_frame
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.surface_texture import SurfaceTexture, packed_place

# Points of a pixel to each side, and how much of them its mean takes: a pixel's square, blurred by
# half its side. With bilinear reading that is a deviation of 0.6 pixels, ``refine.sample_blur``.
_ACROSS, _TAPS = 2, np.array([1, 3, 3, 1]) / 8
# Points at a time, which bounds the memory.
_AT_ONCE = 1 << 20
_MOST = calibration.number("refine.most_uneven")


def beside_own_light(
    surface: TexturedScene, owner: Int, light: SurfaceTexture, texel: Int, camera: Camera
) -> Float:
    """(M, 3): the mean of S over what ``camera`` reads for texels (M,) over their own; 1 where
    either is not known, and within reason elsewhere.

    owner  (T,): the object of each texel of the surface
    light  S as a texture of it, W/m^2
    """
    if not len(texel):  # as of most frames where many workers share the texels out
        return np.ones((0, 3), np.float32)
    texels = surface.texels
    drawn = light_on_pixels(surface, light, camera)
    every, none = np.ones(drawn.shape[:2], np.bool_), np.zeros(drawn.shape[:2], np.bool_)
    _, mean = samples_from_frame(
        texels,
        owner,
        first_surfaces(surface.rays, surface.scene.face_object, camera),
        Picture(drawn, every, none, none),
        camera,
        which=texel,
        beside_glare=True,
    )
    own = light.pixels[texels.pixel[texel], :3]
    ratio = np.clip(mean / np.maximum(own, np.finfo(np.float32).tiny), 1 / _MOST, _MOST)
    return np.where((own > 0) & (mean > 0), ratio, 1).astype(np.float32)


def light_on_pixels(surface: TexturedScene, light: SurfaceTexture, camera: Camera) -> Float:
    """(H, W, 3) W/m^2: the mean of S, ``light``, over what each pixel covers of surfaces; 0 where
    it covers none."""
    found = np.empty((camera.height, camera.width, 3), np.float32)
    fine = camera.at_size(_ACROSS * camera.width, _ACROSS * camera.height)
    rows = max(1, _AT_ONCE // (_ACROSS * fine.width))
    for low in range(0, camera.height, rows):
        high = min(low + rows, camera.height)
        # A point more above and below, which the mean takes too.
        part = fine.rows(_ACROSS * low - 1, _ACROSS * high + 1)
        face, point = visible_faces(surface.rays, part)
        shown = np.zeros((*face.shape, 4), np.float32)
        points, triangles = surface.scene.points, surface.scene.triangles
        _light_at(len(face), points, triangles, light, face, point, shown)
        mean = _means(shown)
        found[low:high] = mean[..., :3] / np.maximum(mean[..., 3:], 1e-6)
    return found


def _means(points: Float) -> Float:
    """Of (2 H + 2, 2 W, C) points, a row of them beyond both borders, the means over H x W pixels;
    what lies beyond the sides counts as what lies there."""
    down = ndimage.correlate1d(points, _TAPS, axis=0, origin=-2)[0:-2:_ACROSS]
    across = np.pad(down, ((0, 0), (1, 1), (0, 0)), mode="edge")
    mean: Float = ndimage.correlate1d(across, _TAPS, axis=1, origin=-2)[:, 0:-2:_ACROSS]
    return mean


@parallel_kernel
def _light_at(
    start: int, stop: int, points: Float, triangles: Int, light: SurfaceTexture, face: Int,
    point: Float, out: Float,
) -> None:  # fmt: skip
    """S at the points (H, W, 3) on triangles (H, W), and 1; zeros where there is none."""
    for j in range(start, stop):
        for i in range(face.shape[1]):
            f = face[j, i]
            if f < 0:
                continue
            known, u, v = place_on_face(points, triangles, f, point[j, i])
            if not known:
                continue
            place, width, x, y = packed_place(light, f, u, v)
            # S is the mean over a texel: between the middles of two it would be blurred once more.
            nearest = place + (x >= 0.5) + (width if y >= 0.5 else 0)
            for c in range(3):
                out[j, i, c] = light.pixels[nearest, c]
            out[j, i, 3] = 1.0
