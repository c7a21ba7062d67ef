"""What frames show beside the mesh measures the surroundings, direction by direction."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.options import IngestOptions
from usdbrdf.shading.surroundings import HEIGHT, WIDTH, share_outside, surroundings_from_frames
from usdbrdf.transport.environment import directions_of_pixels
from usdbrdf.transport.rays import RayScene

SATURATION = 3.0


def _radiance(direction):
    """Smooth, and brightest towards +x: 0.4 to 3.9."""
    level = 0.4 * np.exp(1.14 * (1 + direction[..., :1]))
    return np.asarray(level * np.array([1.0, 0.8, 0.6]), np.float32)


@pytest.fixture(scope="module")
def painted(tmp_path_factory):
    """A box before surroundings of known radiance, in frames that clip at SATURATION."""
    folder = tmp_path_factory.mktemp("outside") / "capture"
    made = make_capture(
        folder, room=False, frames=10, size=(96, 72), saturation_radiance=SATURATION
    )
    rays = RayScene(made.points, made.triangles)
    scan = read_scan(folder, IngestOptions())
    for i, path in enumerate(scan.frames.image_paths):
        camera = scan.frames.camera(i)
        origins, towards = camera.rays(camera.pixels())
        miss = rays.closest(origins, towards).face < 0
        picture = read_exr(path).reshape(-1, 3)
        picture[miss] = np.minimum(_radiance(towards[miss]), SATURATION)
        write_exr(path, picture.reshape(camera.height, camera.width, 3))
    return rays, read_scan(folder, IngestOptions()).frames


def test_directions_have_the_radiance_that_frames_show(painted):
    rays, frames = painted
    assert share_outside(rays, frames).mean() > 0.2
    found = surroundings_from_frames(rays, frames, z_up=True)
    measured, clipped = found.coverage.measured, found.coverage.clipped
    assert measured.mean() > 0.05
    expected = _radiance(directions_of_pixels(HEIGHT, WIDTH, True)).reshape(-1, 3)
    np.testing.assert_allclose(found.radiance[measured], expected[measured], rtol=0.05)
    # Where it is brighter than what the frames hold, that is all that is known.
    assert clipped.any()
    assert (expected[clipped].max(axis=1) > 0.95 * SATURATION).all()
    np.testing.assert_allclose(found.radiance[clipped], SATURATION, rtol=1e-3)
    unseen = ~(measured | clipped)
    assert not found.radiance[unseen].any()


def test_a_closed_room_shows_no_surroundings(tmp_path):
    made = make_capture(tmp_path / "capture")
    rays = RayScene(made.points, made.triangles)
    frames = read_scan(tmp_path / "capture", IngestOptions()).frames
    assert not share_outside(rays, frames).any()
    assert not surroundings_from_frames(rays, frames, z_up=True).coverage.observed.any()
