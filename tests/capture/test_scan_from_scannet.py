"""A scene of ScanNet as its reader unpacks it, with the mesh, segments and their groups."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)


@pytest.fixture
def room():
    return truth()


@pytest.fixture
def scene(tmp_path, room):
    return write_scene(tmp_path / "scene0000_00", room)


def _rows(matrix):
    return "\n".join(" ".join(f"{number:.9f}" for number in row) for row in matrix) + "\n"


def write_scene(folder, room):
    """All that is downloaded of a scene, but its .sens file; returns the folder."""
    for i, (image, pose) in enumerate(zip(room.images, room.opencv, strict=True)):
        write_image(folder / "color" / f"{i}.jpg", image)
        (folder / "pose").mkdir(exist_ok=True)
        (folder / "pose" / f"{i}.txt").write_text(_rows(pose))
    fx, fy, cx, cy = room.intrinsics[0]
    lens = np.eye(4)
    lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2] = fx, fy, cx - 0.5, cy - 0.5
    (folder / "intrinsic").mkdir()
    (folder / "intrinsic" / "intrinsic_color.txt").write_text(_rows(lens))
    (folder / "intrinsic" / "intrinsic_depth.txt").write_text(_rows(np.eye(4)))
    said = {"axisAlignment": "1 0 0 5", "colorHeight": HEIGHT, "colorWidth": WIDTH}
    said |= {"fx_color": fx, "fy_color": fy, "mx_color": cx - 0.5, "my_color": cy - 0.5}
    rows = [f"{key} = {value}" for key, value in said.items()]
    (folder / "scene0000_00.txt").write_text("\n".join(rows) + "\n")
    for name in ("vh_clean_2", "vh_clean_2.labels"):
        write_ply(folder / f"scene0000_00_{name}.ply", room.points, room.triangles)
    owner = np.zeros(len(room.points), int)
    owner[room.triangles] = room.face_object[:, None]
    segments = folder / "scene0000_00_vh_clean_2.0.010000.segs.json"
    segments.write_text(json.dumps({"segIndices": owner.tolist()}))
    groups = [
        {"id": i, "objectId": i, "label": name, "segments": [i]}
        for i, name in enumerate(room.names)
    ]
    (folder / "scene0000_00.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    return folder


def test_a_scene_that_has_been_unpacked(scene, room):
    assert choose_adapter(scene).name == "scannet"
    scan = read_scan(scene, OPTIONS)
    names = tuple(f"{name}_{i}" for i, name in enumerate(room.names))
    assert_same(scan, room, names=names)
    assert (scan.adapter, scan.name, scan.up_axis) == ("scannet", "scene0000_00", "Z")
    assert {each.class_name for each in scan.objects} == set(room.names)


def test_halves_of_files_that_an_archive_of_a_mac_brings_are_passed_over(scene, room):
    for file in [f for f in scene.rglob("*") if f.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    scan = read_scan(scene, OPTIONS)
    assert_same(scan, room, names=tuple(f"{name}_{i}" for i, name in enumerate(room.names)))


@pytest.mark.parametrize("kept", ["intrinsics_color.txt", "scene0000_00.txt"])
def test_the_lens_may_stand_elsewhere(scene, room, kept):
    if kept == "intrinsics_color.txt":
        (scene / "scene0000_00.txt").unlink()
        (scene / "intrinsic" / "intrinsic_color.txt").rename(scene / kept)
    shutil.rmtree(scene / "intrinsic")
    assert choose_adapter(scene).name == "scannet"
    assert_same(read_scan(scene, OPTIONS), room)


def test_frames_may_be_thinned_out_and_lost_cameras_are_left_out(scene, room):
    (scene / "color" / "9.jpg").unlink()
    (scene / "pose" / "4.txt").write_text(4 * "-inf -inf -inf -inf\n")
    scan = read_scan(scene, OPTIONS)
    assert_same(scan, room, poses=room.world_from_camera[[0, 1, 2, 3, 5, 6, 7, 8]])
    assert scan.counts["poses_without_photograph"] == 1
    assert [s for s in scan.warnings if "'4.jpg': its camera was lost" in s]


def test_numbers_of_objects_below_0_are_no_objects(scene, room):
    path = scene / "scene0000_00.aggregation.json"
    groups = json.loads(path.read_text())
    groups["segGroups"][0] |= {"id": -1, "objectId": -1}
    path.write_text(json.dumps(groups))
    scan = read_scan(scene, OPTIONS)
    names = {each.label for each in scan.objects}
    assert {f"{name}_{i}" for i, name in enumerate(room.names) if i} <= names
    assert f"{room.names[0]}_-1" not in names


def test_another_mesh_has_its_own_objects(scene, room, tmp_path):
    write_ply(tmp_path / "other.ply", room.points[::-1], len(room.points) - 1 - room.triangles)
    scan = read_scan(scene, IngestOptions(assume_srgb=True, mesh=tmp_path / "other.ply"))
    assert_same(scan, room)
    assert [s for s in scan.warnings if "no object labels" in s]


def _no_size(scene):
    (scene / "scene0000_00.txt").unlink()
    lens = scene / "intrinsic" / "intrinsic_color.txt"
    lens.write_text(_rows([[1170, 0, 647, 0], [0, 1170, 483, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))


def _no_lens(scene):
    (scene / "scene0000_00.txt").unlink()
    shutil.rmtree(scene / "intrinsic")


def _no_mesh(scene):
    for path in scene.glob("*.ply"):
        path.unlink()


def _poses_called_otherwise(scene):
    for file in sorted((scene / "pose").glob("*.txt")):
        file.rename(file.with_name(f"{int(file.stem):06d}.txt"))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_poses_called_otherwise, r"none of its poses is called as a picture.*\[capture.frames\]"),
        (_no_size, r"lens in intrinsic/.* another size than its 32 x 24 pixels.*\[capture.size\]"),
        (_no_lens, r"no lens in intrinsic/intrinsic_color.*reader\.py.*\[capture.camera\]"),
        (_no_mesh, r"Download the scene's \*_vh_clean_2\.ply.*--mesh\. \[mesh.missing\]"),
        (lambda s: (s / "pose/3.txt").write_text("1 0 0"), r"3\.txt: no pose of four.*format\]"),
        (lambda s: shutil.rmtree(s / "color"), r"no pictures below.*\[capture.frames\]"),
        (lambda s: shutil.rmtree(s / "pose"), r"no folder pose/.*reader\.py.*\[capture.format\]"),
        (
            lambda s: next(s.glob("*.segs.json")).write_text('{"segIndices": [1]}'),
            r"segIndices for each of the \d+ vertices.*\[objects.count\]",
        ),
        (
            lambda s: next(s.glob("*.aggregation.json")).write_text(
                '{"segGroups": [{"objectId": 1, "segments": [[2]]}]}'
            ),
            r"no segGroups with objectId and segments.*\[objects.format\]",
        ),
    ],
)
def test_refusals(scene, damage, sentence):
    damage(scene)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(scene, OPTIONS, adapter="scannet")


def test_the_objects_beside_a_mesh_that_is_named(scene, room):
    """What reader.py unpacked into a folder of its own, without the mesh."""
    exported = scene / "exported"
    exported.mkdir()
    for name in ("color", "pose", "intrinsic"):
        (scene / name).rename(exported / name)
    mesh = scene / "scene0000_00_vh_clean_2.ply"
    scan = read_scan(exported, IngestOptions(assume_srgb=True, mesh=mesh))
    assert_same(scan, room, names=tuple(f"{name}_{i}" for i, name in enumerate(room.names)))
    beside = files_beside(choose_adapter(exported), exported, mesh)
    assert [file.name for file in beside] == [
        "scene0000_00.aggregation.json",
        "scene0000_00_vh_clean_2.0.010000.segs.json",
    ]
