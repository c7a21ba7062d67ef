"""What frames show beside the mesh measures the surroundings, direction by direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.model.texels import CoverageMap
from usdbrdf.options import IngestOptions
from usdbrdf.shading.surroundings import (
    HEIGHT,
    WIDTH,
    Surroundings,
    share_outside,
    surroundings_from_frames,
)
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


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_that_nothing_is_there_is_measured(painted, noise):
    """By its noise; what is exactly zero was cut out, and nothing is known of it."""
    rays, frames = painted
    random = np.random.default_rng(5)
    folder = frames.image_paths[0].parent.parent / f"dark_{noise}"
    paths = []
    for i, path in enumerate(frames.image_paths):
        camera = frames.camera(i)
        miss = rays.closest(*camera.rays(camera.pixels())).face < 0
        picture = read_exr(path).reshape(-1, 3)
        dark = np.maximum(random.normal(0, noise, picture.shape), 0) if noise else 0 * picture
        picture[miss] = np.float32(dark)[miss]
        paths.append(folder / path.name)
        folder.mkdir(exist_ok=True)
        write_exr(paths[-1], picture.reshape(camera.height, camera.width, 3))
    floor = np.full(len(frames), 3 * max(noise, 0.01), np.float32)
    dark = replace(frames, image_paths=tuple(paths), noise_floor_radiance=floor)
    seen = surroundings_from_frames(rays, frames, z_up=True).coverage.observed
    found = surroundings_from_frames(rays, dark, z_up=True)
    if not noise:
        assert not found.coverage.observed.any()
        assert not found.dark.any()
        return
    assert (found.dark == seen).mean() > 0.99
    assert found.coverage.measured[found.dark].all()
    assert np.median(found.radiance[found.dark]) < noise
    # Nothing else than darkness was seen: so it goes on.
    assert found.median().max() < noise
    assert found.trend(True).max() < noise


@pytest.mark.parametrize("floors", [[0.01], [0.01, 0.8]])
def test_what_is_too_dark_in_one_channel_shines_in_the_others(painted, floors):
    """Exposures that take turns: what the darker ones do not hold the others do."""
    rays, frames = painted
    blue = np.float32([0.001, 0.002, 1.5 if len(floors) == 1 else 0.4])
    folder = frames.image_paths[0].parent.parent / f"blue_{len(floors)}"
    folder.mkdir()
    for i, path in enumerate(frames.image_paths):
        camera = frames.camera(i)
        picture = read_exr(path).reshape(-1, 3)
        picture[rays.closest(*camera.rays(camera.pixels())).face < 0] = blue
        write_exr(folder / path.name, picture.reshape(camera.height, camera.width, 3))
    paths = tuple(folder / path.name for path in frames.image_paths)
    floor = np.resize(np.float32(floors), len(frames))
    frames = replace(frames, image_paths=paths, noise_floor_radiance=floor)
    found = surroundings_from_frames(rays, frames, z_up=True)
    assert found.coverage.measured.any()
    fine = frames.at(np.flatnonzero(floor == np.float32(floors[0])).tolist())
    seen = surroundings_from_frames(rays, fine, z_up=True).coverage.observed
    assert seen.any()
    assert not found.dark[seen].any()
    np.testing.assert_allclose(found.median(), blue, rtol=1e-3)


def test_a_closed_room_shows_no_surroundings(tmp_path):
    made = make_capture(tmp_path / "capture")
    rays = RayScene(made.points, made.triangles)
    frames = read_scan(tmp_path / "capture", IngestOptions()).frames
    assert not share_outside(rays, frames).any()
    assert not surroundings_from_frames(rays, frames, z_up=True).coverage.observed.any()


def _seen_through_a_window(sky):
    """Up to 28 degrees above the horizon and 45 to either side."""
    directions = directions_of_pixels(HEIGHT, WIDTH, True).reshape(-1, 3)
    above = (directions[:, 2] > 0) & (directions[:, 2] < np.sin(np.radians(28)))
    seen = above & (directions[:, 0] > np.cos(np.pi / 4) * np.hypot(*directions[:, :2].T))
    radiance = np.where(seen[:, None], sky, 0).astype(np.float32)
    none = np.zeros_like(seen)
    return Surroundings(radiance=radiance, coverage=CoverageMap.of(seen, none), dark=none)


# Gradation a, b and indicatrix c, d, e of two of the CIE's standard skies (S 011).
_OVERCAST, _CLEAR = (4, -0.7, 0, -1, 0), (-1, -0.32, 10, -3, 0.45)


@pytest.mark.parametrize("kind", [_OVERCAST, _CLEAR])
def test_a_sky_goes_on_beyond_the_window(kind):
    """Nearer to what it is than as bright as at the horizon, on the average over where the sun may
    stand."""
    a, b, c, d, e = kind
    directions = directions_of_pixels(HEIGHT, WIDTH, True).reshape(-1, 3)
    zenith = np.maximum(directions[:, 2], 0.02)
    errors = []
    for azimuth in np.radians([0, 90, 180]):
        sun = np.array([0.8 * np.cos(azimuth), 0.8 * np.sin(azimuth), 0.6])
        away = np.arccos(np.clip(directions @ sun, -1, 1))
        indicatrix = 1 + c * (np.exp(d * away) - np.exp(d * np.pi / 2)) + e * np.cos(away) ** 2
        sky = ((1 + a * np.exp(b / zenith)) * indicatrix)[:, None] * np.ones(3)
        seen = _seen_through_a_window(sky)
        asked = (directions[:, 2] > 0.5) & (away > 0.4)
        found = seen.trend(True), seen.median()
        errors.append([np.abs(np.log(one / sky)[asked]).mean() for one in found])
    trend, flat = np.mean(errors, axis=0)
    assert flat > 0.5
    assert trend < 0.8 * flat


def test_what_has_no_trend_goes_on_about_as_bright():
    """Buildings, say."""
    random = np.random.default_rng(0)
    blocks = random.lognormal(0, 0.7, (HEIGHT // 16, WIDTH // 16, 1))
    sky = np.repeat(np.repeat(blocks, 16, axis=0), 16, axis=1).reshape(-1, 1) * np.ones(3)
    seen = _seen_through_a_window(sky)
    assert np.abs(np.log(seen.trend(True) / seen.median())).max() < 1.5


def test_of_next_to_nothing_seen_no_trend_is_told():
    none = Surroundings.unseen()
    np.testing.assert_array_equal(none.trend(True), 0)
    one = np.zeros((HEIGHT * WIDTH, 3), np.float32)
    one[1000:1040] = np.linspace(1, 3, 40)[:, None]
    coverage = CoverageMap.of(one[:, 0] > 0, one[:, 0] < 0)
    seen = Surroundings(radiance=one, coverage=coverage, dark=coverage.clipped)
    np.testing.assert_allclose(seen.trend(True), 2, rtol=1e-6)


@pytest.mark.parametrize("dark", [False, True])
def test_ground_that_frames_show_tells_of_the_rest_of_it(dark):
    """Down to 30 degrees below the horizon a tenth as bright as the sky; or nothing at all."""
    directions = directions_of_pixels(HEIGHT, WIDTH, True).reshape(-1, 3)
    up, ahead = directions[:, 2], directions[:, 0] > 0.3
    ground = (up < 0) & (up > -0.5) & ahead
    shown = ground | ((up > 0) & ahead)
    radiance = np.where((up > 0)[:, None], 2.0, 0.0 if dark else 0.2) * np.ones(3)
    seen = Surroundings(
        radiance=np.where(shown[:, None], radiance, 0).astype(np.float32),
        coverage=CoverageMap.of(shown, np.zeros_like(shown)),
        dark=ground & dark,
    )
    found = seen.trend(True)
    np.testing.assert_allclose(found[up < 0], 0.0 if dark else 0.2, rtol=1e-5)
    np.testing.assert_allclose(found[up > 0], 2.0, rtol=0.05)
