"""The layout for random access reads what the texture itself reads."""

from __future__ import annotations

import numpy as np

from usdbrdf.geometry.packed_texture import (
    AHEAD,
    colour_looked_at,
    empty_looks,
    fetch_face,
    look_at,
    packed_colour,
    packed_place,
)
from usdbrdf.geometry.surface_radiance import SurfaceTexture


def test_packed_texture_reads_the_same_values():
    rng = np.random.default_rng(4)
    # The last atlases have one column, one row and one pixel: no neighbours to read.
    size = np.array([[37, 21], [5, 64], [1, 9], [9, 1], [1, 1]], np.int32)
    first = np.concatenate([[0], np.cumsum(size.prod(axis=1))])
    texture = SurfaceTexture(
        pixels=rng.random((int(first[-1]), 3), np.float32),
        corner_pixel=(rng.random((5, 3, 2)) * 1.2 * size[:, None] - 0.1).astype(np.float32),
        first_pixel=first[:-1],
        size=size,
    )
    face = np.tile(np.arange(5, dtype=np.int32), 400)
    u = rng.random(2000, np.float32)
    v = (1 - u) * rng.random(2000, np.float32)
    found = [
        packed_colour(texture.packed, *packed_place(texture.packed, *where))
        for where in zip(face, u, v, strict=True)
    ]
    np.testing.assert_allclose(found, texture.at(face, u, v), rtol=0, atol=3e-5)
    # What is asked for ahead is the same.
    looks = empty_looks()
    for i, where in enumerate(zip(face[:AHEAD], u, v, strict=False)):
        fetch_face(texture.packed, where[0])
        look_at(texture.packed, looks, i, *where)
    ahead = [colour_looked_at(texture.packed, looks, i) for i in range(AHEAD)]
    np.testing.assert_allclose(ahead, found[:AHEAD], rtol=0, atol=2e-7)


def test_no_face_lies_on_two_lines_of_the_cache():
    texture = SurfaceTexture(
        pixels=np.zeros((1, 3), np.float32),
        corner_pixel=np.zeros((5, 3, 2), np.float32),
        first_pixel=np.zeros(5, np.int64),
        size=np.ones((5, 2), np.int32),
    )
    pixels, faces, places = texture.packed
    assert pixels.ctypes.data % 64 == faces.ctypes.data % 64 == 0
    assert faces.strides[0] == 32
    assert places.ctypes.data == faces.ctypes.data
