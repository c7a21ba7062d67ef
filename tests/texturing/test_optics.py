"""Vignetting and drift of the white balance, against images that were given some."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import camera_at, make_capture
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.scene import frames_from_stage
from usdbrdf.files.frames import FramePixels, read_frame
from usdbrdf.files.images import read_radiance, write_exr
from usdbrdf.options import IngestOptions
from usdbrdf.pipeline import ingest
from usdbrdf.texturing.agreement import MeshPoints
from usdbrdf.texturing.optics import (
    Samples,
    _without_means,
    balance_drift,
    falloff_of_frames,
    samples_in_frame,
    squared_radius,
)
from usdbrdf.transport.rays import RayScene

# An f/1.8 lens wide open: 1.3 stops in the corners.
K1, K2 = -0.5, -0.4


def _samples(k1, k2, *, points=1500, frames=10, noise=0.02, seed=0, balance=None):
    """Points that some of the frames show, each with a colour and each frame with a gain."""
    rng = np.random.default_rng(seed)
    radius2 = rng.random((points, frames))
    log = rng.normal(0, 1, (points, 1, 3)) + rng.normal(0, 0.5, (1, frames, 1))
    log = log + (k1 * radius2 + k2 * radius2**2)[..., None]
    log = log + noise * rng.standard_normal(log.shape)
    if balance is not None:
        log = log + np.log(balance)[None]
    shiny = rng.random((points, frames)) < 0.05
    log[shiny] += 1.5
    log[rng.random((points, frames)) < 0.4] = np.nan
    return Samples(log.astype(np.float32), radius2.astype(np.float32))


def test_falloff_is_found_under_gains_and_highlights():
    found = falloff_of_frames(_samples(K1, K2))
    assert found.stops == pytest.approx((0.5 + 0.4) / np.log(2), abs=0.03)
    assert found.error < 0.03
    assert found.is_clear


def test_a_lens_without_falloff_is_left_alone():
    found = falloff_of_frames(_samples(0, 0, noise=0.1))
    assert abs(found.stops) < 0.05
    assert not found.is_clear
    assert falloff_of_frames(_samples(K1, K2, points=50)) is None


def test_highlights_in_the_middle_of_frames_are_no_falloff():
    """As of a lamp beside the camera: they count up to where errors end, and by no more."""
    samples, rng = _samples(0, 0), np.random.default_rng(6)
    shines = (samples.radius2 < 0.25) & (rng.random(samples.radius2.shape) < 0.03)
    samples.logarithm[shines] += 2.0  # by least squares half a stop
    assert abs(falloff_of_frames(samples).stops) < 0.08


def test_more_than_lenses_do_is_none_of_their_doing():
    """As of a mesh that does not fit, or of a lamp at the camera."""
    found = falloff_of_frames(_samples(-2, -3))
    assert found.stops == pytest.approx(5 / np.log(2), abs=0.2)
    assert not found.is_clear


def test_a_balance_that_drifts_is_found_in_its_frame():
    balance = np.ones((10, 3))
    balance[4] = (1.25, 1, 0.9)
    samples, owner = _samples(0, 0, balance=balance), np.arange(1500) % 3
    drift = balance_drift(samples, owner)
    assert drift[4] == pytest.approx(np.log2(1.25), abs=0.03)
    assert np.delete(drift, 4).max() < 0.03


def test_a_hue_that_one_surface_mirrors_is_no_drift():
    samples, owner = _samples(0, 0), (np.arange(1500) % 4 == 0).astype(int)
    samples.logarithm[owner == 0, 4, 2] += np.log(1.2)
    assert balance_drift(samples, np.zeros(1500, int))[4] > 0.2
    assert balance_drift(samples, owner).max() < 0.03
    few = samples.logarithm.copy()
    few[20:, 4] = np.nan
    assert balance_drift(samples._replace(logarithm=few), np.zeros(1500, int))[4] < 0.05


def test_what_was_darkened_comes_out_as_it_was(tmp_path, capsys):
    capture = make_capture(tmp_path / "capture", frames=16, size=(96, 72))
    cx, cy = capture.intrinsics[2:]
    x, y = np.arange(96) + 0.5 - cx, np.arange(72) + 0.5 - cy
    square = (x**2 + y[:, None] ** 2) / (48**2 + 36**2)
    passed = np.exp(K1 * square + K2 * square**2)[..., None]
    clean = [read_radiance(capture.image(i)) for i in range(16)]
    for i, image in enumerate(clean):
        write_exr(capture.image(i), (image * passed).astype(np.float32), half=False)
    told = ingest(capture.folder, Asset.at(tmp_path / "told"), IngestOptions()).summary
    assert told["vignetting_stops"] == pytest.approx(1.3, abs=0.1)
    assert told["white_balance_drift_stops"] < 0.05
    assert "--vignetting estimate divides it out" in capsys.readouterr().err
    assert any("[capture.vignetting]" in warning for warning in told["warnings"])
    asset = Asset.at(tmp_path / "asset")
    ingest(capture.folder, asset, IngestOptions(vignetting="estimate"))
    frames = frames_from_stage(open_weaker(asset, "texturing"))
    shown = read_frame(frames, 5)
    ratio = (shown.radiance / clean[5])[shown.valid]
    assert np.abs(ratio / np.median(ratio) - 1).max() < 0.06


def test_a_frame_of_another_balance_is_one_of_the_warnings(tmp_path):
    capture = make_capture(tmp_path / "capture", frames=16, size=(96, 72))
    image = read_radiance(capture.image(4)) * np.array((1.3, 1, 0.8))
    write_exr(capture.image(4), image.astype(np.float32), half=False)
    told = ingest(capture.folder, Asset.at(tmp_path / "asset"), IngestOptions()).summary
    (warning,) = told["warnings"]
    assert "of 1 of 16 frames" in warning
    assert capture.image(4).name in warning
    assert warning.endswith("[capture.balance]")


def test_radius_is_one_in_the_corners_of_a_centred_picture():
    lens = (50.0, 50.0, 32.0, 24.0)
    column, row = np.array([-0.5, 63.5, 31.5, 31.5]), np.array([-0.5, 47.5, 23.5, 47.5])
    found = squared_radius(lens, 64, 48, column, row)
    np.testing.assert_allclose(found, [1, 1, 0, 24**2 / (32**2 + 24**2)], atol=1e-12)
    off = squared_radius((50.0, 50.0, 30.0, 20.0), 64, 48, np.array([63]), np.array([4]))
    np.testing.assert_allclose(off, 4 * (33.5**2 + 15.5**2) / (64**2 + 48**2))


@pytest.mark.parametrize("weighted", [False, True])
def test_what_rows_and_columns_share_is_taken_off_by_weight(weighted: bool):
    rng = np.random.default_rng(2)
    shared = rng.normal(0, 1, (30, 1)) + rng.normal(0, 1, (1, 8))
    weight = rng.uniform(0.5, 2, (30, 8)) if weighted else np.ones((30, 8))
    weight[3, 2], weight[5] = 0, 0  # one that is unknown, and a point that no frame shows
    own = rng.normal(0, 0.1, (30, 8))
    left = _without_means(shared + own, weight)
    assert np.abs((weight * left).sum(axis=0)).max() < 1e-9
    assert np.abs((weight * left).sum(axis=1)).max() < 1e-3
    again = _without_means(own, weight)
    np.testing.assert_allclose(left[weight > 0], again[weight > 0], atol=1e-3)


def test_what_a_frame_shows_of_a_point_is_the_mean_around_it():
    """Of a wall at z = 0 with a radiance that is a plane over the picture, one pixel unknown and
    one of another channel black."""
    points = np.float32([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    rays = RayScene(points, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    pose = np.eye(4)
    pose[2, 3] = 2.0
    lens = np.array([40.0, 40.0, 30.0, 21.0])
    camera = camera_at(pose, lens, 60, 44)
    place = np.array([(10.4, 12.2), (40.7, 30.1), (25.5, 8.5), (50.2, 40.3)])
    point = np.stack([(place[:, 0] - 30) / 20, (21 - place[:, 1]) / 20, np.zeros(4)], axis=-1)
    surface = MeshPoints(point, np.tile([0.0, 0, 1], (4, 1)), np.zeros(4, np.int32))
    row, column = np.mgrid[:44, :60]
    level = 3 + 0.02 * column - 0.03 * row
    radiance = np.stack([level, 2 * level, 3 * level], axis=-1).astype(np.float32)
    valid, none = np.ones((44, 60), bool), np.zeros((44, 60), bool)
    valid[29, 41] = False
    radiance[7, 24, 2] = 0
    pixels = FramePixels(
        radiance=radiance, valid=valid, clipped=none, dark=none, unknown=none, transparent=none,
        num_clamped=0,
    )  # fmt: skip
    found, radius2 = samples_in_frame(surface, rays, camera, pixels)
    cell = np.floor(place)
    shown = 3 + 0.02 * cell[:, 0] - 0.03 * cell[:, 1]
    wanted = np.log(shown[:, None] * [1, 2, 3])
    np.testing.assert_allclose(found[[0, 3]], wanted[[0, 3]], rtol=1e-5)
    assert np.isnan(found[[1, 2]]).all()
    off = ((cell + 0.5 - [30, 21]) ** 2).sum(axis=1)
    np.testing.assert_allclose(radius2, 4 * off / (60**2 + 44**2), rtol=1e-6)
    behind, _ = samples_in_frame(surface._replace(normal=-surface.normal), rays, camera, pixels)
    assert np.isnan(behind).all()
