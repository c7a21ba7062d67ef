"""A texture of the surface laid out for random access: what is read together lies together.

A look-up waits for memory: it reads one line of it for the triangle, and one or two for each of two
rows of pixels.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from usdbrdf.kernel import loop

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]

# pixels (P, 4) float32; per triangle (F, 8) float32: pixel of its first corner, edges to the others
# in pixels, and the same memory as int32, whose last two are the atlas's first pixel and its width
# and height, 16 bits each.
PackedArrays: TypeAlias = tuple[Float, Float, Int]

_ZERO, _ONE = np.float32(0), np.float32(1)


def packed_arrays(pixels: Float, corner_pixel: Float, first_pixel: Long, size: Int) -> PackedArrays:
    """What ``SurfaceTexture`` holds, laid out anew."""
    # A row and a pixel more than there are, all 0: an atlas of one column or row has no neighbours.
    padded = np.zeros((len(pixels) + int(size[:, 0].max(initial=1)) + 2, 4), np.float32)
    padded[: len(pixels), :3] = pixels
    faces = np.zeros((len(size), 8), np.float32)
    faces[:, 0:2] = corner_pixel[:, 0] - 0.5
    faces[:, 2:4] = corner_pixel[:, 1] - corner_pixel[:, 0]
    faces[:, 4:6] = corner_pixel[:, 2] - corner_pixel[:, 0]
    places = faces.view(np.int32)
    places[:, 6] = first_pixel
    places[:, 7] = size[:, 0] | size[:, 1] << 16
    return padded, faces, places


@loop
def unsigned(number: int) -> int:
    unsigned_number: int = np.uint32(number)  # type: ignore[assignment]
    return unsigned_number


@loop
def packed_place(
    texture: PackedArrays, f: int, u: float, v: float
) -> tuple[int, int, float, float]:
    """As ``surface_radiance.texture_place``, with the distance to the next row of pixels."""
    _, faces, places = texture
    # Unsigned: the compiler need not think of places counted from the end.
    f = unsigned(f)
    width = places[f, 7] & 0xFFFF
    height = places[f, 7] >> 16
    x = faces[f, 0] + u * faces[f, 2] + v * faces[f, 4]
    y = faces[f, 1] + u * faces[f, 3] + v * faces[f, 5]
    x = min(max(x, _ZERO), np.float32(width - 1))
    y = min(max(y, _ZERO), np.float32(height - 1))
    i = np.int32(min(np.int32(x), max(width - 2, 0)))
    j = np.int32(min(np.int32(y), max(height - 2, 0)))
    k = places[f, 6] + j * width + i
    return unsigned(k), unsigned(width), x - np.float32(i), y - np.float32(j)


@loop
def packed_colour(
    texture: PackedArrays, k: int, width: int, fx: float, fy: float
) -> tuple[float, float, float]:
    """All three channels at a ``packed_place``, bilinear."""
    p, right, low = texture[0], unsigned(k + 1), unsigned(k + width)
    low_right = unsigned(low + 1)
    gx, gy = _ONE - fx, _ONE - fy
    a, b, c, d = gx * gy, fx * gy, gx * fy, fx * fy
    return (
        a * p[k, 0] + b * p[right, 0] + c * p[low, 0] + d * p[low_right, 0],
        a * p[k, 1] + b * p[right, 1] + c * p[low, 1] + d * p[low_right, 1],
        a * p[k, 2] + b * p[right, 2] + c * p[low, 2] + d * p[low_right, 2],
    )
