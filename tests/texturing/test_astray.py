"""Frames that show other things than the rest do where their poses say, and none that only look
different."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import usdbrdf
from tests.scenes import edited
from usdbrdf.options import IngestOptions, InspectOptions, TextureOptions
from usdbrdf.tasks.inspect import inspect
from usdbrdf.texturing.astray import doubts_about_places, frames_astray

POINTS, FRAMES = 800, 20
STUDY = Path(__file__).parents[2] / "samples" / "study"


def _shown(seed: int = 0) -> np.ndarray:
    """(POINTS, FRAMES): half of the points in each frame, with 5 % of noise, and every tenth sample
    a highlight."""
    rng = np.random.default_rng(seed)
    found = rng.uniform(-3, 0, (POINTS, 1)) + 0.05 * rng.standard_normal((POINTS, FRAMES))
    found += np.where(rng.random(found.shape) < 0.1, rng.uniform(0, 3, found.shape), 0)
    found[rng.random(found.shape) < 0.5] = np.nan
    return found.astype(np.float32)


@pytest.mark.fault("C17")
def test_frames_that_show_what_others_show_elsewhere_are_found():
    shown = _shown()
    for i in (3, 11):
        shown[:, i] = np.roll(shown[:, i], 200)
    assert np.flatnonzero(frames_astray(shown)).tolist() == [3, 11]
    # Also where exposures were not divided out.
    shown += np.resize([-2.8, 0, 2.8], FRAMES).astype(np.float32)
    assert np.flatnonzero(frames_astray(shown)).tolist() == [3, 11]


def test_exposures_mirrors_white_walls_and_few_points_are_no_wrong_poses():
    assert not frames_astray(_shown()).any()
    shown = _shown()
    shown[:, 5] += 2
    assert not frames_astray(shown).any()
    # Of points that few frames show, where these are exposed by very different times.
    shown = _shown()
    shown[np.random.default_rng(2).random(shown.shape) < 0.6] = np.nan
    assert not frames_astray(shown + np.resize([-2.8, 0, 2.8], FRAMES).astype(np.float32)).any()
    rng = np.random.default_rng(1)
    mirror = rng.uniform(-3, 0, shown.shape).astype(np.float32)
    assert not frames_astray(mirror).any()
    wall = (1e-3 * rng.standard_normal(shown.shape)).astype(np.float32)
    wall[:, 5] *= 40
    assert not frames_astray(wall).any()
    # A highlight that wanders over one plain table, and dark frames full of noise.
    table = (0.01 * rng.standard_normal(shown.shape)).astype(np.float32)
    for i in range(FRAMES):
        table[30 * i : 30 * i + 150, i] += 2.5
    assert not frames_astray(table).any()
    plain = rng.uniform(-0.1, 0.1, (POINTS, 1)) + 0.01 * rng.standard_normal(shown.shape)
    plain[:, ::3] += 0.4 * rng.standard_normal(plain[:, ::3].shape)
    assert not frames_astray(plain.astype(np.float32)).any()
    shown = _shown()
    shown[:, 3] = np.roll(shown[:, 3], 200)
    shown[60:, 3] = np.nan
    assert not frames_astray(shown).any()
    assert not frames_astray(np.full((50, 4), np.nan, np.float32)).any()


@pytest.mark.fault("C17")
def test_they_are_named_with_what_may_be_the_cause():
    names = [f"{i:04d}.exr" for i in range(10)]
    astray = np.isin(np.arange(10), [2, 7])
    (said,) = doubts_about_places(astray, names, Path("room/transforms.json"))
    assert said.startswith("transforms.json: 2 of 10 frames that were compared show other things")
    assert "0002.exr, 0007.exr. " in said
    assert list(doubts_about_places(astray & False, names, None)) == []
    # Of what was moved or switched between frames as much can be true.
    assert "poses of other frames, or something was moved, or lamps were switched" in said


@pytest.mark.fault("C17")
def test_a_frame_with_the_pose_of_another_is_named_by_each_step(tmp_path, capsys):
    """And nothing else is said of it: neither its colours nor its exposure are off."""
    capture = tmp_path / "scan"
    shutil.copytree(STUDY, capture, ignore=shutil.ignore_patterns("truth"))
    with edited(capture / "transforms.json") as document:
        frames = document["frames"] = document["frames"][::4]
        frames[3]["transform_matrix"] = frames[10]["transform_matrix"]
    told = [w for w in inspect(capture, InspectOptions()).warnings if "0012.exr" in w]
    assert [w.rsplit(" ", 1)[1] for w in told] == ["[capture.astray]"]
    with usdbrdf.working_on(tmp_path / "asset") as asset:
        for found in (
            usdbrdf.ingest(capture, asset, IngestOptions()),
            usdbrdf.texture(asset, TextureOptions(texel_size=0.1)),
        ):
            told = [w for w in found.summary["warnings"] if "0012.exr" in w]
            assert [w.rsplit(" ", 1)[1] for w in told] == ["[capture.astray]"]
            assert "1 of 14 frames" in told[0]
    assert "0012.exr (" not in capsys.readouterr().err
