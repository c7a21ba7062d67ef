"""A lens that is told wrongly is found by what the frames show of the same points."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes import edited, make_capture
from tests.texturing.study_frames import STUDY, study_frames
from usdbrdf.capture.adapters import read_scan
from usdbrdf.cli import main
from usdbrdf.files.frames import read_frame
from usdbrdf.model.upright import as_captured
from usdbrdf.options import IngestOptions
from usdbrdf.texturing.pose_samples import logarithms
from usdbrdf.texturing.registration.joint_change import Found
from usdbrdf.texturing.registration.lens import Pattern, lens_of_frames, said_of_lens
from usdbrdf.transport.rays import RayScene


@pytest.fixture(scope="module")
def study():
    """Mesh, rays, cameras and pictures of some frames of the sample."""
    mesh, cameras, pictures = study_frames(5)
    return mesh, RayScene(mesh.points, mesh.triangles), cameras, pictures


def _with_lens(study, longer=1.0, aside=0.0):
    mesh, rays, cameras, pictures = study
    changed = []
    for camera in cameras:
        fx, fy, cx, cy = camera.intrinsics
        lens = (longer * fx, longer * fy, cx + aside * camera.width, cy)
        changed.append(replace(camera, intrinsics=lens))
    return lens_of_frames(mesh, rays, changed, pictures)


def test_the_lens_that_is_told_is_believed_where_it_is_right(study):
    found = _with_lens(study)
    assert found.moved < 0.005
    assert not found.is_clear


@pytest.mark.fault("C18")
@pytest.mark.parametrize("longer", [0.77, 0.95, 1.1])
def test_another_focal_length_is_found(study, longer):
    found = _with_lens(study, longer)
    assert found.is_clear
    assert math.exp(found.change.zoom) * longer == pytest.approx(1, abs=0.015)
    assert abs(found.change.bend) < 0.02
    sentence = said_of_lens(found, Path("capture"))
    assert sentence.endswith("[capture.lens]")
    assert f"focal length {math.exp(found.change.zoom):.3f} times" in sentence


@pytest.mark.fault("C18")
def test_another_principal_point_is_found(study):
    found = _with_lens(study, aside=0.03)
    assert found.is_clear
    # Half a diagonal is 120 pixels of 192.
    assert found.change.right * 120 / 192 == pytest.approx(-0.03, abs=0.003)
    assert found.change.zoom == pytest.approx(0, abs=0.01)


@pytest.mark.fault("C18")
def test_distortion_that_is_not_told_is_found(study):
    mesh, rays, cameras, pictures = study
    bent = []
    for picture in pictures:
        # A plain barrel, sampled at the nearest pixel.
        row, column = np.indices(picture.shape)
        x, y = (column - 95.5) / 120, (row - 71.5) / 120
        shrunk = 1 + 0.1 * (x**2 + y**2)
        inside = (np.abs(x * shrunk) < 95 / 120) & (np.abs(y * shrunk) < 71 / 120)
        rows = np.clip(np.rint(y * shrunk * 120 + 71.5), 0, 143).astype(int)
        columns = np.clip(np.rint(x * shrunk * 120 + 95.5), 0, 191).astype(int)
        bent.append(np.where(inside, picture[rows, columns], np.nan).astype(np.float32))
    found = lens_of_frames(mesh, rays, cameras, bent)
    assert found.is_clear
    assert -0.11 < found.change.bend < -0.06


@pytest.mark.parametrize("noise", [0.1, 0.3])
def test_noisy_frames_from_nearly_one_place_do_not_tell_of_a_lens(study, noise):
    """Under any lens that magnifies them they have less noise, and agree better by that alone."""
    mesh, rays, cameras, pictures = study
    random = np.random.default_rng(5)
    near, noisy = [], []
    for _ in range(16):
        pose = cameras[0].world_from_camera.copy()
        pose[:3, 3] += random.uniform(-0.01, 0.01, 3)
        near.append(replace(cameras[0], world_from_camera=pose))
        dark = np.log1p(noise * random.normal(size=pictures[0].shape).clip(-2, 2))
        noisy.append((pictures[0] + dark).astype(np.float32))
    found = lens_of_frames(mesh, rays, near, noisy)
    assert found is None or not found.is_clear


@pytest.mark.parametrize(("size", "room"), [((32, 24), True), ((128, 96), False)])
def test_plain_noisy_things_do_not_tell_of_a_lens(tmp_path, size, room):
    noise = 0.03 if room else 0.05
    capture = make_capture(tmp_path / "scan", size=size, room=room, noise=noise).folder
    scan = as_captured(read_scan(capture, IngestOptions()))
    frames, rays = scan.frames, RayScene(scan.mesh.points, scan.mesh.triangles)
    pictures = [logarithms(read_frame(frames, i), 1) for i in range(len(frames))]
    cameras = [frames.camera(i) for i in range(len(frames))]
    found = lens_of_frames(scan.mesh, rays, cameras, pictures)
    assert found is None or not found.is_clear


def test_strips_say_nothing(study):
    mesh, rays, cameras, _ = study
    strips = [np.zeros((4, 700), np.float32)] * len(cameras)
    assert lens_of_frames(mesh, rays, cameras, strips) is None


def test_few_frames_say_nothing(study):
    mesh, rays, cameras, pictures = study
    assert lens_of_frames(mesh, rays, cameras[:5], pictures[:5]) is None


def test_pictures_that_show_nothing_say_nothing(study):
    mesh, rays, cameras, pictures = study
    nothing = [np.full_like(picture, np.nan) for picture in pictures]
    assert lens_of_frames(mesh, rays, cameras, nothing) is None


def test_what_chance_does_is_not_told():
    sure = Found(
        Pattern(zoom=-0.1),
        moved=0.04,
        error=0.001,
        better=16,
        frames=16,
        left=0.5,
        apart=0.5,
        form=np.eye(4),
    )
    assert sure.is_clear
    assert not replace(sure, error=0.02).is_clear
    assert not replace(sure, moved=0.009).is_clear
    assert not replace(sure, better=12).is_clear
    assert not replace(sure, left=0.9).is_clear
    assert not replace(sure, apart=0.05).is_clear


@pytest.mark.fault("C18")
def test_inspect_and_ingest_tell_of_another_focal_length(tmp_path, capsys):
    capture = tmp_path / "capture"
    shutil.copytree(STUDY, capture, ignore=shutil.ignore_patterns("truth"))
    with edited(capture / "transforms.json") as document:
        document["fl_x"] = document["fl_y"] = 154.0
    assert main(["inspect", str(capture), "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["warnings"]
    assert told.endswith("[capture.lens]")
    assert main(["ingest", str(capture), "-o", str(tmp_path / "out"), "--json"]) == 0
    (again,) = json.loads(capsys.readouterr().out)["steps"]["ingest"]["warnings"]
    assert again.split(": ", 1)[1].startswith(told.split(": ", 1)[1][:40])
