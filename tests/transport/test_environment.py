"""Where a direction lands in the latitude-longitude picture."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest

from usdbrdf.transport.environment import (
    Environment,
    Sun,
    black_environment,
    directions_of_pixels,
    environment_at,
    pixels_of_directions,
    solid_angles,
    unknown_primaries,
)


def _numbered(height: int, width: int) -> np.ndarray:
    """Row and column of every pixel, and 0."""
    row, column = np.mgrid[0:height, 0:width]
    return np.stack([row, column, 0 * row], axis=-1).astype(np.float32)


def _pixel(image: np.ndarray, z_up: bool, w: tuple[float, float, float]) -> tuple[int, int]:
    return tuple(int(environment_at(Environment(image, z_up), *w, channel)) for channel in (0, 1))


@pytest.mark.parametrize("z_up", [False, True])
def test_the_poles_are_the_top_and_the_bottom_row(z_up: bool):
    image = _numbered(16, 32)
    up = (0.0, 0.0, 1.0) if z_up else (0.0, 1.0, 0.0)
    down = tuple(-x for x in up)
    assert _pixel(image, z_up, up)[0] == 0
    assert _pixel(image, z_up, down)[0] == 15


def test_the_middle_looks_along_z_and_the_left_quarter_along_x():
    # OpenEXR: column (0.5 - longitude / 2 pi) width, longitude = atan2(x, z), y up.
    image = _numbered(16, 33)
    assert _pixel(image, False, (0.0, 0.0, 1.0)) == (8, 16)
    assert _pixel(image, False, (1.0, 0.0, 0.0)) == (8, 8)
    assert _pixel(image, False, (-1.0, 0.0, 0.0)) == (8, 24)
    assert _pixel(image, False, (-1e-6, 0.0, -1.0))[1] == 32
    assert _pixel(image, False, (1e-6, 0.0, -1.0))[1] == 0


def test_z_up_is_the_same_picture_turned_about_x():
    # A rotation by +90 degrees about x takes y up to z up: (x, y, z) -> (x, -z, y).
    image = _numbered(64, 128)
    w = np.random.default_rng(12345).standard_normal((500, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    for x, y, z in w:
        assert _pixel(image, True, (x, -z, y)) == _pixel(image, False, (x, y, z))


def test_every_row_covers_its_share_of_the_sphere():
    # Rows are even in latitude: the solid angle of rows i..j is 2 pi (sin lat_i - sin lat_j).
    image = _numbered(8, 4)
    rng = np.random.default_rng(12345)
    w = rng.standard_normal((40_000, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    rows = np.bincount([_pixel(image, False, tuple(d))[0] for d in w], minlength=8)
    edge = np.sin(np.pi * (0.5 - np.arange(9) / 8))
    share = (edge[:-1] - edge[1:]) / 2
    # Binomial scatter, four standard deviations.
    assert (np.abs(rows - 40_000 * share) < 4 * np.sqrt(40_000 * share)).all()


def test_nothing_is_read_outside_of_the_picture():
    rng = np.random.default_rng(12345)
    image = np.full((3, 5, 3), 7, np.float32)
    w = rng.standard_normal((2000, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    special = [(0, 1.0000001, 0), (0, -1.0000001, 0), (0, 0, -1), (0.0, 0.0, -1.0), (-0.0, 0, -1)]
    for x, y, z in [*w, *special]:
        assert environment_at(Environment(image, False), float(x), float(y), float(z), 1) == 7


def test_the_black_environment_is_black():
    assert environment_at(black_environment(), 0.0, 0.6, 0.8, 2) == 0


@pytest.mark.parametrize("known", [True, False])
def test_primaries_that_are_not_known_are_told(tmp_path, known: bool):
    path = tmp_path / "sky.exr"
    spec = oiio.ImageSpec(4, 2, 3, "float")
    places = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329) if known else (0.6, *[0.3] * 7)
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), places)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.ones((2, 4, 3), np.float32))
    assert output.close()
    said = unknown_primaries(path)
    assert said == "" if known else "sky.exr: the header says that its primaries" in said


def test_pixels_cover_the_sphere_each_its_part_of_its_zone():
    # Zones of a height h are 2 pi h: of three rows those from 90 to 30 degrees are a half high.
    np.testing.assert_allclose(solid_angles(3, 4), np.array([0.5, 1, 0.5]) * 2 * np.pi / 4)
    np.testing.assert_allclose(solid_angles(2, 5), 2 * np.pi / 5)
    assert 8 * solid_angles(7, 8).sum() == pytest.approx(4 * np.pi)


@pytest.mark.parametrize("z_up", [False, True])
def test_a_pixel_looks_where_the_picture_is_looked_up(z_up: bool):
    height, width = 6, 9
    found = directions_of_pixels(height, width, z_up)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1)
    every = found.reshape(-1, 3)
    np.testing.assert_array_equal(
        pixels_of_directions(every, height, width, z_up), np.arange(height * width)
    )
    image = _numbered(height, width)
    assert [_pixel(image, z_up, tuple(w)) for w in every] == [
        divmod(k, width) for k in range(height * width)
    ]
    # The first pixel: 75 degrees up, and 160 to the left of what is ahead.
    up, left, ahead = np.sin(np.radians(75)), np.radians(160), np.cos(np.radians(75))
    right, along = ahead * np.sin(left), ahead * np.cos(left)
    wanted = (right, -along, up) if z_up else (right, up, along)
    np.testing.assert_allclose(found[0, 0], wanted, atol=1e-12)


def test_directions_at_the_ends_of_the_picture_fall_into_its_last_pixels():
    ends = np.array([[0, -1.0000001, 0], [0, 1.0000001, 0], [-0.0, 0, -1], [0, 0, -1]])
    down, up, right, left = pixels_of_directions(ends, 4, 6, False).tolist()
    assert (down // 6, up // 6) == (3, 0)
    assert (right, left) == (2 * 6 + 5, 2 * 6)


def test_a_sun_is_one_that_sends_something_and_belongs_to_its_sky():
    sky = Environment(_numbered(2, 4), True)
    assert not sky.sun.shines
    sun = Sun(np.array([0.0, 0.6, 0.8]), np.array([0, 0.5, 0]), 0.01)
    assert sun.shines
    under = sky.under(sun)
    assert under.image is sky.image
    assert under.z_up
    assert (under.sun.half_angle, under.sun.direction.tolist()) == (0.01, [0, 0.6, 0.8])
    assert under.sun.irradiance.tolist() == [0, 0.5, 0]
    assert not black_environment().z_up
