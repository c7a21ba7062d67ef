"""OpenSfM's reconstruction.json, written after its own writer (io.py, shot_to_json) and the
distortions of camera_distortions_functions.h."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image, write_obj
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.reconstructions.opensfm import beside, shots_of
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
CAMERA = "v2 kodak z612 32 24 brown 0.97"


def _camera(room, **terms):
    fx, fy, cx, cy = room.intrinsics[0] / WIDTH  # the longer side
    lens = {"projection_type": "brown", "focal_x": fx, "focal_y": fy}
    centre = {"c_x": cx - 0.5, "c_y": cy - HEIGHT / WIDTH / 2}
    return {"width": WIDTH, "height": HEIGHT, **lens, **centre, **terms}


def _part(room, **terms):
    shots = {}
    for i, pose in enumerate(room.opencv):
        turn = pose[:3, :3].T
        shots[f"{i:04d}.jpg"] = {
            "rotation": Rotation.from_matrix(turn).as_rotvec().tolist(),
            "translation": (-turn @ pose[:3, 3]).tolist(),
            "camera": CAMERA,
            "orientation": 1,
            "capture_time": 1286894631.0,
            "gps_position": [0.0, 0.0, 0.0],
        }
    return {"cameras": {CAMERA: _camera(room, **terms)}, "shots": shots, "points": {}}


def _write(folder, room, document, *, below=""):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"{i:04d}.jpg", image)
    write_obj(folder / "mesh.obj", room)
    (folder / below).mkdir(exist_ok=True)
    (folder / below / "reconstruction.json").write_text(json.dumps(document))


@pytest.mark.parametrize("below", ["", "opensfm"])
def test_the_largest_reconstruction_is_the_room(tmp_path, below):
    """In a project of OpenSfM, and in one of OpenDroneMap."""
    room, other = truth(), _part(truth())
    other["shots"] = {"0000.jpg": other["shots"]["0003.jpg"]}
    _write(tmp_path, room, [other, _part(room)], below=below)
    assert choose_adapter(tmp_path / below / "reconstruction.json").name == "opensfm"
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert scan.adapter == "opensfm"
    assert any("2 reconstructions" in said for said in scan.warnings)
    named = read_scan(tmp_path / below / "reconstruction.json", OPTIONS)
    assert_same(named, room, names=room.names)


def test_what_was_meshed_may_lie_there_alone(tmp_path):
    room = truth()
    _write(tmp_path, room, [_part(room)])
    (tmp_path / "reconstruction.json").rename(tmp_path / "reconstruction.meshed.json")
    assert_same(read_scan(tmp_path, OPTIONS), room)


def test_undistorted_pictures_do_not_go_with_the_original_lens(tmp_path):
    """Where OpenSfM puts those, if nobody has the original ones any more."""
    _write(tmp_path, truth(), [_part(truth(), kind="brown", k1=-0.1)])
    (tmp_path / "undistorted").mkdir()
    (tmp_path / "images").rename(tmp_path / "undistorted/images")
    with pytest.raises(InputRefused, match=r"bends light.*\[capture.camera\]"):
        read_scan(tmp_path, OPTIONS)


@pytest.mark.parametrize(
    ("frames", "refused"),
    [
        ("kitchen_undistorted/undistorted_images/a", True),
        ("kitchen_undistorted/images", False),
        ("kitchen_undistorted", False),  # flat: what a whole project is called says nothing
        ("undistortion_study/images", False),
        ("originals_not_undistorted/jpg", False),
        ("Undistorted/images", True),
        ("undistorted_images", True),
        ("photos/undistorted_images", True),
    ],
)
def test_only_what_folders_of_pictures_are_called_refuses_them(tmp_path, frames, refused):
    base, place = tmp_path / "kitchen_undistorted", tmp_path / frames
    base.mkdir()
    _write(base, truth(), [_part(truth(), kind="brown", k1=-0.1)])
    place.mkdir(parents=True, exist_ok=True)
    for picture in list((base / "images").rglob("*.jpg")):
        picture.rename(place / picture.name)
    options = replace(OPTIONS, frames=None if place == base else place)
    if not refused:
        assert len(read_scan(base, options).frames) == 10
        return
    with pytest.raises(InputRefused, match=r"rename the folder.*\[capture.camera\]"):
        read_scan(base, options)


def test_a_folder_may_be_called_opensfm(tmp_path):
    """Which alone does not make it a part of OpenDroneMap's."""
    folder, room = tmp_path / "opensfm", truth()
    folder.mkdir()
    _write(folder, room, [_part(room)])
    assert_same(read_scan(folder, OPTIONS), room, names=room.names)


