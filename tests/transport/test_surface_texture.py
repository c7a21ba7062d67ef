"""The layout for random access reads what the texture itself reads."""

from __future__ import annotations

import numpy as np

from usdbrdf.transport.surface_texture import (
    SurfaceTexture,
    packed_colour,
    packed_faces,
    packed_pixels,
    packed_place,
)


def bilinear(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    """The picture (H, W, 3) at a place counted from its first pixel's middle, held at its rim."""
    height, width = picture.shape[:2]
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    column, row = int(x), int(y)
    right, low = min(column + 1, width - 1), min(row + 1, height - 1)
    fx, fy = x - column, y - row
    upper = (1 - fx) * picture[row, column] + fx * picture[row, right]
    lower = (1 - fx) * picture[low, column] + fx * picture[low, right]
    return (1 - fy) * upper + fy * lower


def test_look_ups_are_bilinear():
    rng = np.random.default_rng(4)
    # The last atlases have one column, one row and one pixel: no neighbours to read.
    size = np.array([[37, 21], [5, 64], [1, 9], [9, 1], [1, 1]], np.int32)
    first = np.concatenate([[0], np.cumsum(size.prod(axis=1))])
    values = rng.random((500, 3), np.float32)
    shown = rng.integers(-1, 500, int(first[-1])).astype(np.int32)
    corners = (rng.random((5, 3, 2)) * 1.2 * size[:, None] - 0.1).astype(np.float32)
    pixels = packed_pixels(values, shown, int(size[:, 0].max()))
    faces, places = packed_faces(corners, first[:-1], size)
    texture = SurfaceTexture(pixels, faces, places)
    face = np.tile(np.arange(5, dtype=np.int32), 400)
    u = rng.random(2000, np.float32)
    v = (1 - u) * rng.random(2000, np.float32)

    pictures = np.where(shown[:, None] < 0, 0, values[shown])
    wanted = []
    for f, a, b in zip(face, u, v, strict=True):
        x, y = (1 - a - b) * corners[f, 0] + a * corners[f, 1] + b * corners[f, 2] - 0.5
        picture = pictures[first[f] : first[f + 1]].reshape(size[f, 1], size[f, 0], 3)
        wanted.append(bilinear(picture, float(x), float(y)))
    found = [
        packed_colour(texture, *packed_place(texture, *where))
        for where in zip(face, u, v, strict=True)
    ]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=3e-5)
    # What is asked for ahead is the same, in whatever numbers.
    face[::7] = -1
    on_surface = texture.at(face, u, v)
    np.testing.assert_allclose(on_surface, np.where(face[:, None] < 0, 0, found), rtol=0, atol=2e-7)


def test_no_face_lies_on_two_lines_of_the_cache():
    pixels = packed_pixels(np.zeros((1, 3), np.float32), np.zeros(1, np.int32), 1)
    faces, places = packed_faces(
        np.zeros((5, 3, 2), np.float32), np.zeros(5, np.int64), np.ones((5, 2), np.int32)
    )
    assert pixels.ctypes.data % 64 == faces.ctypes.data % 64 == 0
    assert faces.strides[0] == 32
    assert places.ctypes.data == faces.ctypes.data
