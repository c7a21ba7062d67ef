"""Meshroom's cameras.sfm, written after AliceVision's own writer (sfmDataIO/jsonIO.cpp), in the
dialects of its versions."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.format_truth import (
    HEIGHT,
    WIDTH,
    assert_bends,
    assert_same,
    brown,
    fisheye,
    radial,
    truth,
    write_image,
    write_obj,
)
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.reconstructions.meshroom import beside, shots_of
from usdbrdf.errors import InputRefused, MeshMissing
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
SENSOR_MM = 23.5
# A mesh of today's lies in OpenGL's frame: y and z of the cameras' world, negated.
OPENGL = np.array([1.0, -1.0, -1.0])


def _texts(values):
    return [repr(float(value)) for value in np.ravel(values, order="F")]


def _camera(room, version):
    fx, fy, cx, cy = room.intrinsics[0]
    offset = (WIDTH / 2, HEIGHT / 2) if version >= (1, 2, 1) else (0, 0)
    row = {
        "intrinsicId": "7",
        "width": str(WIDTH),
        "height": str(HEIGHT),
        "serialNumber": "x",
        "principalPoint": _texts([cx - offset[0], cy - offset[1]]),
        "type": "pinhole" if version >= (1, 2, 8) else "radial3",
        "distortionParams": ["0", "0", "0"],
        "locked": "false",
    }
    if version >= (1, 2, 8):
        row |= {"distortionType": "radialk3", "undistortionType": "none"}
    if version < (1, 2, 0):
        return row | {"pxFocalLength": repr(float(fx))}
    if version < (1, 2, 2):
        return row | {"pxFocalLength": _texts([fx, fy])}
    row |= {"sensorWidth": repr(SENSOR_MM), "sensorHeight": "15.6"}
    if version >= (1, 2, 11):
        focal, ratio = fy, fy / fx
    else:
        focal, ratio = fx, (fy / fx if version >= (1, 2, 5) else fx / fy)
    return row | {
        "focalLength": repr(float(focal / WIDTH * SENSOR_MM)),
        "pixelRatio": repr(float(ratio)),
    }


def _document(room, version=(1, 2, 11)):
    views, poses = [], []
    for i, pose in enumerate(room.opencv):
        number = {"viewId": str(100 + i), "poseId": str(200 + i), "intrinsicId": "7"}
        path = f"C:/photos/{i % 2}/{i // 2:04d}.jpg"
        views.append(number | {"path": path, "width": str(WIDTH), "height": str(HEIGHT)})
        transform = {"rotation": _texts(pose[:3, :3].T), "center": _texts(pose[:3, 3])}
        held = {"transform": transform, "locked": "0"}
        poses.append({"poseId": str(200 + i), "pose": held})
    return {
        "version": [str(number) for number in version],
        "featuresFolders": ["../FeatureExtraction"],
        "views": views,
        "intrinsics": [_camera(room, version)],
        "poses": poses,
    }


def _write(folder, room, document, *, turned=True):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / str(i % 2) / f"{i // 2:04d}.jpg", image)
    write_obj(folder / "texturedMesh.obj", room, room.points * (OPENGL if turned else 1))
    (folder / "cameras.sfm").write_text(json.dumps(document))
    return folder


def _order():
    """Frames in the order of their pictures' paths."""
    return [*range(0, 10, 2), *range(1, 10, 2)]


@pytest.mark.parametrize("version", [(1, 2, n) for n in (0, 1, 2, 3, 5, 8, 11)] + [(1, 0, 0)])
def test_every_version_is_the_room(tmp_path, version):
    room = truth().square() if version < (1, 2) else truth()
    turned = version >= (1, 2, 3)
    _write(tmp_path, room, _document(room, version), turned=turned)
    assert choose_adapter(tmp_path).name == choose_adapter(tmp_path / "cameras.sfm").name
    scan = read_scan(tmp_path, OPTIONS)
    flip = np.diag([*OPENGL, 1.0]) if turned else np.eye(4)
    poses = flip @ room.world_from_camera[_order()]
    points = room.points * (OPENGL if turned else 1)
    assert_same(scan, room, points=points, poses=poses, names=room.names)
    assert scan.adapter == "meshroom"


def _project(folder, room):
    """As Meshroom leaves it: what its nodes have made lies in a cache, by their results' hashes."""
    _write(folder, room, _document(room))
    (folder / "room.mg").write_text('{"header": {"fileVersion": "1.1"}, "graph": {}}')
    photographs = _document(room) | {"poses": []}
    for node, file, made in (
        ("CameraInit", "cameraInit.sfm", json.dumps(photographs)),
        ("StructureFromMotion", "cameras.sfm", (folder / "cameras.sfm").read_text()),
        ("MeshFiltering", "mesh.obj", (folder / "texturedMesh.obj").read_text()),
        ("Texturing", "texturedMesh.obj", (folder / "texturedMesh.obj").read_text()),
    ):
        place = folder / "MeshroomCache" / node / "5ac2b90d"
        place.mkdir(parents=True)
        (place / file).write_text(made)
    (folder / "cameras.sfm").unlink()
    (folder / "texturedMesh.obj").unlink()
    return folder


