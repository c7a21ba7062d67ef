"""NICE-SLAM's renders of Replica, and Replica's labels, written as their readers expect them."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from tests.format_truth import FRAMES, HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.asset.layout import Asset
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions
from usdbrdf.tasks.ingest import ingest

OPTIONS = IngestOptions(assume_srgb=True)


@pytest.fixture
def room():
    return truth()


@pytest.fixture
def scene(tmp_path, room):
    return write_scene(tmp_path / "Replica" / "room0", room)


def write_scene(folder, room):
    """<dataset>/room0 with traj.txt and results/, the mesh and the camera beside it; returns the
    folder."""
    (folder / "results").mkdir(parents=True)
    # The loader makes its own camera of these: columns 1 and 2 negated, -z ahead.
    rows = [" ".join(f"{number:.18e}" for number in pose.ravel()) for pose in room.opencv]
    (folder / "traj.txt").write_text("\n".join(rows) + "\n")
    for i, image in enumerate(room.images):
        write_image(folder / "results" / f"frame{i:06d}.jpg", image)
        write_image(folder / "results" / f"depth{i:06d}.png", image)
    write_ply(folder.parent / "room0_mesh.ply", room.points, room.triangles)
    fx, fy, cx, cy = room.intrinsics[0].tolist()
    camera = {"w": WIDTH, "h": HEIGHT, "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}
    (folder.parent / "cam_params.json").write_text(
        json.dumps({"camera": {**camera, "scale": 6553.5}})
    )
    return folder


def _write_semantic_ply(path, polygons, points, object_id):
    """As habitat's: 27 bytes a vertex, polygons of any number of corners, uint16 object_id."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        + f"element face {len(polygons)}\n"
        "property list uchar int vertex_indices\nproperty ushort object_id\nend_header\n"
    )
    body = b"".join(struct.pack("<6f3B", *p, 0, 0, 1, 9, 9, 9) for p in points)
    for polygon, number in zip(polygons, object_id, strict=True):
        body += struct.pack(f"<B{len(polygon)}iH", len(polygon), *polygon, number)
    path.write_bytes(header.encode() + body)


def write_semantics(folder, room):
    """Other polygons than the mesh's: each square once whole and the box in triangles."""
    (folder / "habitat").mkdir()
    box = room.names.index("box")
    polygons, numbers = [], []
    for first in range(0, len(room.triangles), 2):
        a, b = room.triangles[first], room.triangles[first + 1]
        owner = int(room.face_object[first])
        shapes = [a, b] if owner == box else [[a[0], a[1], a[2], b[2]]]
        polygons += shapes
        numbers += [7 * owner + 3] * len(shapes)
    _write_semantic_ply(folder / "habitat" / "mesh_semantic.ply", polygons, room.points, numbers)
    objects = [
        {"id": 7 * i + 3, "class_id": i, "class_name": name, "oriented_bbox": {}}
        for i, name in enumerate(room.names)
    ]
    (folder / "habitat" / "info_semantic.json").write_text(
        json.dumps({"classes": [], "objects": objects})
    )


def test_the_mesh_and_the_camera_lie_beside_the_scene(scene, room):
    assert choose_adapter(scene).name == "nice-slam"
    scan = read_scan(scene, OPTIONS)
    assert_same(scan, room)
    assert (scan.adapter, scan.up_axis, scan.frames.radiometric) == ("nice-slam", "Z", False)


def test_what_lies_beside_the_folder_is_an_input(scene, room, tmp_path):
    asset = Asset(tmp_path / "asset", "room0")
    assert ingest(scene, asset, OPTIONS).reran
    assert not ingest(scene, asset, OPTIONS).reran
    write_ply(scene.parent / "room0_mesh.ply", room.points, room.triangles[::-1])
    assert ingest(scene, asset, OPTIONS).reran


def test_the_labels_beside_a_mesh_from_elsewhere_are_inputs(scene, room, tmp_path):
    published = tmp_path / "published"
    published.mkdir()
    write_ply(published / "mesh.ply", room.points, room.triangles)
    write_semantics(published, room)
    asset = Asset(tmp_path / "asset", "room0")
    options = IngestOptions(assume_srgb=True, mesh=published / "mesh.ply")
    assert ingest(scene, asset, options).reran
    assert not ingest(scene, asset, options).reran
    (published / "glass.sur").write_text("[]")
    assert ingest(scene, asset, options).reran
    info = published / "habitat" / "info_semantic.json"
    info.write_text(info.read_text().replace("box", "crate"))
    assert ingest(scene, asset, options).reran


