"""Radiance as a texture on the whole scene's surface, laid out for random access: what is read
together lies together."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from usdbrdf.kernel import loop, parallel_kernel
from usdbrdf.model.arrays import Bits, Double, Float, Int, Long
from usdbrdf.model.texels import Texels

# Places to ask for before the first is read: few enough to be in the nearest cache then.
AHEAD = 128
# Pixels that are laid out at a time, and bytes of a line of the cache.
_AT_A_TIME, _LINE = 1 << 16, 64
# Of a prefetch: to be read, for long, data.
_READ, _KEEP, _DATA = 0, 3, 1
_ZERO, _ONE = np.float32(0), np.float32(1)


class SurfaceTexture(NamedTuple):
    """All atlases in one flat array, gutters dilated.

    pixels  (P + some, 4) float32
    faces   (F, 8) float32, of each triangle the pixel of its first corner and the edges to the
            others in pixels
    places  (F, 8) int32, the same memory, whose last two are the atlas's first pixel and its width
            and height, 16 bits each
    """

    pixels: Float
    faces: Float
    places: Int

    def showing(self, texels: Texels, values: Float) -> SurfaceTexture:
        """Other values (T, 3) of the same texels."""
        return self._replace(pixels=_pixels(texels, values))

    def at(self, face: Int, u: Float, v: Float) -> Float:
        """Bilinear values (R, 3) at barycentric (u, v) of the faces; 0 where face is -1."""
        out = np.zeros((len(face), 3), np.float32)
        _lookup((len(face) + AHEAD - 1) // AHEAD, self, face, u, v, out)
        return out


class Looks(NamedTuple):
    """Places of a texture that many look-ups of a loop keep, the rows' widths, and the distances
    to the left and upper pixel's middle, (AHEAD,) each."""

    place: Bits
    width: Bits
    x: Float
    y: Float


def surface_texture(texels: Texels, face_object: Int, values: Float) -> SurfaceTexture:
    """Per-texel values (T, 3) as a texture that can be looked up anywhere on the surface."""
    faces, places = packed_faces(
        texels.corner_pixel, texels.first_pixel[face_object], texels.resolution[face_object]
    )
    return SurfaceTexture(_pixels(texels, values), faces, places)


def _pixels(texels: Texels, values: Float) -> Float:
    return packed_pixels(values, texels.nearest_texel, int(texels.resolution[:, 0].max(initial=1)))


def packed_pixels(values: Float, shown: Int, widest: int) -> Float:
    """``values`` (T, 3) in the order of the atlases' pixels, which show ``shown`` (P,) (-1: none);
    widest: the largest width of an atlas."""
    # A row and a pixel more than there are, all 0: an atlas of one column or row has no neighbours.
    pixels = _zeros(len(shown) + widest + 2, 4)
    for start in range(0, len(shown), _AT_A_TIME):
        part = shown[start : start + _AT_A_TIME]
        colours = values[np.maximum(part, 0)]
        colours[part < 0] = 0
        # Zeros that nobody writes take no memory.
        if colours.any():
            pixels[start : start + len(part), :3] = colours
    return pixels


def packed_faces(corner_pixel: Float, first_pixel: Long, size: Int) -> tuple[Float, Int]:
    """Where the faces lie in the atlases, as float32 and as int32.

    corner_pixel (F, 3, 2) float32: the faces' corners in pixels of their own atlas; first_pixel
    (F,): where that starts; size (F, 2): its width and height
    """
    faces = _zeros(len(size), 8)
    faces[:, 0:2] = corner_pixel[:, 0] - 0.5
    faces[:, 2:4] = corner_pixel[:, 1] - corner_pixel[:, 0]
    faces[:, 4:6] = corner_pixel[:, 2] - corner_pixel[:, 0]
    places = faces.view(np.int32)
    places[:, 6] = first_pixel
    places[:, 7] = size[:, 0] | size[:, 1] << 16
    return faces, places


