"""Pixels become radiance, and each says whether it may be believed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from usdbrdf.capture.checks import FrameRecord, frames_from_records
from usdbrdf.files.frames import (
    PHOTOGRAPH_NOISE_FLOOR,
    PHOTOGRAPH_SATURATION,
    FramePixels,
    FrameReader,
    photograph_limits,
    read_frame,
    read_frames,
    transmission,
    transparent_of,
)
from usdbrdf.model.capture import Frames


def _write(path: Path, pixels: np.ndarray, kind: str) -> None:
    spec = oiio.ImageSpec(*pixels.shape[1::-1], pixels.shape[2], kind)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.ascontiguousarray(pixels))
    assert output.close()


def _frames(path: Path, encoding: str = "lin_rec709_scene", **limits: float) -> Frames:
    record = FrameRecord(
        name=path.name,
        image_path=path,
        world_from_camera=np.eye(4),
        intrinsics=(1, 1, 1, 1),
        resolution=(4, 2),
        **limits,
    )
    return frames_from_records([record], encoding=encoding, radiometric=True)


def test_a_channel_that_half_floats_round_below_saturation_is_clipped(tmp_path):
    pixels = np.full((2, 4, 3), 1.0, np.float32)
    pixels[0, 0, 1] = 3.2  # stored as 3.19922
    pixels[0, 1, 2] = 3.19
    _write(tmp_path / "a.exr", pixels, "half")
    frame = read_frame(_frames(tmp_path / "a.exr", saturation_radiance=3.2), 0)
    assert frame.radiance[0, 0, 1] < 3.2
    assert frame.clipped.sum() == 1
    assert frame.clipped[0, 0]
    assert frame.valid.sum() == 7


def test_a_cameras_logarithm_becomes_radiance_with_limits_of_radiance(tmp_path):
    linear = np.full((2, 4, 3), 0.18, np.float32)
    linear[0, 0], linear[0, 1] = 8.0, 0.002
    stored = ((np.log2((2**18 - 16) / 117.45 * linear + 64) - 6) / 14) * 928 / 1023 + 95 / 1023
    _write(tmp_path / "a.exr", stored.astype(np.float32), "float")
    limits = {"saturation_radiance": 8.0, "noise_floor_radiance": 0.01}
    frame = read_frame(_frames(tmp_path / "a.exr", "ARRI LogC4", **limits), 0)
    assert np.allclose(frame.radiance, linear, rtol=2e-3)
    assert np.argwhere(frame.clipped).tolist() == [[0, 0]]
    assert np.argwhere(frame.dark).tolist() == [[0, 1]]


def test_every_channel_must_rise_above_the_noise_floor(tmp_path):
    pixels = np.full((2, 4, 3), 1.0, np.float32)
    pixels[1, 2] = (1, 1, 0.01)
    _write(tmp_path / "a.exr", pixels, "float")
    frame = read_frame(_frames(tmp_path / "a.exr", noise_floor_radiance=0.02), 0)
    assert frame.dark.sum() == 1
    assert not frame.valid[1, 2]


@pytest.mark.fault("I3")
@pytest.mark.fault("I4")
def test_nan_infinity_and_negative_light_are_unknown_not_black(tmp_path):
    pixels = np.full((2, 4, 3), 1.0, np.float32)
    pixels[0, 0, 0] = np.nan
    pixels[0, 1, 1] = np.inf
    pixels[0, 2, 2] = -0.5
    pixels[0, 3, 0] = -1e-4
    _write(tmp_path / "a.exr", pixels, "float")
    frame = read_frame(_frames(tmp_path / "a.exr", saturation_radiance=10), 0)
    assert frame.unknown.tolist() == [[True, True, True, False], [False] * 4]
    assert np.isnan(frame.radiance[0, :3]).all()
    assert frame.radiance[0, 3].tolist() == [0, 1, 1]
    assert frame.num_clamped == 1
    assert not frame.clipped.any()
    assert frame.valid.sum() == 5


@pytest.mark.parametrize("suffix", [".exr", ".png", ".tif"])
def test_what_alpha_says_is_not_there_is_unknown(tmp_path, suffix):
    """An object cut out of its background, as renderers and background removers write it."""
    pixels = np.full((2, 4, 4), 1.0, np.float32)
    pixels[0, 1, 3] = 0  # the colours that were there
    pixels[0, 2] = 0
    pixels[0, 3] = (0.5, 0.5, 0.5, 0.5)  # an edge
    _write(tmp_path / f"a{suffix}", pixels, "float" if suffix == ".exr" else "uint8")
    frame = read_frame(_frames(tmp_path / f"a{suffix}"), 0)
    assert frame.unknown.tolist() == [[False, True, True, True], [False] * 4]
    assert (int(frame.transparent.sum()), frame.num_clamped) == (3, 0)
    assert np.isnan(frame.radiance[0, 1:]).all()
    assert np.allclose(frame.radiance[1], 1)
    assert not frame.dark.any()


def test_what_the_file_does_not_hold_is_missing_and_not_transparent(tmp_path):
    """It counts against --max-nonfinite, of which what is transparent is no part."""
    pixels = np.full((2, 4, 4), 1.0, np.float32)
    pixels[0, 1] = np.nan
    _write(tmp_path / "a.exr", pixels, "float")
    frame = read_frame(_frames(tmp_path / "a.exr"), 0)
    assert (int(frame.unknown.sum()), int(frame.transparent.sum())) == (1, 0)


@pytest.mark.parametrize(("colour", "hidden"), [(1.0, 0), (0.0, 8)])
def test_alpha_that_was_left_empty_says_nothing(tmp_path, colour, hidden):
    pixels = np.full((2, 4, 4), colour, np.float32)
    pixels[..., 3] = 0
    _write(tmp_path / "a.exr", pixels, "float")
    assert int(read_frame(_frames(tmp_path / "a.exr"), 0).transparent.sum()) == hidden


@pytest.mark.fault("I4")
@pytest.mark.parametrize(("level", "ringing"), [(-0.9e-3, True), (-1.1e-3, False), (-0.01, False)])
def test_ringing_is_a_thousandth_of_the_median(tmp_path, level, ringing):
    """Further below zero nothing was ever light, whatever the unit."""
    for unit in (1.0, 1e4):
        pixels = np.full((2, 4, 3), unit, np.float32)
        pixels[0, 0, 0] = level * unit
        _write(tmp_path / "a.exr", pixels, "float")
        frame = read_frame(_frames(tmp_path / "a.exr"), 0)
        assert (frame.num_clamped, int(frame.unknown.sum())) == ((1, 0) if ringing else (0, 1))


def test_limits_belong_to_the_recorded_channels_not_to_rec709(tmp_path):
    pixels = np.full((2, 4, 3), (1.0, 0.0, 0.0), np.float32)  # AP1 red leaves Rec.709
    _write(tmp_path / "a.exr", pixels, "float")
    frame = read_frame(_frames(tmp_path / "a.exr", "lin_ap1_scene", saturation_radiance=1.2), 0)
    assert frame.radiance[0, 0, 0] > 1.2
    assert frame.radiance[0, 0, 1] < 0
    assert frame.valid.all()


def test_photographs_are_linearised_and_brought_to_one_exposure(tmp_path):
    codes = np.full((2, 4, 3), 128, np.uint8)
    codes[0, 0] = 252
    codes[0, 1] = 2
    _write(tmp_path / "a.png", codes, "uint8")
    saturation, floor = photograph_limits(np.array([0.01, 0.02, 0.04]))
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4
    for exposure in range(3):
        frames = _frames(
            tmp_path / "a.png",
            "srgb_rec709_scene",
            saturation_radiance=saturation[exposure],
            noise_floor_radiance=floor[exposure],
        )
        scale = 0.02 / (0.01, 0.02, 0.04)[exposure]
        frame = read_frame(frames, 0)
        np.testing.assert_allclose(frame.radiance[1], linear * scale, rtol=1e-5)
        assert frame.clipped.sum() == frame.dark.sum() == 1
        assert frame.valid.sum() == 6


def test_linear_images_keep_their_values_whatever_their_saturation(tmp_path):
    pixels = np.linspace(0.1, 2.5, 24, dtype=np.float32).reshape(2, 4, 3)
    _write(tmp_path / "a.exr", pixels, "float")
    frame = read_frame(_frames(tmp_path / "a.exr", saturation_radiance=3.0), 0)
    np.testing.assert_array_equal(frame.radiance, pixels)


def test_what_a_lens_keeps_back_is_put_back_by_the_distance_from_its_own_middle(tmp_path):
    """ln V = k1 rho^2 + k2 rho^4, rho in half diagonals of the picture: 7 x 5 pixels here, whose
    principal point lies a pixel right of the middle and one above it."""
    _write(tmp_path / "a.exr", np.full((5, 7, 3), 2.0, np.float32), "float")
    frames = replace(
        _frames(tmp_path / "a.exr", saturation_radiance=1e3),
        intrinsics=np.array([[5.0, 5, 4.5, 1.5]]),
        resolution=np.array([[7, 5]], np.int32),
        vignetting=(-0.5, -0.3),
    )
    y, x = np.mgrid[:5, :7]
    square = ((x - 4) ** 2 + (y - 1) ** 2) / (3.5**2 + 2.5**2)
    wanted = np.exp(-0.5 * square - 0.3 * square**2)
    assert wanted[1, 4] == 1
    np.testing.assert_allclose(transmission(frames, 0), wanted, rtol=1e-6)
    found = read_frame(frames, 0)
    np.testing.assert_allclose(found.radiance, 2 / np.repeat(wanted[..., None], 3, 2), rtol=1e-6)
    assert found.valid.all()


def test_photograph_limits_are_linear_values():
    assert pytest.approx(0.9560, abs=1e-4) == PHOTOGRAPH_SATURATION
    assert pytest.approx(3 / 255 / 12.92) == PHOTOGRAPH_NOISE_FLOOR


@pytest.mark.parametrize(("kept", "decoded"), [(0, [2, 2, 2]), (2, [1, 1, 2]), (3, [1, 1, 1])])
def test_frames_are_kept_as_far_as_memory_goes(tmp_path, monkeypatch, kept, decoded):
    records = []
    for i in range(3):
        _write(tmp_path / f"{i}.exr", np.full((2, 4, 3), i + 0.5, np.float32), "float")
        records.append(
            FrameRecord(
                name=f"{i}.exr",
                image_path=tmp_path / f"{i}.exr",
                world_from_camera=np.eye(4),
                intrinsics=(1, 1, 1, 1),
                resolution=(4, 2),
            )
        )
    frames = frames_from_records(records, encoding="lin_rec709_scene", radiometric=True)
    counted = [0, 0, 0]

    def counting(of: Frames, i: int) -> FramePixels:
        counted[i] += 1
        return read_frame(of, i)

    monkeypatch.setattr("usdbrdf.files.frames.read_frame", counting)
    size = sum(a.nbytes for a in vars(read_frame(frames, 0)).values() if isinstance(a, np.ndarray))
    reader = FrameReader(frames, most_bytes=kept * size + size // 2)
    for order in ([0, 1, 2], [2, 0, 1]):
        shown = [
            (i, float(pixels.radiance[0, 0, 0])) for i, pixels in read_frames(reader.read, order)
        ]
        assert shown == [(i, i + 0.5) for i in order]
    assert counted == decoded


@pytest.mark.parametrize(("alpha", "kept"), [(0.985, False), (0.995, True), (1.5, True)])
def test_what_filters_leave_of_alpha_is_there(alpha, kept):
    stored = np.full((2, 3, 4), 1.0, np.float32)
    stored[0, 1, 3] = alpha
    assert transparent_of(stored).sum() == (not kept)
