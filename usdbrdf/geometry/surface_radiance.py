"""Radiance as a texture on the whole scene's surface, looked up where a ray hits it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from numba import prange

from usdbrdf.geometry.packed_texture import PackedArrays, packed_arrays
from usdbrdf.geometry.texels import Texels
from usdbrdf.kernel import kernel, loop, parallel_kernel

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]

# What the kernels take of a SurfaceTexture, in this order: pixels, corner_pixel, first_pixel, size.
TextureArrays: TypeAlias = tuple[Float, Float, Long, Int]


@dataclass(frozen=True, kw_only=True)
class SurfaceTexture:
    """All atlases in one flat array.

    pixels        (P, 3) float32, gutters dilated
    corner_pixel  (F, 3, 2) float32, the faces' corners in pixels of their own atlas
    first_pixel   (F,) int64, where the face's atlas starts in ``pixels``
    size          (F, 2) int32, width and height of the face's atlas
    """

    pixels: Float
    corner_pixel: Float
    first_pixel: Long
    size: Int

    @property
    def arrays(self) -> TextureArrays:
        return self.pixels, self.corner_pixel, self.first_pixel, self.size

    @cached_property
    def packed(self) -> PackedArrays:
        return packed_arrays(*self.arrays)

    def at(self, face: Int, u: Float, v: Float) -> Float:
        """Bilinear values (R, 3) at barycentric (u, v) of the faces; 0 where face is -1."""
        return _lookup(*self.arrays, face, u, v)


def surface_texture(texels: Texels, face_object: Int, values: Float) -> SurfaceTexture:
    """Per-texel values (T, 3) as a texture that can be looked up anywhere on the surface."""
    texel = texels.nearest_texel
    pixels = np.where(texel[:, None] >= 0, values[np.maximum(texel, 0)], 0).astype(np.float32)
    return SurfaceTexture(
        pixels=pixels,
        corner_pixel=texels.corner_pixel,
        first_pixel=texels.first_pixel[face_object],
        size=texels.resolution[face_object],
    )


@loop
def texture_place(radiance: TextureArrays, f: int, u: float, v: float) -> tuple[int, float, float]:
    """Where a texture is read at barycentric (u, v) of face f: the upper left of four pixels, and
    how far from it, in pixels; for use inside kernels."""
    _, corner_pixel, first_pixel, size = radiance
    width = size[f, 0]
    height = size[f, 1]
    w = 1.0 - u - v
    x = w * corner_pixel[f, 0, 0] + u * corner_pixel[f, 1, 0] + v * corner_pixel[f, 2, 0] - 0.5
    y = w * corner_pixel[f, 0, 1] + u * corner_pixel[f, 1, 1] + v * corner_pixel[f, 2, 1] - 0.5
    x = min(max(x, 0.0), width - 1.0)
    y = min(max(y, 0.0), height - 1.0)
    i = min(int(x), max(width - 2, 0))
    j = min(int(y), max(height - 2, 0))
    return first_pixel[f] + j * width + i, x - i, y - j


@kernel
def texture_at(
    pixels: Float,
    corner_pixel: Float,
    first_pixel: Long,
    size: Int,
    face: int,
    u: float,
    v: float,
    channel: int,
) -> float:
    """One channel at barycentric (u, v) of a face, bilinear; for use inside kernels."""
    k, fx, fy = texture_place((pixels, corner_pixel, first_pixel, size), face, u, v)
    width = size[face, 0]
    height = size[face, 1]
    right = 1 if width > 1 else 0
    down = width if height > 1 else 0
    top = pixels[k, channel] * (1 - fx) + pixels[k + right, channel] * fx
    low = pixels[k + down, channel] * (1 - fx) + pixels[k + down + right, channel] * fx
    value: float = top * (1 - fy) + low * fy
    return value


@parallel_kernel
def _lookup(
    pixels: Float,
    corner_pixel: Float,
    first_pixel: Long,
    size: Int,
    face: Int,
    u: Float,
    v: Float,
) -> Float:
    out = np.zeros((len(face), 3), np.float32)
    for r in prange(len(face)):
        if face[r] >= 0:
            for c in range(3):
                out[r, c] = texture_at(
                    pixels, corner_pixel, first_pixel, size, face[r], u[r], v[r], c
                )
    return out
