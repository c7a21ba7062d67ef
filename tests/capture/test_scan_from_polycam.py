"""Polycam's raw data, written after the vendor's specification (PolyCam/polyform, README)."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.develop import developed_in
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import read_frame
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
# The room is z up, ARKit's world y up; the mesh is turned about that axis, and moved.
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
ALIGNMENT = np.eye(4)
ALIGNMENT[:3, :3] = Rotation.from_euler("y", 35, degrees=True).as_matrix()
ALIGNMENT[:3, 3] = 0.3, -0.2, 1.1


def _write(folder, room, *, corrected=True, alignment=ALIGNMENT):
    """``alignment`` None: no mesh_info.json, and the mesh in the frame of the cameras."""
    places = [("cameras", "images", 0.4), ("corrected_cameras", "corrected_images", 0.0)]
    for cameras, images, off in places if corrected else [("cameras", "images", 0.0)]:
        (folder / "keyframes" / cameras).mkdir(parents=True)
        for i, image in enumerate(room.images):
            pose = Y_UP @ room.world_from_camera[i]
            pose[:3, 3] += off
            rows = {f"t_{r}{c}": pose[r, c] for r in range(3) for c in range(4)}
            lens = dict(zip(("fx", "fy", "cx", "cy"), room.intrinsics[i].tolist(), strict=True))
            size = {"width": WIDTH, "height": HEIGHT, "blur_score": 90.1, "timestamp": i}
            document = json.dumps(rows | lens | size)
            (folder / "keyframes" / cameras / f"{1000 + i}.json").write_text(document)
            write_image(folder / "keyframes" / images / f"{1000 + i}.jpg", image)
    whole = Y_UP if alignment is None else alignment @ Y_UP
    scene = trimesh.Scene()
    for i, name in enumerate(room.names):
        points = room.points @ whole[:3, :3].T + whole[:3, 3]
        mesh = trimesh.Trimesh(points, room.triangles[room.face_object == i], process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    (folder / "raw.glb").write_bytes(scene.export(file_type="glb"))
    if alignment is not None:
        stated = alignment.T.ravel().tolist()
        info = {"alignmentTransform": stated, "faceCount": len(room.triangles)}
        (folder / "mesh_info.json").write_text(json.dumps(info))
    return whole


def test_folders_of_corrected_cameras_may_be_empty(tmp_path):
    room = truth()
    whole = _write(tmp_path, room, corrected=False)
    for name in ("corrected_cameras", "corrected_images"):
        (tmp_path / "keyframes" / name).mkdir()
    scan = read_scan(tmp_path, OPTIONS)
    points = room.points @ whole[:3, :3].T + whole[:3, 3]
    assert_same(scan, room, points=points, poses=whole @ room.world_from_camera)
    assert any("no corrected cameras" in sentence for sentence in scan.warnings)


def test_what_systems_leave_in_folders_is_passed_over(tmp_path):
    """A Finder's notes, and the halves that an archive of a Mac brings of each file."""
    room = truth()
    whole = _write(tmp_path, room, corrected=False)
    for name in ("corrected_cameras", "corrected_images"):
        (tmp_path / "keyframes" / name).mkdir()
        (tmp_path / "keyframes" / name / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / ".DS_Store").touch()
    for file in [f for f in tmp_path.rglob("*") if f.is_file() and f.name[0] != "."]:
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    assert choose_adapter(tmp_path).name == "polycam"
    scan = read_scan(tmp_path, OPTIONS)
    points = room.points @ whole[:3, :3].T + whole[:3, 3]
    assert_same(scan, room, points=points, poses=whole @ room.world_from_camera)
    assert any("no corrected cameras" in sentence for sentence in scan.warnings)
    assert not any("masked" in sentence for sentence in scan.warnings)


def test_corrected_cameras_stand_in_the_frame_of_the_mesh(tmp_path):
    room = truth()
    whole = _write(tmp_path, room)
    assert choose_adapter(tmp_path).name == "polycam"
    scan = read_scan(tmp_path, OPTIONS)
    points = room.points @ whole[:3, :3].T + whole[:3, 3]
    assert_same(scan, room, points=points, poses=whole @ room.world_from_camera, names=room.names)
    assert (scan.adapter, scan.up_axis, scan.meters_per_unit) == ("polycam", "Y", 1.0)


def test_cameras_that_were_not_corrected_are_told(tmp_path):
    room = truth()
    whole = _write(tmp_path, room, corrected=False)
    scan = read_scan(tmp_path, OPTIONS)
    np.testing.assert_allclose(
        scan.frames.world_from_camera, whole @ room.world_from_camera, atol=1e-6
    )
    assert any("no corrected cameras" in said for said in scan.warnings)


def test_without_an_alignment_the_mesh_is_that_of_the_cameras(tmp_path):
    _write(tmp_path, truth(), alignment=None)
    scan = read_scan(tmp_path, OPTIONS)
    np.testing.assert_allclose(
        scan.frames.world_from_camera, Y_UP @ truth().world_from_camera, atol=1e-6
    )
    assert any("mesh_info.json: not there" in said for said in scan.warnings)


@pytest.mark.parametrize(
    "stated", [[1, 2, 3], [0] * 16, "x", [1e308] * 16, np.diag([2, 2, 2, 1]).ravel().tolist()]
)
def test_an_alignment_that_is_none_is_refused(tmp_path, stated):
    _write(tmp_path, truth())
    (tmp_path / "mesh_info.json").write_text(json.dumps({"alignmentTransform": stated}))
    with pytest.raises(InputRefused, match="alignmentTransform is no rigid matrix"):
        read_scan(tmp_path, OPTIONS)


def test_a_keyframe_that_is_damaged_is_left_out(tmp_path):
    _write(tmp_path, truth())
    for name, content in (("1002", "[]"), ("1003", '{"width": 32, "height": 24, "t_00": 1}')):
        (tmp_path / f"keyframes/corrected_cameras/{name}.json").write_text(content)
    assert len(read_scan(tmp_path, OPTIONS).frames) == 8


def test_cameras_without_pictures_are_answered_by_the_export(tmp_path):
    _write(tmp_path, truth(), corrected=False)
    shutil.rmtree(tmp_path / "keyframes/images")
    with pytest.raises(InputRefused, match="Export 'Raw Data' from Polycam"):
        read_scan(tmp_path, OPTIONS)


@pytest.mark.parametrize("corrected", [True, False])
def test_the_black_rim_of_corrected_pictures_is_left_out(tmp_path, corrected):
    """And of no others; a dark place within is no rim."""
    room = truth()
    _write(tmp_path, room, corrected=corrected)
    folder = tmp_path / "keyframes" / ("corrected_images" if corrected else "images")
    width = 4  # even, as JPEG halves colours
    for i, image in enumerate(room.images):
        framed = np.zeros_like(image)
        framed[width:-width, width:] = np.maximum(image, 0.02)[width:-width, width:]
        framed[:, width] /= 2
        framed[11:13, 15:18] = 0
        write_image(folder / f"{1000 + i}.jpg", framed)
    scan = read_scan(tmp_path, OPTIONS)
    (tmp_path / "frames").mkdir()
    frames = developed_in(scan.frames, scan.views, tmp_path)
    for i in range(len(frames)):
        unknown = np.isnan(read_frame(frames, i).radiance).any(axis=2)
        assert unknown[:, : width + 1].all() == corrected
        assert unknown[: width + 1].all() == corrected
        assert not unknown[width + 5 : -width - 5, width + 5 :].any()
        assert corrected or not unknown.any()