@pytest.mark.parametrize(
    "named",
    [
        ".", "MeshroomCache", "MeshroomCache/StructureFromMotion/5ac2b90d",
        "MeshroomCache/StructureFromMotion/5ac2b90d/cameras.sfm",
    ],
)  # fmt: skip
def test_a_whole_project_is_read_from_its_cache(tmp_path, named):
    room = truth()
    project = _project(tmp_path, room)
    scan = read_scan(project / named, OPTIONS)
    poses = np.diag([*OPENGL, 1.0]) @ room.world_from_camera[_order()]
    assert_same(scan, room, points=room.points * OPENGL, poses=poses)
    read = {file.name for file in beside(project / named)}
    assert read == (set() if named == "." else {"texturedMesh.obj", *_names()})


def _names():
    return {f"{i:04d}.jpg" for i in range(5)}


def test_of_several_results_nobody_knows_which_belong_together(tmp_path):
    cache = _project(tmp_path, truth()) / "MeshroomCache"
    shutil.copytree(cache / "Texturing/5ac2b90d", cache / "Texturing/77")
    with pytest.raises(MeshMissing, match="or name one with --mesh"):
        read_scan(tmp_path, OPTIONS)
    shutil.copytree(cache / "StructureFromMotion/5ac2b90d", cache / "StructureFromMotion/77")
    with pytest.raises(InputRefused, match="2 results of the project have cameras"):
        read_scan(tmp_path, OPTIONS)


def test_what_a_later_node_made_comes_first(tmp_path):
    """SfMTransform turns what StructureFromMotion has found, and is what is meshed."""
    room, cache = truth(), _project(tmp_path, truth()) / "MeshroomCache"
    (cache / "SfMTransform/1b").mkdir(parents=True)
    found = cache / "StructureFromMotion/5ac2b90d/cameras.sfm"
    found.rename(cache / "SfMTransform/1b/cameras.sfm")
    moved = _document(room)
    for row in moved["poses"]:
        row["pose"]["transform"]["center"] = _texts([9, 9, 9])
    found.write_text(json.dumps(moved))
    shutil.copytree(cache / "MeshFiltering/5ac2b90d", cache / "MeshFiltering/77")
    poses = np.diag([*OPENGL, 1.0]) @ room.world_from_camera[_order()]
    assert_same(read_scan(tmp_path, OPTIONS), room, points=room.points * OPENGL, poses=poses)


def _fov(plane, terms):
    r = np.hypot(*plane)
    bent = np.arctan(2 * r * np.tan(terms[0] / 2)) / terms[0]
    return plane[0] * bent / r, plane[1] * bent / r


@pytest.mark.parametrize(
    ("kind", "terms", "bend"),
    [
        ("radialk1", [-0.1], radial),
        ("radialk3", [-0.1, 0.02, 0.01], radial),
        ("brown", [-0.1, 0.02, 0.01, 0.004, -0.003], brown),
        ("fisheye", [0.02, -0.01, 0.003, -0.001], fisheye),
        ("fisheye1", [0.9], _fov),
        ("none", [], lambda plane, terms: plane),
    ],
)
def test_distortions_are_those_of_alicevision(tmp_path, kind, terms, bend):
    room, document = truth(), _document(truth())
    document["intrinsics"][0] |= {"distortionType": kind, "distortionParams": _texts(terms)}
    camera = shots_of(document, (1, 2, 11), tmp_path)[0].camera
    assert camera is not None
    assert_bends(camera, room, bend, terms)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"type": "equidistant"}, ["'equidistant' is not read", "CameraInit", "capture.camera"]),
        ({"undistortionType": "3deanamorphic4"}, ["3deanamorphic4", "capture.camera"]),
        ({"focalLength": "0"}, ["it has no camera", "capture.alignment"]),
        ({"width": "-4"}, ["it has no camera", "capture.alignment"]),
    ],
)
def test_cameras_that_are_not_read_are_named(tmp_path, change, words):
    room, document = truth(), _document(truth())
    document["intrinsics"][0] |= change
    _write(tmp_path, room, document)
    with pytest.raises(InputRefused) as refused:
        read_scan(tmp_path, OPTIONS)
    assert [word for word in words if word not in str(refused.value)] == []


