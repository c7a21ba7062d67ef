"""Embree by its C interface: where it is found, and how long a scene lives."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.transport import rays
from usdbrdf.transport.rays import RayScene, closest_hits, empty_hits

_TRIANGLE = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0]], np.float32)
_DOWN = np.array([[0.5, 0.25, 3]], np.float32), np.array([[0, 0, -1]], np.float32)


def _face(scene: RayScene) -> int:
    hits = empty_hits(1)
    closest_hits(scene.address, *_DOWN, hits)
    return int(hits.face[0])


def test_a_library_that_lacks_a_function_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(rays._FUNCTIONS, "rtcDoesNotExist", (None, []))
    rays._embree.cache_clear()
    try:
        with pytest.raises(EnvironmentFailure, match=r"rtcDoesNotExist.*install the wheel"):
            RayScene(_TRIANGLE, np.array([[0, 1, 2]], np.int32))
    finally:
        rays._embree.cache_clear()


def test_another_version_of_embree_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rays, "_MAJOR_VERSION", 3)
    rays._device.cache_clear()
    try:
        with pytest.raises(EnvironmentFailure, match=r"reaches Embree 4.*install the wheel"):
            RayScene(_TRIANGLE, np.array([[0, 1, 2]], np.int32))
    finally:
        rays._device.cache_clear()


def test_what_embree_reads_is_the_scenes_own_and_padded():
    given = _TRIANGLE.copy()
    scene = RayScene(given, np.array([[0, 1, 2]], np.int32))
    assert not np.shares_memory(scene.points, given)
    padded = scene.points
    while padded.base is not None:
        padded = padded.base
    assert padded.nbytes >= scene.points.nbytes + 16
    given[:] = 1e9
    np.testing.assert_array_equal(scene.points, _TRIANGLE)
    assert _face(scene) == 0


def test_a_scene_is_released_once_nobody_holds_it(monkeypatch: pytest.MonkeyPatch):
    released: list[int] = []
    library = rays._embree()
    release = library.rtcReleaseScene

    def counted(address: int) -> None:
        released.append(address)
        release(address)

    monkeypatch.setattr(library, "rtcReleaseScene", counted)
    triangles = np.array([[0, 1, 2]], np.int32)
    kept = RayScene(_TRIANGLE, triangles)
    gone = [RayScene(_TRIANGLE, triangles).address for _ in range(5)]
    gc.collect()
    assert sorted(released) == sorted(gone)
    assert _face(kept) == 0


def test_what_embree_refuses_is_said():
    # A buffer that starts off the four bytes that Embree asks for.
    off = np.zeros(13, np.int8)[1:].view(np.int32).reshape(1, 3)
    with pytest.raises(EnvironmentFailure, match="1 triangles"):
        RayScene(_TRIANGLE, off)