def test_what_lies_above_the_document_of_opendronemap_is_read_with_it(tmp_path):
    room = truth()
    _write(tmp_path, room, [_part(room)], below="opensfm")
    read = beside(tmp_path / "opensfm")
    assert {tmp_path / "mesh.obj", tmp_path / "images" / "0000.jpg"} <= set(read)
    assert beside(tmp_path) == []


@pytest.mark.parametrize("kind", ["perspective", "fisheye"])
def test_a_camera_of_one_focal_length_has_its_centre_in_the_middle(tmp_path, kind):
    room, part = truth().centred(), _part(truth())
    focal = room.intrinsics[0, 0] / WIDTH
    row = {"projection_type": kind, "width": WIDTH, "height": HEIGHT, "focal": focal}
    part["cameras"][CAMERA] = row | {"k1": 0.0, "k2": 0.0}
    camera = shots_of(part, tmp_path)[0].camera
    assert camera is not None
    np.testing.assert_allclose(camera.intrinsics, room.intrinsics[0])
    assert camera.lens.curve == kind


def _bent(plane, terms):
    """A polynomial of k1, ..., tangential and prism terms, all of the same point."""
    x, y = plane
    r2 = x * x + y * y
    radial = 1 + sum(terms.get(f"k{i}", 0) * r2**i for i in range(1, 7))
    p1, p2, s0, s1, s2, s3 = (terms.get(n, 0) for n in ("p1", "p2", "s0", "s1", "s2", "s3"))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s0 * r2 + s1 * r2 * r2,
        y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + s2 * r2 + s3 * r2 * r2,
    )


@pytest.mark.parametrize(
    ("kind", "terms"),
    [
        ("brown", {"k1": -0.1, "k2": 0.02, "k3": 0.01, "p1": 0.004, "p2": -0.003}),
        ("radial", {"k1": -0.1, "k2": 0.02}),
        ("simple_radial", {"k1": -0.1}),
        ("fisheye_opencv", {"k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001}),
        ("fisheye62", {"k1": 0.02, "k5": 0.01, "k6": -0.004, "p1": 0.004, "p2": -0.003}),
        ("fisheye624", {"k1": 0.02, "p2": 0.01, "s0": 0.01, "s1": 0.02, "s2": -0.01, "s3": 0.03}),
    ],
)
def test_distortions_are_those_of_opensfm(tmp_path, kind, terms):
    room = truth()
    camera = shots_of(_part(room, projection_type=kind, **terms), tmp_path)[0].camera
    assert camera is not None
    x, y = 0.31, -0.23
    pixel = camera.lens.project(np.array([x, -y, -1.0]), camera.intrinsics)
    r = np.hypot(x, y)
    plane = np.array([x, y]) * (np.arctan(r) / r if "fisheye" in kind else 1)
    fx, fy, cx, cy = room.intrinsics[0]
    u, v = _bent(plane, terms)
    np.testing.assert_allclose(pixel, [cx + fx * u, cy + fy * v], atol=1e-9)


def test_a_sphere_is_one(tmp_path):
    part = _part(truth())
    part["cameras"][CAMERA] = {"projection_type": "spherical", "width": 200, "height": 100}
    camera = shots_of(part, tmp_path)[0].camera
    assert camera is not None
    assert camera.lens.curve == "equirectangular"


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({"shots": {}}, "no list of reconstructions with shots"),
        ([{"shots": {}}], "no list of reconstructions with shots"),
        ([_part(truth(), projection_type="dual")], "'dual' is not read"),
        ([_part(truth()) | {"cameras": {}}], "it has no camera"),
    ],
)
def test_what_is_no_reconstruction_says_why(tmp_path, document, words):
    _write(tmp_path, truth(), document)
    with pytest.raises(InputRefused, match=words):
        read_scan(tmp_path, OPTIONS)


def test_shots_without_a_finite_pose_are_left_out(tmp_path):
    part = _part(truth())
    part["shots"]["0004.jpg"]["translation"] = [0, None, 0]
    _write(tmp_path, truth(), [part])
    assert len(read_scan(tmp_path, OPTIONS).frames) == 9


@pytest.mark.parametrize(("latitude", "told"), [(0.0, 1), (47.1, 0)])
def test_only_photographs_that_know_their_place_have_a_scale(tmp_path, latitude, told):
    place = {"latitude": latitude, "longitude": 0.0, "altitude": 0.0}
    _write(tmp_path, truth(), [_part(truth()) | {"reference_lla": place}])
    warnings = read_scan(tmp_path, OPTIONS).warnings
    assert sum("[capture.unit]" in said for said in warnings) == told
    stated = IngestOptions(assume_srgb=True, meters_per_unit=0.5)
    assert not any("[capture.unit]" in said for said in read_scan(tmp_path, stated).warnings)