@pytest.mark.parametrize("adapter", ["nice-slam", "replica"])
def test_all_that_is_read_beside_a_scene_is_named(scene, room, adapter):
    write_semantics(scene.parent, room)
    (scene.parent / "glass.sur").write_text("[]")
    named = files_beside(choose_adapter(scene, adapter), scene, None)
    names = {file.name for file in named}
    labels = {"info_semantic.json", "mesh_semantic.ply", "glass.sur"}
    assert names == {"cam_params.json", "room0_mesh.ply"} | labels


def test_the_other_frames_keep_their_poses(scene, room):
    for i in range(0, FRAMES, 6):
        (scene / "results" / f"frame{i:06d}.jpg").unlink()
    scan = read_scan(scene, OPTIONS)
    assert_same(scan, room, poses=np.delete(room.world_from_camera, [0, 6], axis=0))


@pytest.mark.parametrize("word", ["nan", "-inf"])
def test_a_pose_that_is_not_finite_costs_its_frame_alone(scene, room, word):
    first, *others = (scene / "traj.txt").read_text().splitlines()
    lost = " ".join([word, *first.split()[1:]])
    (scene / "traj.txt").write_text("\n".join([lost, *others]) + "\n")
    scan = read_scan(scene, OPTIONS)
    assert_same(scan, room, poses=room.world_from_camera[1:])
    assert any("its pose is not a finite" in sentence for sentence in scan.warnings)


def test_labels_come_by_the_nearest_face_and_panes_are_objects(scene, room):
    write_ply(scene / "mesh.ply", room.points, room.triangles)
    write_semantics(scene, room)
    # A window in the wall y = 0, over the lower half of it.
    border = [[0, 0, 0], [4, 0, 0], [4, 0, 1.25], [0, 0, 1.25]]
    pane = {"plane_w": [0, 1, 0, 0], "boundary_w": border, "centroid_w": [2, 0, 0.625]}
    (scene / "glass.sur").write_text(json.dumps([{**pane, "reflectivity": 0.1}]))
    scan = read_scan(scene, OPTIONS)
    names = tuple(f"{name}_{7 * i + 3}" for i, name in enumerate(room.names))
    assert_same(scan, room, names=(*names, "pane_1"))
    class_of = {each.label: each.class_name for each in scan.objects}
    assert class_of["pane_1"] == "glass"
    assert class_of[names[0]] == room.names[0]
    owner = np.array([o.class_name for o in scan.objects])[scan.mesh.face_object]
    assert (owner == "glass").sum() == 4  # of 8 triangles of that wall
    for i, name in enumerate(room.names):
        lost = 4 if name == "walls" else 0
        assert (owner == name).sum() == (room.face_object == i).sum() - lost


def test_replica_without_frames_is_refused_with_the_way_out(scene, room):
    write_ply(scene / "mesh.ply", room.points, room.triangles)
    write_semantics(scene, room)
    (scene / "traj.txt").unlink()
    assert choose_adapter(scene).name == "replica"
    with pytest.raises(InputRefused, match=r"no photographs.*traj.txt.*\[capture.frames\]"):
        read_scan(scene, OPTIONS)


def _no_mesh(scene):
    (scene.parent / "room0_mesh.ply").unlink()


def _short_rows(scene):
    path = scene / "traj.txt"
    path.write_text("\n".join(" ".join(row.split()[:12]) for row in path.read_text().splitlines()))


def _few_poses(scene):
    path = scene / "traj.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:5]))


def _no_frames(scene):
    for path in (scene / "results").iterdir():
        path.unlink()


def _no_camera(scene):
    (scene.parent / "cam_params.json").write_text('{"camera": {"w": 1200}}')


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_mesh, r"room0_mesh.ply.*--mesh\. \[mesh.missing\]"),
        (_short_rows, r"a line of 12 numbers.*\[capture.format\]"),
        (_few_poses, r"5 poses for pictures numbered up to 9.*\[capture.frames\]"),
        (_no_frames, r"no pictures below.*\[capture.frames\]"),
        (_no_camera, r"no camera with the numbers.*\[capture.camera\]"),
    ],
)
def test_refusals(scene, damage, sentence):
    damage(scene)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(scene, OPTIONS)


def test_damaged_labels_are_refused(scene, room):
    write_ply(scene / "mesh.ply", room.points, room.triangles)
    write_semantics(scene, room)
    path = scene / "habitat" / "mesh_semantic.ply"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputRefused, match=r"ends within its faces.*\[objects.format\]"):
        read_scan(scene, OPTIONS)
