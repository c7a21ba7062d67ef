"""OpenMVG's sfm_data.json, written after its own archives (sfm_data_io_cereal.cpp and the *_io.hpp
of views, poses and cameras): a class's name stands with its first object alone."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

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
from usdbrdf.capture.reconstructions.openmvg import shots_of
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
NO_POSE = 4294967295


def _pointer(number, data, **kind):
    return {"key": number, "value": {**kind, "ptr_wrapper": {"id": 2147483649, "data": data}}}


def _document(room, **distortion):
    views, extrinsics = [], []
    for i, pose in enumerate(room.opencv):
        data = {
            "local_path": f"{i % 2}/", "filename": f"{i // 2:04d}.jpg",
            "width": WIDTH, "height": HEIGHT, "id_view": i, "id_intrinsic": 3, "id_pose": 50 + i,
        }  # fmt: skip
        views.append(_pointer(i, data, polymorphic_id=1073741824))
        turn = {"rotation": pose[:3, :3].T.tolist(), "center": pose[:3, 3].tolist()}
        extrinsics.append({"key": 50 + i, "value": turn})
    fx, _, cx, cy = room.intrinsics[0]
    camera = {"width": WIDTH, "height": HEIGHT, "focal_length": fx, "principal_point": [cx, cy]}
    kind = {"polymorphic_id": 2147483649, "polymorphic_name": "pinhole_radial_k3"}
    return {
        "sfm_data_version": "0.3",
        "root_path": "/home/me/images",
        "views": views,
        "intrinsics": [_pointer(3, camera | distortion, **kind)],
        "extrinsics": extrinsics,
        "structure": [],
        "control_points": [],
    }


def _write(folder, room, document):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / str(i % 2) / f"{i // 2:04d}.jpg", image)
    write_obj(folder / "scene_dense_mesh_refine_texture.obj", room)
    (folder / "sfm_data.json").write_text(json.dumps(document))


def test_the_document_is_the_room(tmp_path):
    room = truth().square()
    _write(tmp_path, room, _document(room, disto_k3=[0, 0, 0]))
    assert choose_adapter(tmp_path / "sfm_data.json").name == "openmvg"
    scan = read_scan(tmp_path, OPTIONS)
    poses = room.world_from_camera[[*range(0, 10, 2), *range(1, 10, 2)]]
    assert_same(scan, room, poses=poses, names=room.names)
    assert scan.adapter == "openmvg"


def test_pictures_that_were_not_placed_are_left_out(tmp_path):
    room, document = truth().square(), _document(truth().square())
    document["views"][3]["value"]["ptr_wrapper"]["data"]["id_pose"] = NO_POSE
    document["extrinsics"][5]["value"]["center"] = [0, "nan", 0]
    document["extrinsics"][5]["key"] = []
    document["views"][5]["value"]["ptr_wrapper"]["data"]["id_pose"] = {}
    _write(tmp_path, room, document)
    assert len(read_scan(tmp_path, OPTIONS).frames) == 8


@pytest.mark.parametrize(
    ("folder", "width"),
    [
        ("undistorted_images", 4),
        ("undistorted_images", 0),
        ("images", 4),
        ("../undistorted/images", 4),
        ("../undistorted trials/room/images", 4),
    ],
)
def test_the_black_rim_of_undistorted_pictures_is_left_out(tmp_path, folder, width):
    """As openMVG_main_ExportUndistortedImages leaves it; of others nobody knows what is black."""
    room = truth().square()
    base = tmp_path / "capture"
    images = [np.maximum(image, 0.02) for image in room.images]
    for image in images[::4]:
        image[:, :width] = image[:width] = 0
    _write(base, dataclasses.replace(room, images=images), _document(room))
    frames = (base / folder).resolve()
    frames.parent.mkdir(parents=True, exist_ok=True)
    (base / "images").rename(frames)
    scan = read_scan(base, dataclasses.replace(OPTIONS, frames=frames))
    called = folder in ("undistorted_images", "../undistorted/images")
    found = called and width > 0
    assert any("black along their borders" in said for said in scan.warnings) == found
    assert any(view is not None and view.rim for view in scan.views) == found


@pytest.mark.parametrize(
    ("name", "terms", "bend"),
    [
        ("disto_k1", [-0.1], radial),
        ("disto_k3", [-0.1, 0.02, 0.01], radial),
        ("disto_t2", [-0.1, 0.02, 0.01, 0.004, -0.003], brown),
        ("fisheye", [0.02, -0.01, 0.003, -0.001], fisheye),
    ],
)
def test_distortions_are_those_of_openmvg(tmp_path, name, terms, bend):
    room = truth().square()
    camera = shots_of(_document(room, **{name: terms}), tmp_path)[0].camera
    assert camera is not None
    assert_bends(camera, room, bend, terms)


def test_a_sphere_has_its_size_in_its_base(tmp_path):
    document = _document(truth())
    sphere = {"value0": {"width": 200, "height": 100}}
    document["intrinsics"] = [_pointer(3, sphere, polymorphic_name="spherical")]
    camera = shots_of(document, tmp_path)[0].camera
    assert camera is not None
    assert (camera.lens.curve, camera.resolution) == ("equirectangular", (200, 100))


def test_a_document_of_photographs_alone_says_what_to_do(tmp_path):
    _write(tmp_path, truth(), _document(truth()) | {"extrinsics": []})
    with pytest.raises(InputRefused, match="openMVG_main_ConvertSfM_DataFormat"):
        read_scan(tmp_path, OPTIONS)


def test_a_mesh_that_is_not_read_is_named(tmp_path):
    room = truth().square()
    _write(tmp_path, room, _document(room))
    mesh = tmp_path / "scene_dense_mesh_refine_texture.obj"
    mesh.rename(tmp_path / "mesh.fbx")
    with pytest.raises(InputRefused, match=r"no mesh that is read \(mesh\.fbx is none of \.ply"):
        read_scan(tmp_path, OPTIONS)


def test_a_distortion_that_is_not_known_is_refused(tmp_path):
    _write(tmp_path, truth(), _document(truth(), disto_k9=[0.1, 0]))
    with pytest.raises(InputRefused, match="disto_k9 of a camera is a distortion"):
        read_scan(tmp_path, OPTIONS)


def test_a_distortion_of_too_few_numbers_is_refused(tmp_path):
    _write(tmp_path, truth(), _document(truth(), disto_t2=[0.1, 0]))
    with pytest.raises(InputRefused, match="disto_t2 of a camera is not 5"):
        read_scan(tmp_path, OPTIONS)