def _pose3(camera_from_world):
    """As savePose3 writes it."""
    rotation = camera_from_world[:3, :3]
    return {"rotation": _texts(rotation), "center": _texts(-rotation.T @ camera_from_world[:3, 3])}


def _in_rigs(document, room, *, says):
    """Views by twos in a rig; each pair's pose is the rig's, from which both cameras are turned and
    moved (SfMData::getPose: sub-pose after rig). ``says`` is isPoseIndependant of its cameras."""
    turn = Rotation.from_euler("xyz", (20, -35, 50), degrees=True).as_matrix()
    for i in range(0, 10, 2):
        subs = []
        rig_from_world = np.eye(4)
        rig_from_world[:3, :3], rig_from_world[:3, 3] = turn, (0.3, -0.2, 0.5 + i)
        for k in (0, 1):
            camera_from_world = np.linalg.inv(room.opencv[i + k])
            sub = _pose3(camera_from_world @ np.linalg.inv(rig_from_world))
            subs.append({"status": "estimated", "pose": sub})
            document["views"][i + k] |= {
                "poseId": str(900 + i), "rigId": str(50 + i), "subPoseId": str(k),
            } | says  # fmt: skip
        document.setdefault("rigs", []).append({"rigId": str(50 + i), "subPoses": subs})
        document["poses"].append(
            {"poseId": str(900 + i), "pose": {"transform": _pose3(rig_from_world), "locked": "0"}}
        )
    document["poses"] = document["poses"][10:]
    return document


@pytest.mark.parametrize("says", [{"isPoseIndependant": "false"}, {}])
def test_cameras_of_a_rig_stand_where_its_pose_and_their_own_in_it_say(tmp_path, says):
    room = truth()
    _write(tmp_path, room, _in_rigs(_document(room), room, says=says))
    scan = read_scan(tmp_path, OPTIONS)
    poses = np.diag([*OPENGL, 1.0]) @ room.world_from_camera[_order()]
    assert_same(scan, room, points=room.points * OPENGL, poses=poses)


def test_brackets_in_a_rig_that_was_never_solved_stand_where_their_pose_says(tmp_path):
    """They share it, and do not state that it is not the rig's, as which no flag counts."""
    room, document = truth(), _document(truth())
    for i, view in enumerate(document["views"]):
        view |= {"rigId": "5", "subPoseId": str(i % 2)}
    document["views"][1]["poseId"] = document["views"][0]["poseId"]
    document["rigs"] = [{"rigId": "5", "subPoses": [{"status": "uninitialized"}] * 2}]
    shots = shots_of(document, (1, 2, 11), tmp_path)
    poses = np.diag([*OPENGL, 1.0]) @ room.opencv
    for shot, pose in zip(shots, poses[[0, 0, *range(2, 10)]], strict=True):
        assert shot.problem == ""
        np.testing.assert_allclose(shot.world_from_camera, pose, atol=1e-12)


def test_views_that_no_rig_places_and_without_a_pose_are_left_out(tmp_path):
    room, document = truth(), _document(truth())
    document["views"][2] |= {"rigId": "5", "subPoseId": "0", "isPoseIndependant": "false"}
    document["rigs"] = [{"rigId": "5", "subPoses": [{"status": "uninitialized"}]}]
    del document["poses"][4]
    _write(tmp_path, room, document)
    scan = read_scan(tmp_path, OPTIONS)
    assert len(scan.frames) == 8
    assert any("nothing says where it stands in its rig" in said for said in scan.warnings)


@pytest.mark.parametrize("version", [None, ["1", "x", "0"], "1.2.11"])
def test_a_document_without_version_or_poses_says_so(tmp_path, version):
    document = _document(truth())
    _write(tmp_path, truth(), document | {"version": version})
    with pytest.raises(InputRefused, match="no version"):
        read_scan(tmp_path, OPTIONS)
    _write(tmp_path, truth(), document | {"poses": []})
    with pytest.raises(InputRefused, match="no poses of cameras"):
        read_scan(tmp_path, OPTIONS)


def test_a_newer_version_is_read_with_a_warning(tmp_path):
    _write(tmp_path, truth(), _document(truth(), (1, 3, 0)))
    assert any("version 1.3.0 is newer" in said for said in read_scan(tmp_path, OPTIONS).warnings)


def test_a_document_in_json_without_features_is_one_too(tmp_path):
    """As ConvertSfMFormat writes it."""
    document = _document(truth())
    del document["featuresFolders"]
    _write(tmp_path, truth(), document)
    (tmp_path / "cameras.sfm").rename(tmp_path / "sfm.json")
    assert choose_adapter(tmp_path / "sfm.json").name == "meshroom"
    assert len(read_scan(tmp_path, OPTIONS).frames) == 10
