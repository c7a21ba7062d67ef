"""FIPT's two kinds of rooms, written for the rays that its own loaders make of them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.format_truth import FRAMES, HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import camera_at, write_ply
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions
from usdbrdf.transport.rays import RayScene


def _obj(path, room):
    """One soup without groups."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in room.points]
    lines += [f"f {a} {b} {c}" for a, b, c in room.triangles + 1]
    path.write_text("\n".join(lines) + "\n")


def _write_segmentation(folder, room, i, name):
    """Channel 0 is the object's number, as seen by camera i."""
    camera = camera_at(room.world_from_camera[i], room.intrinsics[i], WIDTH, HEIGHT)
    face = RayScene(room.points, room.triangles).closest(*camera.rays(camera.pixels())).face
    number = np.where(face >= 0, room.face_object[face] + 10, -1).reshape(HEIGHT, WIDTH, 1)
    write_image(folder / "segmentation" / name, np.repeat(number, 3, axis=2).astype(np.float32))


@pytest.fixture
def room():
    return truth()


@pytest.fixture
def photographed(tmp_path, room):
    return write_photographed(tmp_path / "classroom", room)


def write_photographed(folder, room):
    """Cameras as tables of numbers; returns the folder."""
    cameras, lenses = [str(FRAMES)], [str(FRAMES)]
    for i, pose in enumerate(room.world_from_camera):
        origin, up, ahead = pose[:3, 3], pose[:3, 1], -pose[:3, 2]
        rows = (origin, origin + 0.7 * ahead, up)
        cameras += [" ".join(f"{x:.9f}" for x in row) for row in rows]
        fx, fy, cx, cy = room.intrinsics[i]
        lenses += [f"{fx} 0.0 {cx}", f"0.0 {fy} {cy}", "0.0 0.0 1.0"]
        write_image(folder / "Image" / f"{i:03d}_0001.exr", room.images[i])
        _write_segmentation(folder, room, i, f"{i:03d}.exr")
    (folder / "cam.txt").write_text("\n".join(cameras))
    (folder / "K_list.txt").write_text("\n".join(lenses))
    _obj(folder / "scene.obj", room)
    return folder


@pytest.fixture
def rendered(tmp_path, room):
    return write_rendered(tmp_path / "kitchen", room)


def write_rendered(folder, room):
    """Eight frames to train and two to validate; x left, y up, looking down +z. Returns the
    folder."""
    centred = room.centred()
    for split, numbers in (("train", range(8)), ("val", range(8, FRAMES))):
        frames = []
        for i, number in enumerate(numbers):
            right, up, back, centre = room.world_from_camera[number][:3].T
            pose = np.eye(4)
            pose[:3] = np.stack([-right, up, -back, centre], axis=1)
            frames.append({"transform_matrix": pose.tolist()})
            write_image(folder / split / "Image" / f"{i:03d}_0001.exr", room.images[number])
        angle = 2 * np.arctan(WIDTH / 2 / centred.intrinsics[0, 0])
        document = {"camera_angle_x": float(angle), "frames": frames}
        (folder / split / "transforms.json").write_text(json.dumps(document))
    write_ply(folder / "scene.ply", room.points, room.triangles)
    return folder


def test_a_photographed_room_and_its_segmentation(photographed, room):
    assert choose_adapter(photographed).name == "fipt"
    scan = read_scan(photographed, IngestOptions())
    assert_same(scan, room)
    assert (scan.adapter, scan.up_axis, scan.frames.radiometric) == ("fipt", "Z", True)
    # Faces that no frame sees, and those that only a grazing pixel sees, may be wrong or unknown.
    label = np.array([each.label for each in scan.objects])[scan.mesh.face_object]
    expected = np.array([f"object_{10 + i}" for i in range(len(room.names))])[room.face_object]
    known = label != "unlabelled"
    assert known.mean() > 0.4
    assert (label[known] == expected[known]).mean() > 0.95


def test_a_rendered_room(rendered, room):
    assert choose_adapter(rendered).name == "fipt"
    assert_same(read_scan(rendered, IngestOptions()), room.centred())


def _no_mesh(folder):
    (folder / "scene.obj").unlink()


def _fewer_lenses(folder):
    rows = (folder / "K_list.txt").read_text().splitlines()
    (folder / "K_list.txt").write_text("\n".join(["9", *rows[1:28]]))


def _cut(folder):
    rows = (folder / "cam.txt").read_text().splitlines()
    (folder / "cam.txt").write_text("\n".join(rows[:-1]))


def _no_lenses(folder):
    (folder / "K_list.txt").write_text("one lens\n")


def _few_images(folder):
    for i in range(4):
        (folder / "Image" / f"{i:03d}_0001.exr").unlink()


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_mesh, r"no mesh\. .*scene.obj.*--mesh\. \[mesh.missing\]"),
        (_fewer_lenses, r"9 lenses for 10 cameras.*\[capture.format\]"),
        (_cut, r"three rows of three numbers.*\[capture.format\]"),
        (_no_lenses, r"K_list.txt:1: not a row of numbers.*\[document.table\]"),
        (_few_images, r"only 6 of 10 frames.*does not exist.*\[capture.file\]"),
    ],
)
def test_refusals(photographed, damage, sentence):
    damage(photographed)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(photographed, IngestOptions())


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_what_is_up_need_not_be_square_to_the_view(photographed, room, tilt):
    """Rounded to decimals, or tilted towards what is looked at."""
    cameras = [str(FRAMES)]
    for pose in room.world_from_camera:
        origin, up, ahead = pose[:3, 3], pose[:3, 1], -pose[:3, 2]
        rows = (origin, origin + ahead, up + tilt * ahead if tilt else up.round(3))
        cameras += [" ".join(f"{x:.9f}" for x in row) for row in rows]
    (photographed / "cam.txt").write_text("\n".join(cameras))
    frames = read_scan(photographed, IngestOptions()).frames
    # No nearer than what the rounding turns.
    np.testing.assert_allclose(frames.world_from_camera, room.world_from_camera, atol=1e-3)


def test_names_in_other_letters_than_the_data_set_has(photographed, room):
    """As copies through other systems have them; of the segmentation too."""
    scan = read_scan(photographed, IngestOptions())
    for folder in ("Image", "segmentation"):
        for file in (photographed / folder).iterdir():
            file.rename(file.with_suffix(".EXR"))
    (photographed / "Image").rename(photographed / "image")
    other = read_scan(photographed, IngestOptions())
    assert_same(other, room)
    assert [label.label for label in other.objects] == [label.label for label in scan.objects]
    assert any("20 pictures of other names" in said for said in other.warnings)