def _zeros(rows: int, columns: int) -> Float:
    """(rows, columns) float32 that start with a line of the cache, so that no face lies on two."""
    bytes_ = np.zeros(rows * columns * 4 + _LINE, np.uint8)
    first = -bytes_.ctypes.data % _LINE
    return bytes_[first : first + rows * columns * 4].view(np.float32).reshape(rows, columns)


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(_: Any, array: Any, row: Any) -> Any:
    """Fetch the line of the cache that holds the start of array[row]; never reads, never waits.
    For use inside kernels; ``row`` is not counted from the end."""

    def instruction(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        of_array = signature.args[0]
        data = context.make_array(of_array)(context, builder, values[0])
        first = context.get_constant(types.intp, 0)
        index = context.cast(builder, values[1], signature.args[1], types.intp)
        place = cgutils.get_item_pointer(
            context, builder, of_array, data, [index] + [first] * (of_array.ndim - 1)
        )
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        call = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(
            call, [builder.bitcast(place, byte), number(_READ), number(_KEEP), number(_DATA)]
        )
        return context.get_dummy_value()

    return types.void(array, row), instruction


@loop
def unsigned(number: int) -> int:
    unsigned_number: int = np.uint32(number)  # type: ignore[assignment]
    return unsigned_number


@loop
def packed_place(
    texture: SurfaceTexture, f: int, u: float, v: float
) -> tuple[int, int, float, float]:
    """Where a texture is read at barycentric (u, v) of face f: the upper left of four pixels, the
    distance to the next row of pixels, and how far the place is from its middle, in pixels."""
    faces, places = texture.faces, texture.places
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
    texture: SurfaceTexture, k: int, width: int, fx: float, fy: float
) -> tuple[float, float, float]:
    """All three channels at a ``packed_place``, bilinear."""
    p, right, low = texture.pixels, unsigned(k + 1), unsigned(k + width)
    low_right = unsigned(low + 1)
    gx, gy = _ONE - fx, _ONE - fy
    a, b, c, d = gx * gy, fx * gy, gx * fy, fx * fy
    return (
        a * p[k, 0] + b * p[right, 0] + c * p[low, 0] + d * p[low_right, 0],
        a * p[k, 1] + b * p[right, 1] + c * p[low, 1] + d * p[low_right, 1],
        a * p[k, 2] + b * p[right, 2] + c * p[low, 2] + d * p[low_right, 2],
    )


@loop
def empty_looks() -> Looks:
    """Room for AHEAD places of a texture."""
    place, width = np.empty(AHEAD, np.uint32), np.empty(AHEAD, np.uint32)
    return Looks(place, width, np.empty(AHEAD, np.float32), np.empty(AHEAD, np.float32))


@loop
def fetch_face(texture: SurfaceTexture, f: int) -> None:
    """Ask for the memory that ``look_at`` will read."""
    prefetch(texture.faces, unsigned(f))


@loop
def look_at(texture: SurfaceTexture, looks: Looks, i: int, f: int, u: float, v: float) -> None:
    """Keep a place as the i-th of ``looks``, and ask for its pixels' memory."""
    place, width, x, y = packed_place(texture, f, u, v)
    looks.place[i], looks.width[i], looks.x[i], looks.y[i] = place, width, x, y
    low = unsigned(place + width)
    prefetch(texture.pixels, place)
    prefetch(texture.pixels, unsigned(place + 1))
    prefetch(texture.pixels, low)
    prefetch(texture.pixels, unsigned(low + 1))


@loop
def add_looked_at(
    texture: SurfaceTexture, looks: Looks, i: int, weight: float, total: Double, k: int
) -> None:
    """total[k] += weight times what is found at the i-th of ``looks``; total (P, 4), whose last
    column is nothing but what makes a row as wide as the processor's numbers."""
    p, left = texture.pixels, looks.place[i]
    right, low = unsigned(left + 1), unsigned(left + looks.width[i])
    low_right = unsigned(low + 1)
    x, y = weight * looks.x[i], looks.y[i]
    rest = weight - x
    gy = _ONE - y
    a, b, c, d = rest * gy, x * gy, rest * y, x * y
    for n in range(4):
        total[k, n] += a * p[left, n] + b * p[right, n] + c * p[low, n] + d * p[low_right, n]


@parallel_kernel
def _lookup(
    start: int, stop: int, texture: SurfaceTexture, face: Int, u: Float, v: Float, out: Float
) -> None:
    for part in range(start, stop):
        looks, first = empty_looks(), part * AHEAD
        count = min(AHEAD, len(face) - first)
        for i in range(count):
            fetch_face(texture, max(face[first + i], 0))
        for i in range(count):
            r = first + i
            look_at(texture, looks, i, max(face[r], 0), u[r], v[r])
        for i in range(count):
            if face[first + i] >= 0:
                place, width = looks.place[i], looks.width[i]
                red, green, blue = packed_colour(texture, place, width, looks.x[i], looks.y[i])
                out[first + i, 0], out[first + i, 1], out[first + i, 2] = red, green, blue
