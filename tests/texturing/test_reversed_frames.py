"""Frames whose pixels run the other way than the cameras saw them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import camera_at, make_capture
from usdbrdf.capture.conventions import FLIPS, with_reversed_pixels
from usdbrdf.cli import main
from usdbrdf.files.images import read_exr, write_exr

NAMED = {
    "reverse their rows": np.s_[::-1],
    "reverse their columns": np.s_[:, ::-1],
    "turn them back": np.s_[::-1, ::-1],
}


@pytest.mark.parametrize("name", FLIPS)
def test_points_are_looked_up_where_reversed_pixels_show_them(name):
    pose = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    camera = camera_at(pose, np.array([20.0, 21, 14.5, 13]), 32, 24)
    points = np.array([[1.3, 2.2, 1.0], [0.6, 2.1, 2.0]])
    x, y = camera.project(points).T
    across, down = FLIPS[name]
    expected = np.stack([x if across > 0 else 32 - x, y if down > 0 else 24 - y], axis=1)
    np.testing.assert_allclose(with_reversed_pixels(camera, name).project(points), expected)
    assert with_reversed_pixels(camera, "") is camera


@pytest.mark.fault("C23")
@pytest.mark.parametrize("cure", NAMED)
def test_frames_whose_pixels_are_reversed_are_refused_and_told_how(tmp_path, cure, capsys):
    made = make_capture(tmp_path / "room", frames=24, noise=0.03, noise_floor_radiance=0)
    for i in range(24):
        image = read_exr(made.image(i))
        write_exr(made.image(i), np.ascontiguousarray(image[NAMED[cure]]))
    assert main(["inspect", str(made.folder)]) == 3
    err = capsys.readouterr().err
    assert "with the frames read as" in err
    assert f"({cure}) they would differ by" in err
    assert err.endswith("Save the frames anew. [capture.convention]\n")
