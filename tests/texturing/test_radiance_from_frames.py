"""All frames of a small capture into the statistics of every texel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.physics.surfaces import Part, World, world_of
from tests.scenes import MadeCapture, make_capture
from usdbrdf.geometry.unwrap import pack_triangles_singly
from usdbrdf.scan.scan import Frames
from usdbrdf.texturing.psquare import quantile
from usdbrdf.texturing.radiance_from_frames import Observation, radiance_from_frames
from usdbrdf.texturing.texel_size import texel_size_from_frames

SATURATION = 4.0


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> MadeCapture:
    """Twelve frames of the furnished room; the lamp (8, 7, 6) saturates in all of them."""
    folder: Path = tmp_path_factory.mktemp("capture")
    return make_capture(folder, subdivisions=2, saturation_radiance=SATURATION)


@pytest.fixture(scope="module")
def world(capture: MadeCapture) -> World:
    return world_of([_part(capture, i) for i in range(len(capture.names))])


def _part(capture: MadeCapture, index: int) -> Part:
    triangles = capture.triangles[capture.face_object == index]
    corners = capture.points[triangles].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    uv, size = pack_triangles_singly(corners.astype(np.float32), 0.1)
    return Part(
        points=corners.reshape(-1, 3),
        triangles=np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3),
        uv=uv.astype(np.float64),
        normals=np.repeat(normal[:, None], 3, axis=1),
        size=size,
    )


def _frames(capture: MadeCapture) -> Frames:
    number = len(capture.world_from_camera)
    return Frames(
        image_paths=tuple(capture.image(i) for i in range(number)),
        world_from_camera=capture.world_from_camera,
        intrinsics=np.tile(capture.intrinsics, (number, 1)),
        resolution=np.tile(np.array([32, 24], np.int32), (number, 1)),
        exposure_time=np.ones(number),
        saturation_radiance=np.full(number, SATURATION),
        noise_floor_radiance=np.full(number, 1e-3),
    )


def _observe(world: World, frames: Frames, observed: Observation, start: int = 0) -> list[int]:
    return list(
        radiance_from_frames(world.texels, world.scene, world.rays, frames, observed, 0.5, start)
    )


def test_every_object_gets_the_radiance_it_was_drawn_with(capture: MadeCapture, world: World):
    observed = Observation.empty(len(world.texels))
    assert _observe(world, _frames(capture), observed) == list(range(12))
    found = quantile(observed.quantiles, 0.5)
    owner = world.texels.object_index()
    for index, name in enumerate(capture.names):
        seen = (owner == index) & (observed.quantiles.count > 0)
        if name == "lamp":
            assert not seen.any()
            continue
        assert seen.sum() > 20
        expected = np.tile(np.array([capture.radiance[name]], np.float32), (seen.sum(), 1))
        np.testing.assert_allclose(found[seen], expected, rtol=1e-5)
        np.testing.assert_allclose(observed.quantiles.mean[seen], expected, rtol=1e-5)
    # The lamp is known to be at least as bright as the sensor's limit, and nothing else is.
    lamp = owner == capture.names.index("lamp")
    assert (observed.clipped[~lamp] == 0).all()
    assert observed.clipped[lamp].max() > 0
    np.testing.assert_array_equal(
        observed.lower_bound, np.where(observed.clipped > 0, np.float32(SATURATION), 0)
    )


def test_going_on_from_a_saved_state_changes_no_bit(capture: MadeCapture, world: World):
    frames = _frames(capture)
    whole = Observation.empty(len(world.texels))
    _observe(world, frames, whole)
    number = 5
    head = replace(frames, image_paths=frames.image_paths[:number])
    first = Observation.empty(len(world.texels))
    assert _observe(world, head, first) == list(range(number))
    saved = {name: values.copy() for name, values in first.arrays().items()}
    second = Observation.from_arrays(saved)
    assert _observe(world, frames, second, start=number) == list(range(number, 12))
    for name, values in whole.arrays().items():
        np.testing.assert_array_equal(second.arrays()[name], values)


def test_the_texel_size_is_the_pixel_on_the_surface(capture: MadeCapture):
    # A camera 2 m over a large floor, looking straight down, focal length 80 pixels: the distance
    # along a ray is 2 / cos, the pixel there 2 / cos / 80 wide, stretched by 1 / cos once. The
    # median over the image is 2 / 80 m times the median of cos^-1.5.
    from tests.physics.surfaces import quad
    from tests.scenes import look_at

    floor = world_of([quad((-50, -50, 0), (100, 0, 0), (0, 100, 0))])
    frames = replace(
        _frames(capture),
        image_paths=(Path("none"),),
        world_from_camera=look_at(np.array([0, -1e-6, 2.0]), np.zeros(3))[None],
        intrinsics=np.array([[80.0, 80, 40, 30]]),
        resolution=np.array([[80, 60]], np.int32),
    )
    x, y = np.meshgrid((np.arange(80) - 39.5) / 80, (np.arange(60) - 29.5) / 80)
    expected = 2 / 80 * np.median((1 + x**2 + y**2) ** 0.75)
    found = texel_size_from_frames(floor.scene, floor.rays, frames, max_texels=10**9)
    assert found == pytest.approx(expected, rel=0.03)
    # 10^4 m^2 in at most 10^4 texels, of which an atlas uses 70 %: sqrt(1 / 0.7) m.
    limited = texel_size_from_frames(floor.scene, floor.rays, frames, max_texels=10**4)
    assert limited == pytest.approx(np.sqrt(1 / 0.7), rel=0.05)
