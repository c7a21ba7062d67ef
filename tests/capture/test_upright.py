"""Captures with any axis up, and what is given in their coordinates later."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from tests.scenes import MadeCapture, edited, from_z_up, look_at, make_capture, turned_capture
from usdbrdf.asset.header import capture_up_of, read_provenance
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.compose import open_edited
from usdbrdf.asset.readers.scene import capture_up_of_stage, frames_from_stage, scene_from_stage
from usdbrdf.asset.readers.views import cameras_of_views
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.checks import FrameRecord
from usdbrdf.capture.native import write_capture
from usdbrdf.capture.up_axis import plainly_up
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.model.capture import Scan
from usdbrdf.model.material import turned_up
from usdbrdf.model.upright import as_captured, upright, upright_points, usd_up
from usdbrdf.options import IngestOptions, UpAxis

UPS: tuple[UpAxis, ...] = get_args(UpAxis)
TURNED = UPS[2:]


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> MadeCapture:
    folder = tmp_path_factory.mktemp("upright") / "room"
    return make_capture(folder, frames=8, size=(16, 12), subdivisions=1)


def asked(made: MadeCapture, up: UpAxis | None = None) -> IngestOptions:
    return IngestOptions(up_axis=up, allow_outside=(made.folder,))


@pytest.mark.parametrize("up", UPS)
def test_turns_are_rotations_that_bring_the_axis_up(up):
    axis, turn = usd_up(up)
    assert np.linalg.det(turn) == 1
    assert set(np.abs(turn).ravel()) == {0, 1}
    sign = -1 if up[0] == "-" else 1
    assert (turn @ (sign * np.eye(3)["XYZ".index(up[-1])]) == np.eye(3)["XYZ".index(axis)]).all()
    # A model whose up is told to `relight --insert` is turned as a capture is.
    assert (turned_up(up, axis)[:3, :3] == turn).all()


@pytest.fixture(scope="module")
def known(capture) -> Scan:
    return read_scan(capture.folder, IngestOptions())


@pytest.mark.parametrize(
    ("up", "stated"), [*((up, False) for up in UPS), ("-Z", True), ("X", True)]
)
def test_whatever_is_up_the_scan_is_the_same(capture, known, tmp_path, up, stated):
    folder = turned_capture(capture, tmp_path / "room", up, stated=stated)
    scan = read_scan(folder, asked(capture, None if stated else up))
    axis, _ = usd_up(up)
    assert (scan.up_axis, scan.capture_up) == (axis, up if up in TURNED else "")
    back = turned_up(axis, "Z")
    # Rotations by a quarter round nothing.
    np.testing.assert_array_equal(scan.mesh.points @ back[:3, :3].T, known.mesh.points)
    np.testing.assert_array_equal(scan.mesh.triangles, known.mesh.triangles)
    np.testing.assert_array_equal(scan.mesh.face_object, known.mesh.face_object)
    normals = scan.mesh.corner_normals @ back[:3, :3].T
    np.testing.assert_allclose(normals, known.mesh.corner_normals, atol=1e-6)
    poses = back @ scan.frames.world_from_camera
    np.testing.assert_array_equal(poses, known.frames.world_from_camera)
    assert scan.objects == known.objects


@pytest.mark.parametrize("up", TURNED)
def test_back_in_its_capture_a_scan_is_the_same_to_the_bit(known, up):
    poses = known.frames.world_from_camera
    frames = replace(known.frames, captured_pose=poses[::-1].copy())
    captured = replace(known, frames=frames, up_axis=up)
    scan = upright(captured)
    again = as_captured(scan)
    assert (scan.up_axis, scan.capture_up) == (usd_up(up)[0], up)
    assert (again.up_axis, again.capture_up) == (up, "")
    assert as_captured(captured) is captured
    for name in ("world_from_camera", "captured_pose"):
        ours, theirs, turned = (getattr(s.frames, name) for s in (captured, again, scan))
        assert ours.tobytes() == theirs.tobytes()
        turn = np.eye(4)
        turn[:3, :3] = usd_up(up)[1]
        np.testing.assert_array_equal(turned, turn @ ours)
    for name in ("points", "corner_normals"):
        ours, theirs = (getattr(s.mesh, name) for s in (captured, again))
        assert (ours.dtype, ours.tobytes()) == (theirs.dtype, theirs.tobytes())


def test_a_copy_of_the_capture_has_its_coordinates(capture, tmp_path):
    folder = turned_capture(capture, tmp_path / "room", "-Y")
    scan = read_scan(folder, asked(capture, "-Y"))
    write_capture(scan, scan.frames.image_paths, tmp_path / "copy")
    document, given = (
        json.loads((place / "transforms.json").read_text()) for place in (tmp_path / "copy", folder)
    )
    assert document["up_axis"] == "-Y"
    for ours, theirs in zip(document["frames"], given["frames"], strict=True):
        np.testing.assert_allclose(ours["transform_matrix"], theirs["transform_matrix"], atol=1e-12)
    # With the options that the capture was read with, too, as the document says the same.
    again = read_scan(tmp_path / "copy", IngestOptions())
    assert again.capture_up == "-Y"
    assert again.mesh.points.tobytes() == scan.mesh.points.tobytes()
    assert again.frames.world_from_camera.tobytes() == scan.frames.world_from_camera.tobytes()


def test_the_asset_says_what_was_up_and_turns_what_comes_later(capture, tmp_path):
    held_out = make_capture(
        tmp_path / "views",
        poses=np.array([look_at(np.array([3.0, 0.6, 1.5]), np.array([1.8, 1.5, 0.8]))]),
    )
    cameras, scenes = {}, {}
    for up in ("Z", "X"):
        folder = turned_capture(capture, tmp_path / f"room{up}", up)
        views = turned_capture(held_out, tmp_path / f"views{up}", up) / "transforms.json"
        out = tmp_path / f"asset{up}"
        allow = ("--allow-outside", str(capture.folder))
        ingest = ["ingest", str(folder), "-o", str(out), "--up-axis", up, *allow, "-q"]
        assert main(ingest) == 0
        asset = Asset.made(out)
        stage = open_edited(asset)
        assert capture_up_of(asset) == capture_up_of_stage(stage) == ("X" if up == "X" else "")
        assert UsdGeom.GetStageUpAxis(stage) == "Z"
        cameras[up], scenes[up] = cameras_of_views(views, asset, 1.0)[0], scene_from_stage(stage)
        frames = frames_from_stage(stage)
        np.testing.assert_allclose(frames.world_from_camera, capture.world_from_camera, atol=1e-12)
    assert read_provenance(asset.layer("scan"))["parameters"]["up_axis"] == "X"
    np.testing.assert_array_equal(cameras["X"].world_from_camera, cameras["Z"].world_from_camera)
    np.testing.assert_array_equal(scenes["X"].points, scenes["Z"].points)
    # Edits that were made for the asset would stand on their head in another turn.
    assert main([*ingest[:5], "Z", *allow, "-q"]) == 6


def test_another_turn_makes_the_scan_anew(capture, tmp_path):
    folder, out = turned_capture(capture, tmp_path / "room", "-Z"), tmp_path / "asset"
    allow = ["--allow-outside", str(capture.folder), "-q"]
    assert main(["ingest", str(folder), "-o", str(out), "--up-axis=-Z", *allow]) == 0
    layer = Asset.made(out).layer("scan")
    before = layer.read_bytes()
    assert main(["ingest", str(folder), "-o", str(out), "--up-axis=-Z", *allow]) == 0
    assert layer.read_bytes() == before
    layer.unlink()
    assert main(["ingest", str(folder), "-o", str(out), "--up-axis=-Z", *allow]) == 0
    assert layer.read_bytes() == before
    # The same axis of the stage, half a turn apart.
    assert main(["ingest", str(folder), "-o", str(out), "--up-axis", "Z", *allow]) == 6


def test_meshes_of_usd_are_held_by_the_asset(capture, tmp_path):
    folder = turned_capture(capture, tmp_path / "room", "-Y")
    stage = Usd.Stage.CreateNew(str(folder / "mesh.usdc"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(stage.DefinePrim("/room", "Xform"))
    mesh = UsdGeom.Mesh.Define(stage, "/room/all")
    mesh.CreatePointsAttr(capture.points @ from_z_up("-Y")[:3, :3].T)
    mesh.CreateFaceVertexCountsAttr([3] * len(capture.triangles))
    mesh.CreateFaceVertexIndicesAttr(capture.triangles.ravel())
    stage.Save()
    options = replace(asked(capture, "-Y"), mesh=folder / "mesh.usdc")
    scan = read_scan(folder, options)
    assert (scan.up_axis, scan.capture_up, scan.usd_geometry, scan.object_prims) == (
        "Y", "-Y", None, (),
    )  # fmt: skip
    assert any("[stage.turned]" in warning for warning in scan.warnings)
    known = capture.points @ from_z_up("Y")[:3, :3].T
    np.testing.assert_allclose(np.ptp(scan.mesh.points, axis=0), np.ptp(known, axis=0), atol=1e-6)
    assert read_scan(folder, replace(options, up_axis=None)).usd_geometry is not None


@pytest.mark.parametrize("word", ["W", "-y"])
def test_what_is_no_axis_is_refused_in_a_sentence(capture, tmp_path, capsys, word):
    command = ["ingest", str(capture.folder), "-o", str(tmp_path / "out"), "--up-axis", word]
    assert main(command) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert word in said[0]
    assert '"-Y"' in said[0]
    assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError, match=r"--up-axis .*expected Y, Z, -Y, -Z, X, -X"):
        IngestOptions(up_axis=word)
    with edited(capture.manifest) as document:
        before, document["up_axis"] = dict(document), word
    with pytest.raises(InputRefused, match=r"up_axis is .*none of Y, Z, -Y, -Z, X, -X"):
        read_scan(capture.folder, IngestOptions())
    capture.manifest.write_text(json.dumps(before))


def records_up(poses: np.ndarray) -> list[FrameRecord]:
    return [
        FrameRecord(
            name="",
            image_path=Path("a.exr"),
            world_from_camera=pose,
            intrinsics=(1.0, 1.0, 1.0, 1.0),
            resolution=(2, 2),
        )
        for pose in poses
    ]


@pytest.mark.parametrize("up", UPS)
def test_what_cameras_plainly_call_up(capture, up):
    turned = from_z_up(up) @ capture.world_from_camera
    assert plainly_up(records_up(turned)) == up
    # A scale of the poses, and a pose that is none, say nothing about it.
    turned[0, :3, :3] *= 1e6
    turned[1] = np.nan
    assert plainly_up(records_up(turned)) == up


def test_cameras_held_anyhow_call_nothing_up():
    rng = np.random.default_rng(5)
    found = []
    for _ in range(50):
        poses = np.tile(np.eye(4), (12, 1, 1))
        poses[:, :3, 1] = rng.standard_normal((12, 3))
        found.append(plainly_up(records_up(poses)))
    assert found.count("") >= 49
    # Between two axes neither is meant.
    slant = np.tile(turned_up("Y", "Z"), (12, 1, 1))
    slant[:, :3, 1] = np.array([0, 1, 1]) / np.sqrt(2)
    assert plainly_up(records_up(slant)) == ""
    assert plainly_up([]) == ""


def test_the_user_is_told_which_axis_to_try(capture, tmp_path):
    folder = turned_capture(capture, tmp_path / "room", "-Y")
    told = [w for w in read_scan(folder, asked(capture)).warnings if "[capture.up-axis]" in w]
    assert len(told) == 1
    assert "try --up-axis -Y." in told[0]
    scan = read_scan(folder, asked(capture, "-Y"))
    assert not any("[capture.up-axis]" in warning for warning in scan.warnings)


def test_points_of_a_capture_that_was_not_turned_stay():
    points = np.arange(6.0).reshape(2, 3)
    assert upright_points(points, "") is points
    assert (upright_points(points, "X") == points @ usd_up("X")[1].T).all()
