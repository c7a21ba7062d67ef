"""Embree by its C interface: where it is found, and how long a scene lives."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.geometry import embree
from usdbrdf.geometry.embree import EmbreeScene, closest_hits

_TRIANGLE = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0]], np.float32)
_DOWN = np.array([[0.5, 0.25, 3]], np.float32), np.array([[0, 0, -1]], np.float32)


def _face(scene: EmbreeScene) -> int:
    face, (u, v, distance) = np.zeros(1, np.int32), np.zeros((3, 1), np.float32)
    closest_hits(scene.address, *_DOWN, face, u, v, distance)
    return int(face[0])


def test_a_library_that_lacks_a_function_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(embree._FUNCTIONS, "rtcDoesNotExist", (None, []))
    embree._embree.cache_clear()
    try:
        with pytest.raises(EnvironmentFailure, match=r"rtcDoesNotExist.*install the wheel"):
            EmbreeScene(_TRIANGLE, np.array([[0, 1, 2]], np.int32))
    finally:
        embree._embree.cache_clear()


def test_a_scene_keeps_what_embree_reads():
    # Embree reads the vertices where they are: the caller's may be gone.
    scene = EmbreeScene(_TRIANGLE.copy(), np.array([[0, 1, 2]], np.int32))
    gc.collect()
    waste = [np.full((3, 3), 1e9, np.float32) for _ in range(1000)]
    assert _face(scene) == 0
    assert len(waste) == 1000


def test_scenes_come_and_go():
    points = np.random.default_rng(1).random((3000, 3), np.float32)
    triangles = np.arange(3000, dtype=np.int32).reshape(-1, 3)
    first = EmbreeScene(_TRIANGLE, np.array([[0, 1, 2]], np.int32))
    for _ in range(50):
        EmbreeScene(points, triangles)
        gc.collect()
    assert _face(first) == 0


def test_what_embree_refuses_is_said():
    # A buffer that starts off the four bytes that Embree asks for.
    off = np.zeros(13, np.int8)[1:].view(np.int32).reshape(1, 3)
    with pytest.raises(EnvironmentFailure, match="1 triangles"):
        EmbreeScene(_TRIANGLE, off)
