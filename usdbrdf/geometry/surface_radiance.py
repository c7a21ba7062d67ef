"""Radiance as a texture on the whole scene's surface, looked up where a ray hits it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf.geometry.packed_texture import (
    AHEAD,
    PackedArrays,
    colour_looked_at,
    empty_looks,
    fetch_face,
    look_at,
    packed_faces,
    packed_pixels,
)
from usdbrdf.geometry.texels import Texels
from usdbrdf.kernel import parallel_kernel

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class SurfaceTexture:
    """All atlases in one flat array, gutters dilated, as ``packed_texture`` lays them out.

    pixels  (P + some, 4) float32; faces (F, 8) float32, places (F, 8) int32: see ``PackedArrays``
    """

    pixels: Float
    faces: Float
    places: Int

    @property
    def arrays(self) -> PackedArrays:
        """What the kernels take."""
        return self.pixels, self.faces, self.places

    def showing(self, texels: Texels, values: Float) -> SurfaceTexture:
        """Other values (T, 3) of the same texels."""
        return replace(self, pixels=_pixels(texels, values))

    def at(self, face: Int, u: Float, v: Float) -> Float:
        """Bilinear values (R, 3) at barycentric (u, v) of the faces; 0 where face is -1."""
        return _lookup(self.arrays, face, u, v)


def surface_texture(texels: Texels, face_object: Int, values: Float) -> SurfaceTexture:
    """Per-texel values (T, 3) as a texture that can be looked up anywhere on the surface."""
    faces, places = packed_faces(
        texels.corner_pixel, texels.first_pixel[face_object], texels.resolution[face_object]
    )
    return SurfaceTexture(pixels=_pixels(texels, values), faces=faces, places=places)


def _pixels(texels: Texels, values: Float) -> Float:
    return packed_pixels(values, texels.nearest_texel, int(texels.resolution[:, 0].max(initial=1)))


@parallel_kernel
def _lookup(texture: PackedArrays, face: Int, u: Float, v: Float) -> Float:
    out = np.zeros((len(face), 3), np.float32)
    for part in prange((len(face) + AHEAD - 1) // AHEAD):
        looks, first = empty_looks(), part * AHEAD
        count = min(AHEAD, len(face) - first)
        for i in range(count):
            fetch_face(texture, max(face[first + i], 0))
        for i in range(count):
            r = first + i
            look_at(texture, looks, i, max(face[r], 0), u[r], v[r])
        for i in range(count):
            if face[first + i] >= 0:
                red, green, blue = colour_looked_at(texture, looks, i)
                out[first + i, 0], out[first + i, 1], out[first + i, 2] = red, green, blue
    return out
