"""Frames that contradict each other about how bright things are, and what explains it, are told
before anything is textured, and sound captures are believed."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import usdbrdf
from tests.scenes import edited
from tests.texturing.study_frames import STUDY
from usdbrdf.capture.adapters import read_scan
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.model.upright import as_captured
from usdbrdf.options import IngestOptions, InspectOptions
from usdbrdf.tasks.inspect import inspect
from usdbrdf.texturing.agreement import logarithms_in_frame, surface_and_rays
from usdbrdf.texturing.response import (
    contradiction_of_frames,
    doubts_about_response,
    judged_gains,
    parts_of_mesh,
)

SOURCE = Path("room/transforms.json")


@pytest.fixture(scope="module")
def study():
    """What every other frame of the sample shows, of which points, and these frames."""
    scan = as_captured(read_scan(STUDY, IngestOptions()))
    frames = scan.frames.at(range(0, len(scan.frames), 2))
    surface, rays = surface_and_rays(scan.mesh)
    columns = [
        logarithms_in_frame(surface, rays, frames.camera(i), read_frame(frames, i))
        for i in range(len(frames))
    ]
    return np.stack(columns, axis=1), surface.point, frames


def encoded(linear):
    """As sRGB has it, which goes on above 1."""
    above = 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(linear < 0.0031308, 12.92 * linear, above)


def decoded(code):
    above = ((np.maximum(code, 0) + 0.055) / 1.055) ** 2.4
    return np.where(code < 0.04045, code / 12.92, above)


def _told(logarithm, point, frames, **more):
    found = contradiction_of_frames(logarithm.astype(np.float32), point, frames)
    return found, [*doubts_about_response(found, frames, SOURCE, **more)]


@pytest.mark.parametrize("every", [1, 2])
def test_sound_frames_are_believed(study, every):
    logarithm, point, frames = study
    some = range(0, len(frames), every)
    assert _told(logarithm[:, some], point, frames.at(some)) == (None, [])


@pytest.mark.fault("C21")
def test_single_frames_off_by_a_fifth_of_a_stop_are_named(study):
    logarithm, point, frames = study
    logarithm = logarithm.copy()
    logarithm[:, [4, 17]] += [0.2 * np.log(2), -0.2 * np.log(2)]
    found, (said,) = _told(logarithm, point, frames)
    assert found.factor.keys() == {4, 17}
    assert found.factor[4] == pytest.approx(2**0.2, abs=0.03)
    assert said.startswith("transforms.json: 2 of 27 frames that were compared show the same ")
    assert f"{frames.image_paths[4].name} ({found.factor[4]:.2f} x)" in said
    assert "Their exposures are not what they pass for: correct them" in said
    assert "--exposure estimate" in said
    assert said.endswith("[capture.exposure]")
    assert _told(logarithm, point, frames, estimated=True)[1] == []
    # What a telephone does of itself to photographs is no fault of a capture.
    assert _told(logarithm, point, replace(frames, radiometric=False))[0] is None


@pytest.mark.fault("C21")
def test_a_slow_drift_is_told_as_that(study):
    logarithm, point, frames = study
    found, (said,) = _told(logarithm + np.linspace(0.2, -0.2, len(frames)), point, frames)
    assert found.drift == pytest.approx(-0.4 / np.log(2), abs=0.03)
    assert f"they drift by {found.drift:+.2f} stops from the first frame to the last" in said
    assert said.endswith("[capture.exposure]")


@pytest.mark.fault("C21")
@pytest.mark.parametrize(("power", "word"), [(1, "once the exposure"), (-1, "are not divided out")])
def test_exposures_that_were_not_divided_out_or_twice_are_told(study, power, word):
    logarithm, point, frames = study
    off = power * np.log(frames.exposure_time)
    wrong = replace(frames, saturation_radiance=frames.saturation_radiance * np.exp(off))
    found, (said,) = _told(logarithm + off, point, wrong)
    assert word in said
    assert found.reading == {1: "undivided", -1: "divided twice"}[power]


@pytest.mark.fault("C22")
@pytest.mark.parametrize("known", [True, False], ids=["full scale", "unknown"])
@pytest.mark.parametrize(
    ("curve", "radiometric", "word"),
    [
        (encoded, True, "they hold sRGB's codes, though they pass for linear"),
        (encoded, False, "they were encoded as sRGB twice"),
        (decoded, True, "they were decoded from sRGB though they were linear"),
        (decoded, False, "they hold linear values, though they pass for sRGB's codes"),
    ],
)
def test_another_transfer_curve_is_told(study, curve, radiometric, word, known):
    logarithm, point, frames = study
    full = frames.saturation_radiance
    wrong = np.log(curve(np.exp(logarithm) / full) * full)
    told = full if known else np.full(len(frames), np.inf)
    frames = replace(frames, radiometric=radiometric, saturation_radiance=told)
    for estimated in (False, True):  # which does not cure it
        (said,) = _told(wrong, point, frames, estimated=estimated)[1]
        assert word in said
        assert said.endswith("[capture.curve]")


def test_with_one_exposure_no_curve_contradicts(study):
    """Nor can it be told: each point has another radiance, in all frames."""
    logarithm, point, frames = study
    same = replace(
        frames, exposure_time=np.ones(len(frames)), saturation_radiance=np.full(len(frames), 4.0)
    )
    wrong = np.log(encoded(np.exp(logarithm) / 4) * 4)
    assert _told(wrong, point, same)[1] == []


def test_what_hangs_on_one_part_of_the_mesh_is_not_trusted(study):
    """Two halves of the frames that share one part alone: nobody knows which part is wrong."""
    logarithm, point, _ = study
    part = parts_of_mesh(point)
    camps = logarithm.copy()
    camps[~np.isin(part % 8, [0, 1]), :14] = np.nan
    camps[part % 8 == 0, 14:] = np.nan
    camps[:, 14:] += 0.5
    judged = judged_gains(camps.astype(np.float32), part)
    assert judged._replace(error=np.zeros(27)).off(0.1).sum() > 10
    assert not judged.off(0.1).any()


@pytest.mark.parametrize("power", [0.7, 1.6, 1.8])
def test_a_tone_curve_is_taken_for_no_other(study, power):
    """Photographs that a camera made lively, or flat: the exposures are what they pass for."""
    logarithm, point, frames = study
    top = np.log(frames.saturation_radiance)
    photographs = replace(frames, radiometric=False)
    found, (said,) = _told(power * (logarithm - top) + top, point, photographs)
    assert found.reading == ""
    assert "or the camera applied a tone curve" in said


def test_few_frames_tell_no_pattern(study):
    logarithm, point, frames = study
    some = [0, 2]
    found, _ = _told(logarithm[:, some] + [0.2, -0.2], point, frames.at(some))
    assert found is None or (found.reading, found.drift) == ("", 0.0)


def test_parts_hold_as_many_points_each(study):
    part = parts_of_mesh(study[1])
    assert (len(part), *set(np.bincount(part).tolist())) == (4096, 64)


@pytest.mark.fault("C22")
def test_inspect_and_ingest_tell_of_a_curve_and_of_nothing_else(tmp_path):
    """No white balance drifts, and no frame shows other things."""
    capture = tmp_path / "scan"
    shutil.copytree(STUDY, capture, ignore=shutil.ignore_patterns("truth"))
    with edited(capture / "transforms.json") as document:
        document["frames"] = document["frames"][::2]
        for frame in document["frames"]:
            full, path = frame["saturation_radiance"], capture / frame["file_path"]
            write_exr(path, (full * encoded(read_exr(path) / full)).astype(np.float32))
    found = inspect(capture, InspectOptions())
    with usdbrdf.working_on(tmp_path / "asset") as asset:
        ingested = usdbrdf.ingest(capture, asset, IngestOptions()).summary["warnings"]
    for warnings in (found.warnings, ingested):
        assert [warning.rsplit(" ", 1)[1] for warning in warnings] == ["[capture.curve]"]
