"""Poses that as a whole do not fit the mesh are found by what frames show of the same points."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.scenes import camera_at
from tests.texturing.study_frames import STUDY, study_frames
from usdbrdf.cli import main
from usdbrdf.files.ply import write_ply
from usdbrdf.tasks import registration
from usdbrdf.tasks.agreement import Asked
from usdbrdf.texturing.registration.joint_change import Found, places_of
from usdbrdf.texturing.registration.similarity import (
    Similarity,
    SimilarityCheck,
    said_of_similarity,
)
from usdbrdf.transport.rays import RayScene
from usdbrdf.untrusted.mesh_files import mesh_from_file

SOURCE = Path("capture")
OTHER = Similarity((0.5, -1.0, 2.0), 3.0, 0.1, (0.1, -0.2, 0.3), (0.05, 0.02, -0.04))


@pytest.fixture(scope="module")
def study():
    """Mesh, cameras and pictures of some frames of the sample."""
    return study_frames(3)


def _otherwise(mesh, scale=1.0, millimetres=(0, 0, 0), degrees=(0, 0, 0)):
    """The mesh larger and turned about its middle, and moved."""
    points = mesh.points.astype(np.float64)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    turned = Rotation.from_rotvec(np.radians(degrees)).apply(scale * (points - middle))
    moved = middle + turned + np.array(millimetres) / 1000
    return replace(mesh, points=moved.astype(np.float32))


def _found(study, **changes):
    mesh, cameras, pictures = study
    mesh = _otherwise(mesh, **changes)
    rays = RayScene(mesh.points, mesh.triangles)
    return registration.similarity_of_frames(mesh, rays, cameras, pictures)


def _camera():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.4, 0.3, -0.2]).as_matrix()
    pose[:3, 3] = (0.3, -0.2, 5)
    return camera_at(pose, np.array([50.0, 60, 31, 19]), 60, 40)


def test_how_places_move_with_the_numbers():
    points = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    said = OTHER.by_number(OTHER.camera(_camera()), points)
    for k in range(7):
        step = 1e-6 * np.eye(7)[k]
        after, before = (
            places_of(OTHER.stepped(sign * step).camera(_camera()), points) for sign in (1, -1)
        )
        np.testing.assert_allclose(said[:, :, k], (after - before) / 2e-6, atol=1e-7)


def test_cameras_that_are_moved_see_what_the_mesh_would_show_if_moved_back():
    points = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    turn = Rotation.from_rotvec(OTHER.turn)
    middle, move = np.array(OTHER.middle), 3.0 * np.array(OTHER.move)
    back = middle + turn.inv().apply(points - middle - move) / math.exp(0.1)
    np.testing.assert_allclose(
        places_of(OTHER.camera(_camera()), points), places_of(_camera(), back), atol=1e-12
    )
    assert not Similarity(OTHER.middle, 3.0).moves_cameras()
    same = Similarity(OTHER.middle, 3.0).camera(_camera()).world_from_camera
    np.testing.assert_allclose(same, _camera().world_from_camera, atol=1e-15)


def test_poses_that_fit_are_believed(study):
    check = _found(study)
    assert check.found.moved < 0.007
    assert not check.is_clear


@pytest.mark.fault("C19")
def test_a_mesh_that_was_moved_is_found(study):
    check = _found(study, millimetres=(0, 100, 0))
    assert check.is_clear
    move = 1000 * check.found.change.reach * np.array(check.found.change.move)
    np.testing.assert_allclose(move, (0, 100, 0), atol=25)
    assert check.found.change.larger == pytest.approx(0, abs=0.01)


@pytest.mark.fault("C19")
def test_a_mesh_of_another_scale_is_found(study):
    check = _found(study, scale=1.05)
    assert check.is_clear
    assert math.exp(check.found.change.larger) == pytest.approx(1.05, abs=0.012)


@pytest.mark.fault("C19")
def test_a_mesh_that_was_turned_is_found(study):
    check = _found(study, degrees=(0, 0, 3))
    assert check.is_clear
    np.testing.assert_allclose(np.degrees(check.found.change.turn), (0, 0, 3), atol=0.5)


def test_few_frames_say_nothing(study):
    mesh, cameras, pictures = study
    rays = RayScene(mesh.points, mesh.triangles)
    assert registration.similarity_of_frames(mesh, rays, cameras[:5], pictures[:5]) is None
    assert registration.similarity_of_frames(mesh, rays, [], []) is None


def _sure(right=0.05, other=0.052, **changes):
    """What two halves of the frames say, whose pictures move by as much as they are moved."""
    sides = [Similarity((0.0, 0, 0), 2.0, move=(x, 0.0, 0.0)) for x in (right, right, other)]
    whole, *halves = (
        Found(
            one, moved=0.05, error=0.001, better=14, frames=16, left=0.8, apart=0.5, form=np.eye(7)
        )
        for one in sides
    )
    return SimilarityCheck(replace(whole, **changes), tuple(halves))


def test_what_chance_does_is_not_told():
    assert _sure().is_clear
    assert _sure().error == pytest.approx(0.001)
    assert _sure(other=-0.05).is_clear
    assert not _sure(other=-0.05, better=12).is_clear
    assert not _sure(moved=0.001).is_clear
    assert not _sure(left=0.995).is_clear
    assert not _sure(apart=0.05).is_clear
    assert not replace(_sure(), halves=None).is_clear


def test_what_is_said_of_poses():
    said = said_of_similarity(_sure(), SOURCE, 10.0)
    assert "moved by (+1, +0, +0) mm (error 0)" in said
    assert "scaled by 1.0000" in said
    assert said.endswith("[capture.registration]")


def test_one_of_lens_and_poses_is_named(study):
    mesh, cameras, pictures = study

    def said(mesh, cameras):
        asked = Asked(None, np.zeros((0, len(cameras)), np.float32), cameras, pictures)
        rays = RayScene(mesh.points, mesh.triangles)
        astray = np.zeros(len(cameras), np.bool_)
        return [
            sentence.rsplit(" ", 1)[1]
            for sentence in registration.doubts_about_registration(
                mesh, rays, asked, astray, SOURCE, 1.0
            )
        ]

    longer = [
        replace(c, intrinsics=(0.9 * c.intrinsics[0], 0.9 * c.intrinsics[1], *c.intrinsics[2:]))
        for c in cameras
    ]
    assert said(mesh, longer) == ["[capture.lens]"]
    assert said(_otherwise(mesh, scale=1.05), cameras) == ["[capture.registration]"]
    assert said(mesh, cameras) == []


@pytest.mark.fault("C19")
def test_inspect_and_ingest_tell_of_a_mesh_of_another_scale(tmp_path, capsys):
    capture = tmp_path / "capture"
    shutil.copytree(STUDY, capture, ignore=shutil.ignore_patterns("truth"))
    (file,) = capture.glob("*.ply")
    mesh = mesh_from_file(file)
    points = _otherwise(mesh, scale=0.93).points
    write_ply(file, points, mesh.triangles, mesh.face_label)
    assert main(["inspect", str(capture), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["warnings"]
    assert [one.rsplit(" ", 1)[1] for one in told].count("[capture.registration]") == 1
    assert main(["ingest", str(capture), "-o", str(tmp_path / "out"), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)["steps"]["ingest"]["warnings"]
    assert [one.rsplit(" ", 1)[1] for one in again].count("[capture.registration]") == 1
