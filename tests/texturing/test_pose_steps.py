"""Cameras that take small steps: towards the truth where they were off, nowhere where not."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

from tests.scenes import camera_at, edited, make_capture
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.capture.adapters import read_scan
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused
from usdbrdf.files.images import write_exr
from usdbrdf.options import IngestOptions
from usdbrdf.transport.rays import RayScene

SIZE = (96, 72)


def _patterned(made):
    """The capture's frames anew, from surfaces with a pattern, two by two rays to a pixel."""
    scene = RayScene(made.points, made.triangles)
    table = np.array([made.radiance[name] for name in made.names])
    for i, pose in enumerate(made.world_from_camera):
        camera = camera_at(pose, 2 * made.intrinsics, 2 * SIZE[0], 2 * SIZE[1])
        origins, towards = camera.rays(camera.pixels())
        hits = scene.closest(origins, towards)
        x, y, z = (origins + towards * hits.distance[:, None]).T
        wave = 1 + 0.4 * np.sin(9 * x + 5 * z) * np.sin(8 * y - 6 * z + 2 * x)
        # The same from everywhere but for a sheen that a gain explains.
        sheen = 1 + 0.1 * np.cos(2 * (towards[:, 0] + i))
        image = table[made.face_object[hits.face]] * (wave * sheen)[:, None]
        image = image.reshape(SIZE[1], 2, SIZE[0], 2, 3).mean(axis=(1, 3))
        write_exr(made.image(i), image.astype(np.float32), half=False)


def _pixels_off(made, poses):
    """Root mean square, over the frames, of how far points lie from where they should."""
    scene, off = RayScene(made.points, made.triangles), []
    for pose, true in zip(poses, made.world_from_camera, strict=True):
        camera = camera_at(true, made.intrinsics, *SIZE)
        origins, towards = camera.rays(camera.pixels(8))
        point = origins + towards * scene.closest(origins, towards).distance[:, None]
        shift = camera_at(pose, made.intrinsics, *SIZE).project(point) - camera.project(point)
        off.append((shift**2).sum(axis=1).mean())
    return float(np.sqrt(np.mean(off)))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("poses") / "room"
    made = make_capture(folder, frames=16, size=SIZE)
    _patterned(made)
    return made


def _ingested(made, out, capsys, *more):
    arguments = ["ingest", str(made.folder), "-o", str(out), "--json", "--refine-poses", *more]
    assert main(arguments) == 0
    told = json.loads(capsys.readouterr().out)["steps"]["ingest"]["refined_poses"]
    return told, AssetMaps(open_weaker(Asset.at(out), "texturing")).frames.world_from_camera


def test_true_poses_hardly_move(made, tmp_path, capsys):
    told, poses = _ingested(made, tmp_path / "out", capsys)
    assert _pixels_off(made, poses) < 0.15
    assert len(told) == 16


def test_disturbed_poses_come_back_and_the_captured_ones_are_kept(made, tmp_path, capsys):
    rng = np.random.default_rng(4)
    captured = made.world_from_camera.copy()
    for pose in captured:
        pose[:3, 3] += pose[:3, :3] @ (0.01 * rng.standard_normal(3))
        turn = Rotation.from_rotvec(np.radians(0.6) * rng.standard_normal(3))
        pose[:3, :3] = pose[:3, :3] @ turn.as_matrix()
    before = _pixels_off(made, captured)
    assert before > 0.8
    given = made.manifest.read_text()
    with edited(made.manifest) as document:
        for frame, pose in zip(document["frames"], captured, strict=True):
            frame["transform_matrix"] = pose.tolist()
    try:
        copy = tmp_path / "copy"
        out = tmp_path / "out"
        told, poses = _ingested(made, out, capsys, "--write-capture", str(copy))
    finally:
        made.manifest.write_text(given)
    assert _pixels_off(made, poses) < 0.25 * before
    moved = np.linalg.norm(poses[:, :3, 3] - captured[:, :3, 3], axis=1)
    assert [one["moved_m"] for one in told] == pytest.approx(moved.tolist(), abs=1e-5)
    assert all(one["differs"] <= one["differed"] for one in told)
    # Any reader of USD sees the refined cameras; those captured are an operation of their own.
    stage = Usd.Stage.Open(str(Asset.at(out).root_layer))
    camera = next(UsdGeom.Xformable(p) for p in stage.Traverse() if p.IsA(UsdGeom.Camera))
    first, second = camera.GetOrderedXformOps()
    assert second.GetOpName() == "xformOp:transform:refined"
    kept = np.array([np.array(first.Get(time)).T for time in first.GetTimeSamples()])
    np.testing.assert_allclose(kept, captured, atol=1e-12)
    written = json.loads((copy / "transforms.json").read_text())["frames"]
    matrices = np.array([frame["transform_matrix"] for frame in written])
    np.testing.assert_allclose(matrices, poses, atol=1e-9)
    kept = np.array([frame["captured_transform_matrix"] for frame in written])
    np.testing.assert_allclose(kept, captured, atol=1e-12)
    # What was written says that its poses are refined: they are not refined again.
    assert (
        main(["ingest", str(copy), "-o", str(tmp_path / "again"), "--json", "--refine-poses"]) == 0
    )
    printed, err = capsys.readouterr()
    assert "refined already" in err
    steps = json.loads(printed)["steps"]["ingest"]["refined_poses"]
    assert [one["moved_m"] for one in steps] == pytest.approx(moved.tolist(), abs=1e-5)
    again = Usd.Stage.Open(str(Asset.at(tmp_path / "again").root_layer))
    camera = next(UsdGeom.Xformable(p) for p in again.Traverse() if p.IsA(UsdGeom.Camera))
    for one, other in zip((first, second), camera.GetOrderedXformOps(), strict=True):
        assert one.GetOpName() == other.GetOpName()
        for time in range(1, 17):
            np.testing.assert_allclose(other.Get(time), one.Get(time), atol=1e-9)


def test_a_captured_pose_that_is_none_is_refused(made, tmp_path):
    folder = tmp_path / "room"
    shutil.copytree(made.folder, folder)
    with edited(folder / "transforms.json") as document:
        document["frames"][3]["captured_transform_matrix"] = [[1, 2], [3, 4]]
    with pytest.raises(InputRefused, match=r"captured_transform_matrix.*\[capture.pose\]"):
        read_scan(folder, IngestOptions())
