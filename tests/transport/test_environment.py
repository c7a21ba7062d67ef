"""Where a direction lands in the latitude-longitude picture."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from usdbrdf.asset.layout import Asset
from usdbrdf.evaluation.evaluate_views import viewed_asset
from usdbrdf.transport.environment import (
    Environment,
    black_environment,
    environment_at,
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


def test_who_looks_at_an_asset_in_a_light_of_unknown_primaries_is_told(tmp_path, capsys):
    class Reached(Exception):
        """The light is asked for."""

    def environment(_: object) -> None:
        raise Reached

    sky = tmp_path / "sky.exr"
    spec = oiio.ImageSpec(4, 2, 3, "float")
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), (0.6, *[0.3] * 7))
    output = oiio.ImageOutput.create(str(sky))
    assert output.open(str(sky), spec)
    assert output.write_image(np.ones((2, 4, 3), np.float32))
    assert output.close()
    scene = SimpleNamespace(objects=[])
    atlas: Any = SimpleNamespace(scene=scene, environment=environment, lit_scene=None)
    for asked, told in ((sky, 1), ("none", 0)):
        with pytest.raises(Reached):
            viewed_asset(Asset.at(tmp_path), atlas, asked)
        assert capsys.readouterr().err.count("sky.exr: the header says that its primaries") == told
