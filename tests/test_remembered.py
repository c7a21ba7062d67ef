"""What is remembered between tests depends on all that was asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.remembered import remembered
from usdbrdf.model.camera import Camera
from usdbrdf.transport.rays import RayScene


def test_another_value_anywhere_is_asked_anew_and_an_equal_one_is_not():
    asked = []
    function = remembered(lambda *arguments: asked.append(arguments) or len(asked))
    camera = Camera(
        world_from_camera=np.eye(4), intrinsics=(20.0, 20.0, 16.0, 12.0), width=32, height=24
    )
    points, triangles = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
    picture = np.zeros((2, 3), np.float32)
    first = RayScene(points, triangles), [camera], [picture], ""
    assert function(*first) == 1
    others = [
        (RayScene(2 * points, triangles), *first[1:]),
        (first[0], [camera, camera], *first[2:]),
        (first[0], [replace(camera, width=33)], *first[2:]),
        (first[0], [replace(camera, world_from_camera=2 * np.eye(4))], *first[2:]),
        (*first[:2], [picture + 1], ""),
        (*first[:2], [picture.T], ""),
        (*first[:2], [picture.astype(np.float64)], ""),
        (*first[:3], None),
    ]
    for number, other in enumerate(others, 2):
        assert function(*other) == number
    equal = RayScene(points.copy(), triangles), [replace(camera)], [picture.copy()], ""
    assert function(*equal) == 1
    assert len(asked) == 1 + len(others)
