"""Pix4Dmapper's calibrated_camera_parameters.txt, as the head of such a file explains it; the lens
is that of its manual, "How are the internal and external camera parameters defined"."""

from __future__ import annotations

import numpy as np
import pytest

from tests.format_truth import (
    HEIGHT,
    WIDTH,
    assert_bends,
    assert_same,
    truth,
    write_image,
    write_obj,
)
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_scan
from usdbrdf.capture.reconstructions.pix4d import shots_of
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True, meters_per_unit=1.0)
PARAMETERS = "1_initial/params/room_calibrated_camera_parameters.txt"
HEAD = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""


def _document(room, *, radial=(0, 0, 0), tangential=(0, 0)):
    lines = []
    for i, pose in enumerate(room.opencv):
        fx, fy, cx, cy = room.intrinsics[i]
        matrix = [(fx, 0, cx), (0, fy, cy), (0, 0, 1)]
        rows = [*matrix, radial, tangential, pose[:3, 3], *pose[:3, :3].T]
        lines.append(f"DJI {i:04d}.JPG {WIDTH} {HEIGHT}")
        lines += [" ".join(f"{number:.20f}" for number in row) for row in rows]
    return HEAD + "\n".join(lines) + "\n"


def _write(folder, room, document, name=PARAMETERS):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"DJI {i:04d}.JPG", image)
    mesh = folder / "2_densification/3d_mesh/room_simplified_3d_mesh.obj"
    for place in (mesh, folder / name):
        place.parent.mkdir(parents=True, exist_ok=True)
    write_obj(mesh, room)
    (folder / name).write_text(document)


def test_a_project_is_the_room(tmp_path):
    room = truth()
    _write(tmp_path, room, _document(room))
    assert choose_adapter(tmp_path).name == choose_adapter(tmp_path / PARAMETERS).name == "pix4d"
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert scan.adapter == "pix4d"


@pytest.mark.parametrize("named", [PARAMETERS, "1_initial/params"])
def test_the_project_is_found_above_its_parameters(tmp_path, named):
    room = truth()
    _write(tmp_path, room, _document(room))
    scan = read_scan(tmp_path / named, OPTIONS)
    assert_same(scan, room)
    assert scan.name == tmp_path.name
    beside = files_beside(choose_adapter(tmp_path / named), tmp_path / named, None)
    mesh = tmp_path / "2_densification/3d_mesh/room_simplified_3d_mesh.obj"
    assert beside == sorted([*scan.frames.image_paths, mesh])
    assert files_beside(choose_adapter(tmp_path), tmp_path, None) == []


def test_the_parameters_may_lie_beside_the_pictures(tmp_path):
    room = truth()
    _write(tmp_path, room, _document(room), "parameters.txt")
    assert_same(read_scan(tmp_path, OPTIONS), room)


def _distorted(plane, terms):
    """x_d = x (1 + R1 r^2 + R2 r^4 + R3 r^6) + 2 T1 x y + T2 (r^2 + 2 x^2), and so y."""
    (x, y), (r1, r2, r3, t1, t2) = plane, terms
    squared = x * x + y * y
    radial = 1 + r1 * squared + r2 * squared**2 + r3 * squared**3
    return (
        x * radial + 2 * t1 * x * y + t2 * (squared + 2 * x * x),
        y * radial + 2 * t2 * x * y + t1 * (squared + 2 * y * y),
    )


def test_distortions_are_those_of_pix4d(tmp_path):
    room, radial, tangential = truth(), (-0.1, 0.02, 0.01), (0.004, -0.003)
    (tmp_path / "a.txt").write_text(_document(room, radial=radial, tangential=tangential))
    camera = shots_of(tmp_path / "a.txt")[0].camera
    assert_bends(camera, room, _distorted, (*radial, *tangential))


def test_a_photograph_whose_lines_are_damaged_is_left_out(tmp_path):
    room = truth()
    lines = _document(room).splitlines()
    lines[8 + 20 + 1] = "nan 0 16"
    lines[8 + 50] = "DJI 0005.JPG wide high"
    _write(tmp_path, room, "\n".join(lines))
    scan = read_scan(tmp_path, OPTIONS)
    assert len(scan.frames) == 8
    assert any("its lines hold no camera" in said for said in scan.warnings)


@pytest.mark.parametrize(
    ("document", "said"),
    [
        (lambda text: "\n".join(text.splitlines()[:-3]), "97 lines below .* has 10"),
        (lambda text: text.split("camera model")[0], "0 lines below"),
        (lambda text: HEAD, "0 lines below"),
    ],
)
def test_a_file_that_was_cut_off_is_refused(tmp_path, document, said):
    room = truth()
    _write(tmp_path, room, document(_document(room)))
    with pytest.raises(InputRefused, match=said):
        read_scan(tmp_path, OPTIONS)


def test_without_its_mesh_the_project_is_to_make_one(tmp_path):
    room = truth()
    _write(tmp_path, room, _document(room))
    for mesh in tmp_path.rglob("*.obj"):
        mesh.unlink()
    with pytest.raises(InputRefused, match="Have the 3D textured mesh generated"):
        read_scan(tmp_path, OPTIONS)


def test_numbers_are_those_of_the_head_of_a_file(tmp_path):
    """m = K [R|-Rt] X, by hand."""
    room = truth()
    (tmp_path / "a.txt").write_text(_document(room))
    shot = shots_of(tmp_path / "a.txt")[3]
    pose = room.opencv[3]
    point = pose[:3, 3] + pose[:3, :3] @ (0.2, -0.1, 1.0)
    fx, fy, cx, cy = room.intrinsics[3]
    matrix = np.array([(fx, 0, cx), (0, fy, cy), (0, 0, 1)])
    turn = pose[:3, :3].T
    seen = matrix @ np.c_[turn, -turn @ pose[:3, 3]] @ [*point, 1]
    world = shot.world_from_camera
    local = (world[:3, :3].T @ (point - world[:3, 3])) * (1, -1, -1)
    pixel = shot.camera.lens.project(local, shot.camera.intrinsics)
    np.testing.assert_allclose(pixel, seen[:2] / seen[2], atol=1e-9)


def test_of_several_files_one_is_to_be_named(tmp_path):
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text(HEAD)
    with pytest.raises(
        InputRefused, match=r": 2 files calibrated_camera_parameters.*\. Name the one"
    ):
        read_scan(tmp_path, OPTIONS)
