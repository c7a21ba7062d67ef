"""Vignetting and drift of the white balance, against images that were given some."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import make_capture
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.scene import frames_from_stage
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_radiance, write_exr
from usdbrdf.options import IngestOptions
from usdbrdf.pipeline import ingest
from usdbrdf.texturing.optics import Samples, balance_drift, falloff_of_frames

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
