"""Squares of flat surface whose mean radiance tells more of a lobe than a single texel's.

A pattern finer than the pixels, and the sensor's noise, are much of what a texel changes by from
view to view. Both are less in the mean over a square, while a highlight on a flat surface is mostly
wider than a few texels. On curved ones it is not, and a square would not be one.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.texels import Texels

Bool = npt.NDArray[np.bool_]
Float = npt.NDArray[np.float32]

# Side of the squares in texels, which are about as large as pixels.
SIDE = 4.0
# Normals this far apart, as a cosine, do not count as one plane's: 0.02 radians.
_FLAT = 0.9998
# An object is seen in squares if so many of its texels have one, and these are no wider than this
# share of the scene: from within it a few hundredths of a radian.
_MOST, _WIDEST = 0.5, 0.02


def sides_of_samples(texels: Texels, usable: Bool, scene_size: float) -> tuple[Float, Bool]:
    """The side of what samples of each object average, (num_objects,), in texels: SIDE or 1; and
    which of the ``usable`` texels (T,) have so much surface around them. scene_size in metres."""
    owner = texels.object_index()
    objects = len(texels.resolution)
    small = SIDE * np.sqrt(texels.area) <= _WIDEST * scene_size
    flat = usable & small & on_flat_squares(texels, round(SIDE) // 2)
    share = np.bincount(owner, flat, objects) / np.maximum(np.bincount(owner, usable, objects), 1)
    in_squares = share >= _MOST
    side = np.where(in_squares, np.float32(SIDE), np.float32(1))
    return side, np.where(in_squares[owner], flat, usable)


def on_flat_squares(texels: Texels, reach: int) -> Bool:
    """(T,): whether a texel's atlas shows surface of its own plane ``reach`` texels around it."""
    owner = texels.object_index()
    width, height = texels.resolution[owner].T
    row, column = np.divmod(texels.pixel - texels.first_pixel[owner], width)
    flat: Bool = (np.minimum(row, column) >= reach) & (row + reach < height)
    flat &= column + reach < width
    for down, right in product((-reach, 0, reach), repeat=2):
        pixel = texels.pixel + np.where(flat, down * width.astype(np.int64) + right, 0)
        other = texels.nearest_texel[pixel]
        flat &= texels.pixel[other] == pixel
        flat &= np.einsum("td,td->t", texels.normal, texels.normal[other]) > _FLAT
    return flat
