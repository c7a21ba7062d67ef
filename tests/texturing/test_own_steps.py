"""Poses that are off by another error each are told, and those that are right are not."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import usdbrdf
from tests.scenes import edited
from tests.texturing.study_frames import STUDY, study_frames
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.options import IngestOptions, InspectOptions
from usdbrdf.tasks import registration
from usdbrdf.tasks.agreement import Asked
from usdbrdf.tasks.inspect import inspect
from usdbrdf.texturing.registration.joint_change import Found
from usdbrdf.texturing.registration.own_steps import OwnSteps, said_of_own_steps
from usdbrdf.texturing.registration.similarity import Similarity, SimilarityCheck
from usdbrdf.transport.rays import RayScene

SOURCE = Path("room/transforms.json")


@pytest.fixture(scope="module")
def study():
    """Mesh, cameras and pictures of some frames of the sample."""
    mesh, cameras, pictures = study_frames(4)
    return mesh, RayScene(mesh.points, mesh.triangles), cameras, pictures


def _trembling(cameras, millimetres):
    """Each camera moved along its own axes by Gaussian distances."""
    rng = np.random.default_rng(0)
    moved = []
    for camera in cameras:
        pose = camera.world_from_camera.copy()
        pose[:3, 3] += pose[:3, :3] @ (millimetres / 1000 * rng.standard_normal(3))
        moved.append(replace(camera, world_from_camera=pose))
    return moved


@pytest.mark.fault("C20")
@pytest.mark.parametrize("millimetres", [15, 20, 50])
def test_poses_that_are_off_each_by_itself_are_told(study, millimetres):
    mesh, rays, cameras, pictures = study
    trembling = _trembling(cameras, millimetres)
    found = registration.own_steps_of_frames(mesh, rays, trembling, pictures)
    assert found.is_clear
    assert (found.moved > 0).mean() > 0.8
    asked = Asked(None, np.empty((0, len(cameras))), trembling, pictures)
    right = np.zeros(len(cameras), bool)
    (said,) = registration.doubts_about_steps(mesh, rays, asked, right, SOURCE)
    assert said == said_of_own_steps(found, SOURCE, cameras[0].width)


@pytest.mark.fault("C20")
def test_a_similarity_after_which_they_tremble_still_is_not_told(study, monkeypatch):
    """Some fits best by chance."""
    mesh, rays, cameras, pictures = study

    def by_chance(*_):
        none = Similarity((0.0, 0.0, 0.0), 1.0)
        found = Found(none, 0.02, 1e-3, 14, 14, 0.94, 0.5, np.eye(7))
        return SimilarityCheck(found, (found, found))

    monkeypatch.setattr(registration, "similarity_of_frames", by_chance)
    right = np.zeros(len(cameras), bool)
    for poses, told in ((cameras, 1), (_trembling(cameras, 20), 0)):
        asked = Asked(None, np.empty((0, len(poses))), poses, pictures)
        said = registration.doubts_about_registration(mesh, rays, asked, right, SOURCE, 1.0)
        assert len(list(said)) == told


@pytest.mark.fault("C19")
def test_a_scale_of_poses_that_tremble_is_told(study):
    """It explains more than what is left for steps."""
    mesh, rays, cameras, pictures = study
    eyes = np.stack([camera.eye for camera in cameras])
    scaled = []
    for camera, eye in zip(_trembling(cameras, 10), eyes, strict=True):
        pose = camera.world_from_camera.copy()
        pose[:3, 3] += 0.06 * (eye - eyes.mean(axis=0))
        scaled.append(replace(camera, world_from_camera=pose))
    asked = Asked(None, np.empty((0, len(cameras))), scaled, pictures)
    right = np.zeros(len(cameras), bool)
    (said,) = registration.doubts_about_registration(mesh, rays, asked, right, SOURCE, 1.0)
    assert said.endswith("[capture.registration]")
    assert "scaled by" in said


def test_poses_that_are_right_are_believed(study):
    found = registration.own_steps_of_frames(*study)
    assert found.usual < 0.001
    assert not found.is_clear
    mesh, rays, cameras, pictures = study
    assert registration.own_steps_of_frames(mesh, rays, cameras[:5], pictures[:5]) is None


def test_what_is_told_is_how_far_the_usual_frame_is_moved():
    found = OwnSteps(np.array([0.0, 0.004, 0.006, 0.01]), 0.8)
    said = said_of_own_steps(found, SOURCE, 200)
    assert said.startswith("transforms.json: 3 of 4 frames that were compared would agree better")
    assert "by 0.5% of a picture's width (1.0 pixels) in the middle" in said
    assert said.endswith("[capture.steps]")
    assert found.is_clear
    assert not replace(found, left=0.95).is_clear
    assert not replace(found, moved=found.moved / 4).is_clear


def _capture(folder, changes):
    """Every fourth frame of the sample, and another document."""
    shutil.copytree(STUDY, folder, ignore=shutil.ignore_patterns("truth"))
    with edited(folder / "transforms.json") as document:
        document["frames"] = document["frames"][::4]
        changes(document)
    return folder


def _codes(warnings):
    return [warning.rsplit(" ", 1)[1] for warning in warnings]


@pytest.mark.fault("C20")
def test_inspect_and_ingest_tell_of_them(tmp_path):
    def tremble(document):
        rng = np.random.default_rng(0)
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] += 0.02 * rng.standard_normal(3)
            frame["transform_matrix"] = pose.tolist()

    capture = _capture(tmp_path / "scan", tremble)
    assert _codes(inspect(capture, InspectOptions()).warnings) == ["[capture.steps]"]
    for refine, told in ((False, ["[capture.steps]"]), (True, [])):
        with usdbrdf.working_on(tmp_path / f"asset-{refine}") as asset:
            found = usdbrdf.ingest(capture, asset, IngestOptions(refine_poses=refine))
        assert _codes(found.summary["warnings"]) == told


def test_colours_of_frames_that_show_other_places_are_not_said_to_drift(tmp_path):
    def lengthen(document):
        document["fl_x"] *= 1.5
        document["fl_y"] *= 1.5

    capture = _capture(tmp_path / "scan", lengthen)
    with usdbrdf.working_on(tmp_path / "asset") as asset:
        found = usdbrdf.ingest(capture, asset, IngestOptions()).summary
    assert found["white_balance_drift_stops"] > 0.1
    assert _codes(found["warnings"]) == ["[capture.lens]"]


def test_exposures_that_are_wrong_hide_no_drift_of_colours(tmp_path):
    """Poses are where they are, and nobody says that they are not."""
    capture = _capture(tmp_path / "scan", lambda document: None)
    rng = np.random.default_rng(1)
    frames = sorted((capture / "frames").iterdir())[::4]
    for i, file in enumerate(frames):
        tint = 2 ** (0.6 * (i / (len(frames) - 1) - 0.5))
        write_exr(file, read_exr(file) * np.exp(rng.normal(0, 0.9)) * [tint, 1, 1 / tint])
    with usdbrdf.working_on(tmp_path / "asset") as asset:
        found = usdbrdf.ingest(capture, asset, IngestOptions()).summary
    assert _codes(found["warnings"]) == ["[capture.exposure]", "[capture.balance]"]
